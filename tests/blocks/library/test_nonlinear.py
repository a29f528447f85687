"""Quantizer, relay, backlash and rate limiter, at ticks and by events, against closed forms and plain loops."""

import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import Backlash, ParameterError, Quantizer, RateLimiter, Relay, SampleTimeError, ShapeError
from support.switching import Driven, at_ticks, in_time

RNG = np.random.default_rng(11)
T = 0.01


def noise(n=400, size=(), scale=2.0):
    """A random walk, as a function of time at the ticks."""
    steps = scale * np.cumsum(RNG.standard_normal((n, *size)), axis=0) * 0.2
    return lambda t: steps[round(t / T)], steps


def of(value):
    return lambda t: value


# --- quantizer ----------------------------------------------------------------------------------------------------------


def test_a_quantizer_takes_the_nearest_level_and_the_upper_one_at_a_tie():
    u = np.array([-0.76, -0.75, -0.25, 0.0, 0.24, 0.25, 0.74, 0.75, 10.2])
    y = at_ticks(Quantizer(quantum=0.5), T, 1, u=of(u))["y"][0]
    assert y.tolist() == [-1.0, -0.5, 0.0, 0.0, 0.0, 0.5, 0.5, 1.0, 10.0]


def test_each_element_can_have_an_interval_of_its_own():
    y = at_ticks(Quantizer(quantum=(1.0, 0.1)), T, 1, u=of(np.array([1.26, 1.26])))["y"][0]
    np.testing.assert_allclose(y, [1.0, 1.3], rtol=1e-15)


def test_a_quantizer_steps_where_the_signal_passes_the_middles():
    outputs, log = in_time(Quantizer(quantum=0.25), 2.0 * np.pi, u=np.sin)
    up = np.arcsin(np.array([0.5, 1.5, 2.5, 3.5]) * 0.25)
    rise = np.concatenate([up, np.pi - up[::-1], np.pi + up, 2.0 * np.pi - up[::-1]])
    np.testing.assert_allclose([t for t, _ in log], rise, rtol=0, atol=1e-14)
    assert [n for _, n in log] == [("up",)] * 4 + [("down",)] * 8 + [("up",)] * 4
    for t in RNG.uniform(0.0, 6.2, 200):
        assert abs(outputs(t)["y"] - np.sin(t)) <= 0.125 + 1e-12


def test_a_quantizer_follows_a_signal_that_jumps_over_several_levels():
    outputs, log = in_time(Quantizer(quantum=0.1), 3.0, u=lambda t: 0.0 if t < 1.0 else 0.73 if t < 2.0 else -0.31)
    assert len(log) == 2
    assert [float(outputs(t)["y"]) for t in (0.5, 1.5, 2.5)] == pytest.approx([0.0, 0.7, -0.3], abs=1e-15)


def test_just_below_a_middle_the_lower_level_is_the_nearest():
    below = np.nextafter(0.5, 0.0)  # below + 1/2 is rounded to 1
    assert at_ticks(Quantizer(quantum=1.0), T, 1, u=of(below))["y"][0] == 0.0
    start, _ = in_time(Quantizer(quantum=1.0), 2.0, u=lambda t: below if t < 1.0 else 0.3)
    fall, _ = in_time(Quantizer(quantum=1.0), 3.0, u=lambda t: 0.7 if t < 1.0 else below if t < 2.0 else 0.3)
    assert [float(made["y"]) for made in (start(0.5), start(1.5), fall(0.5), fall(2.5))] == [0, 0, 1, 0]


# --- relay --------------------------------------------------------------------------------------------------------------


def test_a_relay_switches_at_its_points_and_keeps_its_state_between():
    relay = Relay(on_point=1.0, off_point=-1.0, on_value=5.0, off_value=-3.0)
    signal, u = noise()
    y = at_ticks(relay, T, len(u), u=signal)["y"]
    on, want = False, []
    for value in u:
        on = True if value > 1.0 else False if value <= -1.0 else on
        want.append(5.0 if on else -3.0)
    assert y.tolist() == want
    assert len(set(want)) == 2


@pytest.mark.parametrize(
    ("u", "initially_on", "y"), [(0.0, True, 1), (0.0, False, 0), (1.5, False, 1), (-1.5, True, 0)]
)
def test_a_relay_starts_by_its_input_or_as_told(u, initially_on, y):
    relay = Relay(on_point=1.0, off_point=-1.0, initially_on=initially_on)
    assert at_ticks(relay, T, 1, u=of(u))["y"][0] == y
    assert in_time(relay, 0.1, u=of(u))[0](0.0)["y"] == y


def test_a_relay_switches_by_events_at_the_crossings():
    outputs, log = in_time(Relay(on_point=0.5, off_point=-0.25), 4.0 * np.pi, u=np.sin)
    on, off = np.arcsin(0.5), np.pi + np.arcsin(0.25)
    switched = [t for t, names in log if names in [("rise",), ("fall",)] and abs(np.sin(t)) > 0.2]
    np.testing.assert_allclose(switched, [on, off, on + 2 * np.pi, off + 2 * np.pi], rtol=0, atol=1e-14)
    assert [float(outputs(t)["y"]) for t in (on - 1e-9, on + 1e-9, np.pi, off - 1e-9, off + 1e-9)] == [0, 1, 1, 1, 0]


def test_equal_points_make_a_sign():
    relay = Relay(on_point=0.0, off_point=0.0, on_value=1.0, off_value=-1.0)
    assert at_ticks(relay, T, 1, u=of(np.array([-1e-300, 0.0, 1e-300])))["y"][0].tolist() == [-1.0, -1.0, 1.0]


def test_points_in_the_wrong_order_are_refused():
    with pytest.raises(
        ParameterError, match=r"relay\.off_point: found off_point=2 above on_point=1; expected it at or"
    ):
        Relay(on_point=1.0, off_point=2.0)


# --- backlash -----------------------------------------------------------------------------------------------------------


def test_play_carries_its_output_with_the_ends_of_the_band():
    signal, u = noise(size=(2,))
    y = at_ticks(Backlash(width=(0.5, 1.5), initial_value=0.1), T, len(u), u=signal)["y"]
    last = np.clip(0.1, u[0] - [0.25, 0.75], u[0] + [0.25, 0.75])
    for k in range(len(u)):
        last = np.array([min(max(last[i], u[k, i] - w), u[k, i] + w) for i, w in enumerate((0.25, 0.75))])
        np.testing.assert_array_equal(y[k], last)


def test_play_of_a_sine_is_its_closed_form_in_continuous_time():
    width = 0.6
    block = Backlash(width=width, with_rate=True)
    outputs, log = in_time(block, 4.0 * np.pi, u=np.sin, rate=np.cos)
    top = 1.0 - 0.5 * width  # where it rests after a maximum; the band is used up once u has come back by its width
    for t in np.concatenate([RNG.uniform(0.0, 4.0 * np.pi, 400)]):
        phase, u = t % (2.0 * np.pi), np.sin(t)
        if t < np.arcsin(0.5 * width):
            want = 0.0
        elif t < np.pi / 2:
            want = u - 0.5 * width
        elif np.pi / 2 <= phase < 3 * np.pi / 2:
            want = top if u > 1.0 - width else u + 0.5 * width
        else:
            want = -top if u < width - 1.0 else u - 0.5 * width
        assert float(outputs(t)["y"]) == pytest.approx(want, abs=1e-12)
    assert [n for _, n in log if n != ("turn",)] == [("push",), ("pull",), ("push",), ("pull",), ("push",)]


@pytest.mark.slow
def test_play_at_fine_ticks_comes_to_that_of_continuous_time():
    signal = lambda t: np.sin(3.0 * t) + 0.4 * np.sin(7.3 * t)  # noqa: E731
    rate = lambda t: 3.0 * np.cos(3.0 * t) + 2.92 * np.cos(7.3 * t)  # noqa: E731
    outputs, _ = in_time(Backlash(width=0.3, with_rate=True), 5.0, grid=1e-3, u=signal, rate=rate)
    errors = []
    for h in (1e-2, 5e-3):
        y = at_ticks(Backlash(width=0.3), h, round(5.0 / h), u=signal)["y"]
        errors.append(max(abs(y[k] - outputs(k * h)["y"]) for k in range(len(y))))
    assert (
        errors[0] < 31.0 * 1e-2**2 / 8.0 * 1.01
    )  # a maximum between two ticks is missed by ü h²/8, |ü| ≤ 9 + 0.4·7.3²
    assert errors[1] < 31.0 * 5e-3**2 / 8.0 * 1.01


def test_play_in_continuous_time_needs_the_rate_of_its_input():
    with pytest.raises(
        SampleTimeError, match=r"backlash\.rate: found no rate; expected the rate of u in a continuous sub"
    ):
        Driven(Backlash(width=1.0), False, u=np.sin)


def test_play_starts_in_the_middle_of_its_band_or_as_told():
    assert at_ticks(Backlash(width=1.0), T, 1, u=of(3.0))["y"][0] == 3.0
    for value, y in ((3.2, 3.2), (9.0, 3.5), (0.0, 2.5)):
        assert at_ticks(Backlash(width=1.0, initial_value=value), T, 1, u=of(3.0))["y"][0] == y


# --- rate limiter -------------------------------------------------------------------------------------------------------


def test_a_rate_limiter_follows_as_fast_as_it_may():
    signal, u = noise(size=(3,))
    y = at_ticks(RateLimiter(rising=10.0, falling=(5.0, 20.0, 1e6), initial_value=0.5), T, len(u), u=signal)["y"]
    last = np.full(3, 0.5)
    for k in range(len(u)):
        last = last + np.clip(u[k] - last, -T * np.array([5.0, 20.0, 1e6]), 10.0 * T)
        np.testing.assert_allclose(y[k], last, rtol=0, atol=1e-14)


def test_a_rate_limiter_begins_with_its_input_unless_told():
    assert at_ticks(RateLimiter(rising=1.0), T, 3, u=of(4.0))["y"].tolist() == [4.0, 4.0, 4.0]
    assert at_ticks(RateLimiter(rising=1.0, initial_value=0.0), T, 2, u=of(4.0))["y"].tolist() == [T, 2 * T]


def test_in_continuous_time_it_lags_within_its_limits():
    # a step: ramps at the limit until u − y = τ·rising, and closes the rest exponentially
    tau, rising = 0.05, 2.0
    run = Driven(RateLimiter(rising=rising, time_constant=tau, initial_value=0.0), False, u=of(1.0))

    def rhs(t, x):
        run.x = x
        run.outputs(t)
        return run.next

    made = solve_ivp(rhs, (0.0, 1.0), [0.0], rtol=1e-11, atol=1e-12, max_step=0.01, dense_output=True)
    knee = (1.0 - tau * rising) / rising
    for t in np.linspace(0.01, 0.99, 50):
        want = rising * t if t < knee else 1.0 - tau * rising * np.exp(-(t - knee) / tau)
        assert made.sol(t)[0] == pytest.approx(want, abs=1e-8)


def test_in_continuous_time_it_needs_a_lag():
    with pytest.raises(
        SampleTimeError, match=r"rate_limiter\.time_constant: found none; expected a lag in a continuous"
    ):
        Driven(RateLimiter(rising=1.0), False, u=np.sin)


# --- all of them --------------------------------------------------------------------------------------------------------

ALL = [
    Quantizer(quantum=0.1),
    Relay(on_point=1.0, off_point=-1.0),
    Backlash(width=0.5, with_rate=True),
    RateLimiter(rising=1.0, time_constant=0.1),
]


@pytest.mark.parametrize("block", ALL, ids=lambda b: type(b).__name__)
def test_what_is_no_number_passes_through(block):
    given = {"u": lambda t: np.array([0.2 if t < T / 2 else np.nan, 0.7])}
    given |= {"rate": of(np.zeros(2))} if "rate" in block.inputs else {}
    y = at_ticks(block, T, 2, **given)["y"]
    assert np.isnan(y).tolist() == [[False, False], [True, False]]


@pytest.mark.parametrize("block", ALL[:3], ids=lambda b: type(b).__name__)
def test_a_vector_is_refused_in_a_continuous_frame(block):
    given = dict.fromkeys(block.inputs, of(np.zeros(2)))
    with pytest.raises(
        ShapeError, match=r"\.u: found shape \(2,\); expected a scalar in a continuous subsystem, where it switches"
    ):
        Driven(block, False, **given)


@pytest.mark.parametrize("block", ALL, ids=lambda b: type(b).__name__)
def test_they_are_values(block):
    assert pickle.loads(pickle.dumps(block)) == block
    assert block.replace() == block
