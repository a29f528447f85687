"""The PID controller: its transfer functions, its recurrences by hand, its anti-windup against closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PID, Constant, ParameterError, TransferFunction, UnwiredInputError
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram
from support.stepped import Alone, response

RNG = np.random.default_rng(21)
FULL = {"kp": 3.0, "ki": 5.0, "kd": 0.4, "b": 0.7, "c": 0.2, "filter_time": 0.05}


def laplace(s, kp, ki=0.0, kd=0.0, b=1.0, c=0.0, filter_time=1.0):
    """From r and from y to u."""
    derivative = kd * s / (filter_time * s + 1)
    return b * kp + ki / s + c * derivative, -(kp + ki / s + derivative)


# --- the linear controller --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gains", [{"kp": 3.0}, {"kp": -3.0, "ki": -5.0}, {"kp": 0.0, "ki": 2.0}, FULL], ids=len)
def test_its_transfer_functions_are_those_of_two_degrees_of_freedom(gains):
    found = Alone(PID(**gains)).matrices(["r", "y"], "u")
    for s in (0.5j, 1.0 + 3.0j, 60.0j):
        np.testing.assert_allclose(response(found, s)[0], laplace(s, **gains), rtol=1e-13)


@pytest.mark.parametrize(
    ("gains", "states"),
    [
        ({"kp": 3.0}, []),
        ({"kp": -3.0, "ki": -5.0}, ["integral"]),
        ({"kp": 3.0, "kd": 0.4, "filter_time": 0.05, "b": 0.0}, ["filtered"]),
        (FULL, ["integral", "filtered"]),
    ],
)
def test_its_linear_part_goes_to_python_control(gains, states):
    limited = PID(**gains, lower=-1.0, upper=1.0, tracking=bool(gains.get("ki")), tracking_time=0.3, name="speed")
    system = limited.to_control()
    assert (system.input_labels, system.output_labels, system.state_labels) == (["r", "y"], ["u"], states)
    assert (system.name, system.dt) == ("speed", 0)
    for s in (0.5j, 1.0 + 3.0j, 60.0j):
        np.testing.assert_allclose(system(s)[0], laplace(s, **gains), rtol=1e-13)
    assert system.poles().real.max(initial=-1.0) <= 0.0


def test_the_ideal_form_is_the_parallel_one():
    block = PID.from_ideal_form(gain=2.0, integral_time=0.5, derivative_time=0.1, ratio=8.0, b=0.6, name="speed")
    s = 1.0 + 2.0j
    want = 2.0 * (0.6 + 1 / (0.5 * s)), -2.0 * (1 + 1 / (0.5 * s) + 0.1 * s / (0.1 / 8.0 * s + 1))
    np.testing.assert_allclose(response(Alone(block).matrices(["r", "y"], "u"), s)[0], want, rtol=1e-13)
    assert block.label == "speed"
    assert PID.from_ideal_form(gain=2.0) == PID(kp=2.0)


DECAYS = {
    "exact": lambda q: np.exp(-q),
    "forward": lambda q: 1 - q,
    "semi_implicit": lambda q: 1 - q,
    "trapezoidal": lambda q: (1 - q / 2) / (1 + q / 2),
}


@pytest.mark.parametrize("anti_windup", ["back_calculation", "clamping", "none"])
@pytest.mark.parametrize("method", DECAYS)
def test_at_ticks_it_goes_by_its_recurrence(method, anti_windup):
    T, r, y = 0.02, RNG.standard_normal(120), RNG.standard_normal(120)
    low, high, tracking_time = -2.0, 3.0, 0.3
    block = PID(**FULL, lower=low, upper=high, anti_windup=anti_windup, tracking_time=tracking_time)
    got = Alone(block, T=T, method=method).ticks(r=r, y=y)
    integral, f, rows, cut = 0.0, 0.2 * r[0] - y[0], [], 0
    decay, share = DECAYS[method](T / 0.05), 1 - DECAYS[method](T / tracking_time)
    for rk, yk in zip(r, y, strict=True):
        v = 3.0 * (0.7 * rk - yk) + integral + 0.4 * (0.2 * rk - yk - f) / 0.05
        u = min(max(v, low), high)
        rows.append((u, v - u))
        step = T * 5.0 * (rk - yk)
        if anti_windup == "back_calculation":
            step += share * (u - v)
        outward = (v > high and rk > yk) or (v < low and rk < yk)
        cut += outward
        if not (anti_windup == "clamping" and outward):
            integral += step
        f = decay * f + (1 - decay) * (0.2 * rk - yk)
    np.testing.assert_allclose(np.stack([got["u"], got["excess"]], axis=1), rows, rtol=0, atol=1e-11)
    assert cut > 20


def test_sampled_exactly_it_is_the_continuous_controller_between_held_inputs():
    T, r, y = 0.1, RNG.standard_normal(50), RNG.standard_normal(50)
    got = Alone(PID(**FULL), T=T).ticks(r=r, y=y)["u"]
    alone = Alone(PID(**FULL))
    A, B, C, D = alone.matrices(["r", "y"], "u")
    whole = expm(T * np.block([[A, B], [np.zeros((2, 4))]]))
    x, want = alone.start({"r": r[0], "y": y[0]}), []
    for u in np.stack([r, y], axis=1):
        want.append((C @ x + D @ u)[0])
        x = whole[:2, :2] @ x + whole[:2, 2:] @ u
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


def test_without_a_gain_there_is_no_state_for_it():
    assert list(PID(kp=1.0, ki=1.0).states) == ["integral"]
    assert list(PID(**FULL).states) == ["integral", "filtered"]
    assert "clamped" in PID(**FULL, lower=-1.0, upper=1.0, anti_windup="clamping").states
    assert list(PID(kp=1.0).inputs) == ["r", "y"]
    assert "actual" in PID(kp=1.0, ki=1.0, tracking=True).inputs


@pytest.mark.parametrize(
    ("parameters", "states"),
    [
        ({}, []),
        ({"ki": -0.0}, []),
        ({"ki": 1e-300}, ["integral"]),
        ({"kd": 0.1, "filter_time": 0.05}, ["filtered"]),
        ({"lower": -1.0, "upper": 1.0}, []),
        ({"lower": -1.0, "upper": 1.0, "anti_windup": "clamping"}, []),
        ({"lower": -1.0, "upper": 1.0, "tracking_time": 0.2}, ["integral"]),
        ({"tracking_time": 0.2}, []),
        ({"lower": -1.0, "upper": 1.0, "tracking_time": 0.2, "anti_windup": "none"}, []),
        ({"tracking": True}, []),
        ({"tracking": True, "tracking_time": 0.2}, ["integral"]),
        ({"initial_output": 0.0}, ["integral"]),
    ],
    ids=str,
)
def test_without_an_integral_gain_the_integral_is_a_state_where_something_else_moves_it(parameters, states):
    block = PID(kp=4.0, **parameters)
    assert list(block.states) == states
    assert {"integral", "filtered", "clamped"} - block.states.keys() == block.absent_states.keys()


@pytest.mark.parametrize("T", [None, 0.02], ids=["continuous", "sampled"])
@pytest.mark.parametrize("anti_windup", ["back_calculation", "clamping"])
def test_a_p_controller_without_a_state_is_a_limited_gain(T, anti_windup):
    alone = Alone(PID(kp=4.0, b=0.5, lower=-3.0, upper=2.0, anti_windup=anti_windup), T=T)
    for r, y in RNG.standard_normal((50, 2)):
        found, after = alone.call(0.0, alone.start({"r": r, "y": y}), {"r": r, "y": y})
        v = 4.0 * (0.5 * r - y)
        assert (found["u"], found["excess"]) == (min(max(v, -3.0), 2.0), v - min(max(v, -3.0), 2.0))
        assert after.size == 0


def test_a_pd_controller_starts_without_a_kick():
    alone = Alone(PID(kp=3.0, kd=0.4, b=0.7, c=0.2, filter_time=0.05), T=0.1)
    u = {"r": 2.0, "y": 0.5}
    assert alone.call(0.0, alone.start(u), u)[0]["u"] == pytest.approx(3.0 * (0.7 * 2.0 - 0.5))


# --- the start --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("T", [None, 0.1], ids=["continuous", "sampled"])
def test_it_starts_without_a_kick_or_a_bump(T):
    u = {"r": 2.0, "y": 0.5}
    alone = Alone(PID(**FULL), T=T)
    outputs, _ = alone.call(0.0, alone.start(u), u)
    assert outputs["u"] == pytest.approx(3.0 * (0.7 * 2.0 - 0.5))  # P alone
    alone = Alone(PID(**FULL, initial_output=1.25), T=T)
    assert alone.call(0.0, alone.start(u), u)[0]["u"] == pytest.approx(1.25)


def test_another_integral_gain_makes_no_bump():
    u = {"r": 1.0, "y": 0.0}
    x = np.array([4.0])
    assert [Alone(PID(kp=1.0, ki=ki)).call(0.0, x, u)[0]["u"] for ki in (1.0, 7.0)] == [5.0, 5.0]


# --- anti-windup ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [None, 0.2])
def test_back_calculation_leads_the_integral_to_where_the_limit_is_just_exceeded(given):
    # constant error e beyond the limit: T_t İ = ki e T_t + u_max − kp e − I
    kp, ki, e, high = 2.0, 4.0, 1.5, 1.0
    tracking_time = kp / ki if given is None else given
    block = PID(kp=kp, ki=ki, lower=-1.0, upper=high, tracking_time=given)
    times = np.linspace(0.0, 2.0, 21)
    got = Alone(block).run(lambda t: {"r": e}, times)
    rest = high - kp * e + ki * e * tracking_time
    integral = rest * (1.0 - np.exp(-times / tracking_time))
    np.testing.assert_allclose(got["u"], high)
    np.testing.assert_allclose(got["excess"], kp * e + integral - high, rtol=0, atol=1e-10)


def test_tracking_follows_what_the_actuator_does():
    # another controller is in charge: v approaches what it does, with T_t, plus what the error adds
    times = np.linspace(0.0, 3.0, 31)
    block = PID(kp=1.0, ki=2.0, tracking=True, tracking_time=0.25, initial_output=5.0)
    got = Alone(block).run(lambda t: {"r": 0.3, "actual": -1.0}, times)["u"]
    rest = -1.0 + 2.0 * 0.3 * 0.25
    np.testing.assert_allclose(got, rest + (5.3 - rest) * np.exp(-times / 0.25), rtol=0, atol=1e-10)
    assert not block.starts_from_inputs  # actual comes from its own output
    assert "actual" not in trace(block, {"r": (), "y": (), "actual": ()}, sampled=False).depends["u"]


def test_a_clamped_integral_is_held_between_the_events():
    # e = 1: P = 1, I = t until v = 2 at t = 1; held until e changes its sign at t = 2; then it goes down at once
    block = PID(kp=1.0, ki=1.0, lower=-2.0, upper=2.0, anti_windup="clamping")
    alone = Alone(block)
    times = np.linspace(0.0, 3.0, 31)
    got = alone.run(lambda t: {"r": 1.0 if t < 2.0 else -1.0}, times, edges=[2.0])
    v = np.where(times < 2.0, 1.0 + np.minimum(times, 1.0), -1.0 + 1.0 - (times - 2.0))
    np.testing.assert_allclose(got["u"] + got["excess"], v, rtol=0, atol=1e-9)
    assert [(round(t, 9), name) for t, name in alone.occurred] == [(1.0, "clamp"), (2.0, "release")]


@pytest.mark.slow
def test_an_integral_that_would_chatter_at_the_limit_takes_steps_of_its_clearance():
    # e falls slowly: P takes v inside again, I drives it out: v slides along the limit
    block = PID(kp=1.0, ki=1.0, lower=-2.0, upper=2.0, anti_windup="clamping", clearance=0.01)
    alone = Alone(block)
    times = np.linspace(0.0, 2.0, 201)
    got = alone.run(lambda t: {"r": 1.8 - 0.5 * t}, times)
    assert np.abs(got["u"] + got["excess"] - 2.0)[times > 0.3].max() < 0.01 * 4.0 + 1e-9
    assert 10 < len(alone.occurred) < 100


def test_an_integral_that_starts_beyond_the_limit_is_clamped_from_the_start():
    block = PID(kp=1.0, ki=1.0, lower=-2.0, upper=2.0, anti_windup="clamping")
    got = Alone(block).run(lambda t: {"r": 5.0}, np.array([0.0, 1.0, 2.0]))["excess"]
    np.testing.assert_allclose(got, 3.0, rtol=0, atol=1e-12)


def overshoot(**how):
    """Of a motor 1 / (s (s + 1)) under a large step, the controller sampled at 100 Hz, the motor exact between."""
    T, x, highest = 0.01, np.zeros(2), 0.0
    decay = np.exp(-T)
    motor, drive = np.array([[1.0, 1.0 - decay], [0.0, decay]]), np.array([T - 1.0 + decay, 1.0 - decay])
    alone = Alone(PID(kp=4.0, ki=3.0, kd=3.0, filter_time=0.05, lower=-1.0, upper=1.0, **how), T=T)
    state = alone.start({"r": 5.0, "y": 0.0})
    for k in range(1500):
        outputs, state = alone.call(k * T, state, {"r": 5.0, "y": x[0]})
        x = motor @ x + drive * outputs["u"]
        highest = max(highest, x[0])
    return highest - 5.0


def test_anti_windup_takes_the_overshoot_away():
    bare = overshoot(anti_windup="none")
    assert bare > 1.0
    assert overshoot() < 0.2 * bare
    assert overshoot(anti_windup="clamping") < 0.2 * bare


# --- what can't work --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "port", "text"),
    [
        ({"kd": 1.0}, "filter_time", "expected a filter for the derivative. Give filter_time"),
        ({"anti_windup": "magic"}, "anti_windup", "found 'magic'; expected one of 'back_calculation', 'clamping'"),
        ({"lower": 1.0, "upper": -1.0}, "lower", "found lower=1 and upper=-1; expected lower below upper"),
        ({"upper": 1.0, "initial_output": 2.0}, "initial_output", "found 2.0; expected a value within the limits"),
        (
            {"upper": 1.0, "anti_windup": "clamping"},
            "anti_windup",
            "found clamping without both limits; give lower and upper",
        ),
        ({"tracking": True, "anti_windup": "none"}, "anti_windup", "expected 'back_calculation' with tracking"),
        ({"kp": 0.0, "ki": 1.0, "upper": 1.0}, "tracking_time", r"kp / ki is 0 s; expected a positive time"),
        ({"kp": -1.0, "ki": 1.0, "upper": 1.0}, "tracking_time", r"kp / ki is -1 s; .* Give tracking_time"),
    ],
)
def test_what_can_not_work_is_refused(parameters, port, text):
    with pytest.raises(ParameterError, match=text) as caught:
        PID(**{"kp": 1.0, **parameters})
    assert caught.value.port == port


@pytest.mark.parametrize("T", [None, 0.1], ids=["continuous", "sampled"])
def test_a_nan_passes_the_limits(T):
    alone = Alone(PID(kp=1.0, ki=1.0, lower=-1.0, upper=1.0), T=T)
    assert np.isnan(alone.call(0.0, np.zeros(1), {"r": np.nan})[0]["u"])


def test_of_an_error_alone_it_is_the_textbooks_controller():
    """With y = 0 and c = 1 it is kp + ki/s + kd s/(T_f s + 1) on the error."""
    pid = PID(kp=2.0, ki=3.0, kd=0.4, filter_time=0.05, c=1.0, name="pid")
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
    loop = Diagram("loop", plant(pid(Constant(value=1.0) - plant.y, 0.0).named("u"))).linearize().loop("u")
    s = 0.7j
    wanted = (2.0 + 3.0 / s + 0.4 * s / (0.05 * s + 1.0)) / (s + 1.0)
    assert complex(loop(s)) == pytest.approx(wanted, rel=1e-9)
    with pytest.raises(UnwiredInputError, match=r"Of an error e alone, .* it is pid\(e, 0\.0\)\.$"):
        pid(plant.y)
    with pytest.raises(UnwiredInputError, match=r"pid\(e, 0\.0\), in a PID with c=1\.0, so that D acts on it\.$"):
        pid.replace(c=0.0)(plant.y)
