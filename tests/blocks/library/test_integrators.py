"""Integrators and the filtered derivative: against closed forms, between events and at ticks."""

import control
import numpy as np
import pytest

from loopwright.blocks import (
    FilteredDerivative,
    Integrator,
    LimitedIntegrator,
    ParameterError,
    ResettableIntegrator,
    ShapeError,
)
from loopwright.blocks.tracing.traced import trace
from support.stepped import Alone

RNG = np.random.default_rng(3)
T = 0.05


@pytest.mark.parametrize("shape", [(), (3,), (2, 2)], ids=str)
@pytest.mark.parametrize("method", ["exact", "forward", "semi_implicit", "trapezoidal"])
def test_an_integral_of_held_inputs_is_their_sum(shape, method):
    u = RNG.standard_normal((60, *shape))
    got = Alone(Integrator(initial_value=0.5), T=T, method=method, u=shape).ticks(u=u)["y"]
    want = 0.5 + T * np.cumsum(np.concatenate([np.zeros((1, *shape)), u[:-1]]), axis=0)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-14)


def test_an_integral_in_continuous_time_is_the_closed_form():
    times = np.linspace(0.0, 4.0, 17)
    got = Alone(Integrator(initial_value=-1.0)).run(lambda t: {"u": 2.0 * np.cos(3.0 * t)}, times)["y"]
    np.testing.assert_allclose(got, -1.0 + 2.0 / 3.0 * np.sin(3.0 * times), rtol=0, atol=1e-11)


# --- limits -----------------------------------------------------------------------------------------------------------


def limited_by_hand(u, low, high, y=0.0):
    rows = []
    for value in u:
        rows.append(y)
        y = min(max(y + T * value, low), high)
    return rows


@pytest.mark.parametrize(("low", "high"), [(-0.3, 0.4), (None, 0.4), (-0.3, None)])
def test_a_limited_sum_stops_at_its_limits_and_leaves_at_once(low, high):
    u = 4.0 * np.sin(0.2 * np.arange(120)) + (0.5 if high else -2.5)
    got = Alone(LimitedIntegrator(lower=low, upper=high, initial_value=0.1), T=T).ticks(u=u)
    bounds = (-np.inf if low is None else low, np.inf if high is None else high)
    want = limited_by_hand(u, *bounds, y=0.1)
    np.testing.assert_allclose(got["y"], want, rtol=0, atol=1e-14)
    held = np.where(np.array(want) >= bounds[1], 1.0, np.where(np.array(want) <= bounds[0], -1.0, 0.0))
    assert got["held"].tolist() == held.tolist()
    assert (held != 0).sum() > 20


def test_a_limited_sum_of_a_vector_is_limited_entry_by_entry():
    u = RNG.standard_normal((50, 2)) * 5
    got = Alone(LimitedIntegrator(lower=-0.3, upper=0.4), T=T, u=(2,)).ticks(u=u)["y"]
    for i in range(2):
        np.testing.assert_allclose(got[:, i], limited_by_hand(u[:, i], -0.3, 0.4), rtol=0, atol=1e-14)


def limited_sine(t):
    """∫ 2 sin t within [-0.5, 1] from 0: each piece by hand."""
    up, off, down = np.pi / 3, np.pi, np.pi + np.arccos(0.25)
    s = t % (2 * np.pi)
    if t < 2 * np.pi:
        first = 2.0 * (1.0 - np.cos(s)) if s < up else 1.0
    else:
        up = np.arccos(0.25)  # from the lower limit on
        first = -0.5 + 2.0 * (1.0 - np.cos(s)) if s < up else 1.0
    return first if s < off else -1.0 - 2.0 * np.cos(s) if s < down else -0.5


def test_in_continuous_time_it_is_held_while_the_input_drives_outward():
    times = np.linspace(0.0, 12.0, 241)
    alone = Alone(LimitedIntegrator(lower=-0.5, upper=1.0))
    got = alone.run(lambda t: {"u": 2.0 * np.sin(t)}, times)
    np.testing.assert_allclose(got["y"], [limited_sine(t) for t in times], rtol=0, atol=1e-9)
    pi = np.pi
    events = [pi / 3, pi, pi + np.arccos(0.25), 2 * pi, 2 * pi + np.arccos(0.25), 3 * pi, 3 * pi + np.arccos(0.25)]
    assert [t for t, _ in alone.occurred] == pytest.approx(events, abs=1e-9)
    assert [name for _, name in alone.occurred] == ["reached", "released"] * 3 + ["reached"]
    at = dict(zip(times, got["held"], strict=True))
    assert (at[2.0], at[4.0], at[5.0]) == (1.0, 0.0, -1.0)


def test_at_the_limit_the_value_is_the_limit_exactly():
    got = Alone(LimitedIntegrator(upper=0.1)).run(lambda t: {"u": 1.0}, np.array([0.0, 0.05, 0.5, 1.0]))["y"]
    assert got[2:].tolist() == [0.1, 0.1]


@pytest.mark.parametrize("start", [1.0, 0.0])
def test_a_start_at_the_limit_stays_there_or_leaves(start):
    times = np.array([0.0, 0.3, 1.0])
    limits = {"lower": 0.0, "upper": 1.0, "initial_value": start}
    inward = 1.0 if start == 0.0 else -1.0
    out = Alone(LimitedIntegrator(**limits)).run(lambda t: {"u": -inward}, times)["y"]
    back = Alone(LimitedIntegrator(**limits)).run(lambda t: {"u": 0.5 * inward}, times)["y"]
    np.testing.assert_allclose(out, start, rtol=0, atol=1e-12)
    np.testing.assert_allclose(back, start + 0.5 * inward * times, rtol=0, atol=1e-12)


def test_an_input_that_jumps_inward_releases_it():
    alone = Alone(LimitedIntegrator(upper=0.5))
    times = np.linspace(0.0, 2.0, 21)
    got = alone.run(lambda t: {"u": 1.0 if t < 1.0 else -1.0}, times, edges=[1.0])["y"]
    want = np.where(times < 1.0, np.minimum(times, 0.5), 0.5 - (times - 1.0))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-11)


def test_a_nan_passes_the_limits():
    got = Alone(LimitedIntegrator(lower=-1.0, upper=1.0), T=T).ticks(u=[0.0, np.nan, 0.0])["y"]
    assert np.isnan(got[2])


@pytest.mark.parametrize("block", [LimitedIntegrator(upper=1.0), ResettableIntegrator(upper=1.0)])
def test_a_vector_with_limits_is_refused_in_a_continuous_frame(block):
    with pytest.raises(
        ShapeError, match=r"u: found shape \(2,\); expected a scalar in a continuous subsystem.* Index the"
    ):
        trace(block, {"u": (2,), "reset": ()} if "reset" in block.inputs else {"u": (2,)}, sampled=False)


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        ({}, "found no limit; expected one or two. Give lower, upper or both, or use Integrator"),
        ({"lower": 1.0, "upper": 1.0}, "found lower=1 and upper=1; expected lower below upper"),
        ({"lower": 1.0, "upper": 2.0}, "initial_value: found 0.0; expected a value within the limits, 1 to 2"),
        ({"upper": 1.0, "initial_value": [0.0, 2.0]}, "expected a value within the limits, -inf to 1"),
    ],
)
def test_limits_that_can_not_be_kept_are_refused(limits, text):
    with pytest.raises(ParameterError, match=text):
        LimitedIntegrator(**limits)


# --- reset ------------------------------------------------------------------------------------------------------------


def test_at_ticks_an_edge_resets_and_a_level_does_not():
    reset = np.array([1, 0, 0, 1, 1, 0, 1, 0])
    got = Alone(ResettableIntegrator(initial_value=0.2), T=1.0).ticks(u=np.ones(8), reset=reset)
    assert got["y"].tolist() == pytest.approx([0.2, 1.2, 2.2, 0.2, 1.2, 2.2, 0.2, 1.2])
    assert got["before"].tolist() == pytest.approx([0.2, 1.2, 2.2, 3.2, 1.2, 2.2, 3.2, 1.2])


def test_at_ticks_it_is_reset_to_the_input_that_it_is_told():
    alone = Alone(ResettableIntegrator(reset_to_input=True, upper=5.0), T=1.0, u=(2,), value=(2,))
    value = np.array([[7.0, -1.0]] * 4)
    got = alone.ticks(u=np.ones((4, 2)), reset=[0, 0, 1, 1], value=value)["y"]
    assert got.tolist() == [[0.0, 0.0], [1.0, 1.0], [5.0, -1.0], [5.0, 0.0]]


def test_at_ticks_a_signal_that_is_true_at_the_start_is_no_edge():
    alone = Alone(ResettableIntegrator(initial_value=1.0, reset_to_input=True), T=1.0)
    assert alone.ticks(u=np.ones(3), reset=np.ones(3), value=np.full(3, 9.0))["y"].tolist() == [1.0, 2.0, 3.0]


def test_only_the_output_after_a_reset_feeds_it_through():
    block = ResettableIntegrator()
    shapes = {"u": (), "reset": ()}
    sampled, continuous = (trace(block, shapes, sampled=s).depends for s in (True, False))
    assert "reset" in sampled["y"]
    assert not {"u", "reset"} & (sampled["before"] | continuous["y"] | continuous["before"])


def test_in_continuous_time_an_edge_resets():
    alone = Alone(ResettableIntegrator(initial_value=1.0), u=(2,))
    times = np.linspace(0.0, 3.0, 31)

    def u(t):
        return {"u": np.array([1.0, -2.0]), "reset": 1.0 if t >= 2.0 or t < 0.5 else 0.0}

    got = alone.run(u, times, edges=[0.5, 2.0])["y"]
    since = np.where(times < 2.0, times, times - 2.0)  # true at the start is no edge
    np.testing.assert_allclose(got, 1.0 + since[:, None] * [1.0, -2.0], rtol=0, atol=1e-11)


def test_in_continuous_time_it_is_reset_from_its_limit_to_an_input():
    alone = Alone(ResettableIntegrator(reset_to_input=True, lower=-1.0, upper=0.6))
    times = np.linspace(0.0, 2.0, 41)
    got = alone.run(lambda t: {"u": 1.0, "reset": float(t >= 1.0), "value": -3.0}, times, edges=[1.0])["y"]
    want = np.where(times < 1.0, np.minimum(times, 0.6), np.minimum(times - 2.0, 0.6))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-11)
    assert [name for _, name in alone.occurred] == ["reached", "restart"]


# --- filtered derivative ----------------------------------------------------------------------------------------------


def test_a_filtered_derivative_is_the_transfer_function():
    times, tau = np.linspace(0.0, 2.0, 21), 0.2
    got = Alone(FilteredDerivative(time_constant=tau)).run(lambda t: {"u": np.sin(5.0 * t)}, times)["y"]
    gain = 5.0j / (5.0j * tau + 1.0)
    want = np.imag(gain * np.exp(5.0j * times)) - np.imag(gain) * np.exp(-times / tau)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-9)


def test_a_filtered_derivative_sampled_exactly_is_what_python_control_samples():
    u = RNG.standard_normal(60)
    system = control.sample_system(control.ss(control.tf([1, 0], [0.2, 1])), T)
    want = control.forced_response(system, np.arange(60) * T, u).outputs
    got = Alone(FilteredDerivative(time_constant=0.2, initial_value=0.0), T=T).ticks(u=u)["y"]
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


def test_a_filtered_derivative_starts_at_zero_unless_told():
    u = np.full((5, 2), 3.0)
    assert not Alone(FilteredDerivative(time_constant=0.2), T=T, u=(2,)).ticks(u=u)["y"].any()
    assert Alone(FilteredDerivative(time_constant=0.2, initial_value=1.0), T=T).ticks(u=[3.0])["y"][0] == 10.0


def test_the_filtered_derivative_goes_to_python_control():
    system = FilteredDerivative(time_constant=0.2, name="rate").to_control()
    assert (system.name, system.dt) == ("rate", 0)
    for s in (0.5j, 1.0 + 3.0j):
        assert system(s) == pytest.approx(s / (0.2 * s + 1.0), rel=1e-14)
