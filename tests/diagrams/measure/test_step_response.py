"""Step responses of running diagrams, against closed forms and recurrences written out."""

import control
import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import (
    Constant,
    Gain,
    Integrator,
    OptionError,
    Saturation,
    SimulationError,
    Sine,
    Step,
    Sum,
    TransferFunction,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.measure import injection, step_response
from loopwright.diagrams.results import measure_step
from support.tuned_loops import make_slide, slide_slope


def spring(damping=3.0):
    """s² + d s + 40: L = (d s + 40)/s² at the command of a double integrator."""
    place, speed = Integrator(name="place"), Integrator(name="speed")
    return Diagram("spring", place(speed((-damping * speed.y - 40.0 * place.y).named("u"))))


def sampled(gain=3.0, delay=0, more=0.0):
    """An integrator behind a sampled gain, T = 0.01 s."""
    lag = Integrator(name="lag")

    @subsystem(sample_time=0.01, delay=delay)
    def controller(y):
        return Gain(gain=gain, name="gain")(more - y).named("u")

    return Diagram("sampled", lag(controller(lag.y)))


def test_a_continuous_loop_answers_as_its_complementary_sensitivity():
    found = step_response(spring().wired, "u", size=0.1, length=3.0, outputs=["place.y"])
    s = control.tf("s")
    for linear in (False, True):
        _, T = control.step_response((3 * s + 40) / (s**2 + 3 * s + 40), found.t)
        np.testing.assert_allclose(found.answer(linear=linear), T, atol=1e-7)
    _, y = control.step_response(1 / (s**2 + 3 * s + 40), found.t)
    np.testing.assert_allclose(found.answer(True), y, atol=1e-8)


@pytest.mark.slow
def test_the_final_value_is_that_of_the_linear_model_at_frequency_zero():
    found = step_response(spring().wired, "u", size=0.1, length=0.2, outputs=["place.y", "speed.y"])
    np.testing.assert_allclose(found.final / 0.1, [-1.0, 1 / 40, 0.0], atol=1e-9)
    assert found.final_answer() == pytest.approx(1.0)
    held = step_response(sampled().wired, "u", size=0.1, length=0.1, outputs=["lag.y"])
    np.testing.assert_allclose(held.final / 0.1, [-1.0, 1 / 3], atol=1e-9)


def test_a_continuous_diagram_is_tried_at_the_point_that_was_trimmed():
    """It starts 2.9 N off the rest of its integral, which the step response was measured around."""
    diagram = make_slide()
    found = step_response(diagram.wired, "u", size=1e-4, length=1.0, at=diagram.trim(targets={"slide.speed": 0.3}))
    s = control.tf("s")
    L = (6 * s + 40) / (s * (2 * s + slide_slope()))
    _, T = control.step_response(L / (1 + L), found.t)
    np.testing.assert_allclose(found.answer(), T, atol=1e-4)
    assert found.moved < 1e-9
    measured = diagram.frequency_response("u", [5.0], amplitude=1e-5, at=diagram.trim(targets={"slide.speed": 0.3}))
    assert measured.L.frdata.item() == pytest.approx(complex(L(1j * measured.omega[0])), rel=1e-4)


@pytest.mark.slow
def test_a_point_at_the_start_is_the_start():
    """Its step of 1 ms made a sine of 0.5 rad/s 16 times as long to run as one from the start."""
    diagram = spring()
    found = [diagram.frequency_response("u", [5.0], amplitude=1e-3, at=at) for at in (0.0, diagram.linearize().point)]
    assert found[0].L.frdata.item() == found[1].L.frdata.item()


def test_overshoot_and_settling_are_those_of_the_closed_form():
    w, zeta = np.sqrt(40.0), 3.0 / (2 * np.sqrt(40.0))
    t = np.linspace(0.0, 6.0, 3001)
    wd = w * np.sqrt(1 - zeta**2)
    r = 1 - np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta / np.sqrt(1 - zeta**2) * np.sin(wd * t))
    found = measure_step(t, r, held=False)
    over = np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2))
    assert abs(found["overshoot"].value - over) <= found["overshoot"].tolerance < 1e-3
    envelope = -np.log(0.02 * np.sqrt(1 - zeta**2)) / (zeta * w)
    assert envelope - np.pi / wd <= found["settling"].value <= envelope
    assert found["peak"].value == pytest.approx(1 + over, abs=1e-4)


def test_a_first_order_response_has_its_times():
    t = np.linspace(0.0, 12.0, 1201)
    found = measure_step(t, -2.0 * (1 - np.exp(-t)), held=False)
    assert abs(found["settling"].value - np.log(50.0)) <= found["settling"].tolerance < 0.02
    assert abs(found["rise"].value - np.log(9.0)) <= found["rise"].tolerance == pytest.approx(t[1], rel=0.01)
    assert found["overshoot"].value <= found["overshoot"].tolerance < 1e-4
    assert found["final"].value == pytest.approx(-2.0, rel=1e-4)


@pytest.mark.parametrize(
    "r",
    [lambda t: t, lambda t: np.sin(5 * t), lambda t: np.exp(-t) * np.sin(t), lambda t: np.exp(0.3 * t)],
    ids=["ramp", "rings", "back to zero", "grows"],
)
def test_a_response_that_does_not_settle_has_no_settling_time_and_no_overshoot(r):
    t = np.linspace(0.0, 10.0, 1001)
    found = measure_step(t, r(t), held=False)
    assert all(np.isnan(found[name].value) for name in ("final", "overshoot", "settling", "rise"))
    assert found["peak"].value == pytest.approx(np.max(np.abs(r(t))))


def test_a_response_that_ends_off_its_target_never_settles():
    t = np.linspace(0.0, 12.0, 1201)
    found = measure_step(t, 0.5 * (1 - np.exp(-t)), held=False, target=1.0)
    assert found["settling"].value == found["rise"].value == np.inf
    assert found["final"].value == pytest.approx(0.5, rel=1e-3)
    assert measure_step(t, 0.5 * (1 - np.exp(-t)), held=False, target=0.5)["settling"].value == pytest.approx(
        3.912, 0.01
    )


@pytest.mark.drawn(1)
@pytest.mark.parametrize("delay", [0, 1])
def test_a_sampled_loop_is_its_recurrence(delay):
    found = step_response(sampled(delay=delay).wired, "controller.u", size=0.1, length=2.0, outputs=["lag.y"])
    assert found.held
    many = round(found.dt / found.t[1])  # instants in a sample: the integrator is a straight line there
    d, samples = found.d[::many], len(found.t[::many])
    y, v, before = np.zeros(samples), np.zeros(samples), 0.0
    for k in range(samples):
        command = -3.0 * y[k]
        v[k], before = (before, command) if delay else (command, before)
        if k + 1 < samples:
            y[k + 1] = y[k] + 0.01 * (v[k] + d[k])
    np.testing.assert_allclose(found.y[::many, 0], y, atol=1e-13)
    np.testing.assert_allclose(found.v[::many], v, atol=1e-13)
    np.testing.assert_allclose(found.prediction[::many, 0], v, atol=1e-13)
    between = np.interp(found.t, found.t[::many], y)
    np.testing.assert_allclose(found.y[:, 0], between, atol=1e-13)
    np.testing.assert_allclose(found.prediction[:, 1], between, atol=1e-13)
    assert np.array_equal(found.v[:-1], np.repeat(found.v[:-1:many], many))
    assert d[0] == 0.0
    assert np.all(d[1:] == 0.1)


def test_a_diagram_that_moves_by_itself_gives_the_steps_part_alone():
    lag = Integrator(name="lag")

    @subsystem(sample_time=0.01)
    def controller(y):
        return Gain(gain=3.0, name="gain")(Sine(frequency=2.0, name="wish") - y).named("u")

    diagram = Diagram("moving", lag(controller(lag.y))).wired
    moving = step_response(diagram, "controller.u", size=0.1, length=1.0, at=0.3)
    resting = step_response(sampled().wired, "controller.u", size=0.1, length=1.0)
    np.testing.assert_allclose(moving.v, resting.v, atol=1e-13)
    assert moving.moved > 0.1
    assert resting.moved == 0.0


def test_a_saturation_makes_the_run_differ_from_its_prediction():
    lag = Integrator(name="lag")

    @subsystem(sample_time=0.01)
    def controller(y):
        return Saturation(limit=0.05, name="limit")(Gain(gain=3.0, name="gain")(0.0 - y)).named("u")

    diagram = Diagram("limited", lag(controller(lag.y)))
    small, large = (
        step_response(diagram.wired, "controller.u", size=size, length=2.0, outputs=["controller.limit.excess"])
        for size in (0.01, 0.2)
    )
    np.testing.assert_allclose(small.v, small.prediction[:, 0], atol=1e-13)
    assert np.all(small.y == 0.0)
    assert np.max(np.abs(large.v - large.prediction[:, 0])) > 0.1
    assert np.max(np.abs(large.y)) > 0.1


def test_an_unstable_loop_ends_where_it_has_grown_and_names_the_wire():
    with pytest.raises(SimulationError, match=r"controller\..*grown to .* after a step of 0.1.*not stable there"):
        step_response(sampled(gain=400.0).wired, "controller.u", size=0.1, length=15.0)


def test_a_wire_with_several_entries_asks_for_one():
    place = Integrator(initial_value=[0.0, 0.0], name="place")
    diagram = Diagram("two", place(Gain(gain=-1.0, name="law")(place.y).named("u")))
    with pytest.raises(OptionError, match=r"found 2 entries; expected one. Name one of them: u\[1\]"):
        step_response(diagram.wired, "u", size=0.1, length=1.0)
    with pytest.raises(OptionError, match="size: found 0"):
        step_response(spring().wired, "u", size=0, length=1.0)
    found = step_response(diagram.wired, "u[1]", size=0.1, length=5.0)
    np.testing.assert_allclose(found.answer(), 1 - np.exp(-found.t), atol=1e-7)


@pytest.mark.one_tier
@pytest.mark.parametrize(
    ("length", "tiers"), [(3.0, {"interpreted"}), pytest.param(20.0, {"compiled"}, marks=pytest.mark.slow)]
)
def test_a_long_run_with_a_solver_goes_in_c(length, tiers, monkeypatch):
    """Its parts are short, and each alone begins with no C; the response is 1 − 0.97^k, that of x⁺ = 0.97 x + 0.03."""
    found = []

    class Watched(injection.Simulation):
        def run(self, **options):
            run = super().run(**options)
            found.append(run.tier)
            return run

    monkeypatch.setattr(injection, "Simulation", Watched)
    response = step_response(sampled().wired, "u", size=0.1, length=length)
    assert set(found[1:]) == tiers
    np.testing.assert_allclose(response.answer()[1:], 1 - 0.97 ** np.arange(len(response.t) - 1), atol=1e-9)


def two_lags(share=0.5, fast=1e-3, slow=4.325e-3):
    """1 − y = (1 − a) exp(−t/τ₁) + a exp(−t/τ₂), and the time at which it is 0.02."""

    def left(t):
        return (1 - share) * np.exp(-t / fast) + share * np.exp(-t / slow)

    begin = 0.0 if share > 0 else 5 * fast  # the fast part is over, and the slow one is beyond its final value
    return left, brentq(lambda t: abs(left(t)) - 0.02, begin, 100 * slow, xtol=1e-16)


@pytest.mark.parametrize("share", [0.5, 0.1, -0.1])
@pytest.mark.parametrize("slow", [2e-3, 4.325e-3, 8e-3, 0.05])
def test_a_settling_time_holds_what_the_tail_does_after_the_record(share, slow):
    left, settled = two_lags(share, fast=5e-4, slow=slow)
    t = np.linspace(0.0, 0.02, 1001)
    found = measure_step(t, 3.0 * (1 - left(t)), held=False, slowest=1 / slow)
    value, tolerance = found["settling"]
    assert np.isnan(value) or abs(value - settled) <= tolerance
    for name, exact in (("final", 3.0), ("overshoot", 0.0 if share > 0 else None)):
        value, tolerance = found[name]
        assert exact is None or np.isnan(value) or abs(value - exact) <= tolerance
    assert abs(found["peak"].value - np.max(np.abs(3.0 * (1 - left(t))))) == 0.0
    if slow < 0.004:
        assert found["settling"].tolerance < 1e-4


def test_with_the_linear_model_beside_it_a_slow_tail_costs_no_accuracy():
    """Half of the answer has a time constant of 4.3 ms: at 20 ms, the end, 0.5 % of it are still to come."""
    left, settled = two_lags()
    wish = Constant(value=0.0, name="wish").named("w")
    fast = TransferFunction(numerator=[0.5], denominator=[1e-3, 1.0], name="fast")
    slow = TransferFunction(numerator=[0.5], denominator=[4.325e-3, 1.0], name="slow")
    diagram = Diagram("two", Sum(signs="++", name="sum")(fast(wish), slow(wish)).named("y"))
    got = step_response(diagram.wired, "w", size=0.1, length=0.02, outputs=["y"])
    expected = got.expected(1, got.size)
    np.testing.assert_allclose(expected.response, 1 - left(got.t), atol=1e-12)
    assert expected.low == pytest.approx(1 - left(got.t[-1] + got.dt), rel=1e-9)
    assert (expected.high, expected.final) == pytest.approx((1.0, 1.0), rel=1e-9)
    assert settled == pytest.approx(13.92e-3, rel=1e-3)
    found = measure_step(got.t, got.answer(True), held=False, expected=expected, slowest=1 / 4.325e-3)
    for numbers in (found, measure_step(got.t, expected.response, held=False, expected=expected)):
        value, tolerance = numbers["settling"]
        assert abs(value - settled) <= tolerance < 3 * got.dt
        value, tolerance = numbers["final"]
        assert abs(value - 1.0) <= tolerance < 1e-6


@pytest.mark.parametrize("samples", [20, 50, 1000])
@pytest.mark.slow
def test_what_lies_between_the_samples_is_in_the_tolerance_of_a_peak(samples):
    """The answer of T = (3 s + 40)/(s² + 3 s + 40) has its peak where its slope is zero."""
    s = control.tf("s")
    length = 8.0
    t = np.linspace(0.0, length, samples * 200 + 1)
    _, exact = control.step_response((3 * s + 40) / (s**2 + 3 * s + 40), t)
    peak, sampled_values = np.max(exact), exact[::200]
    found = measure_step(t[::200], sampled_values, held=False)["peak"]
    assert 0.0 < peak - found.value <= found.tolerance
    if samples > 20:
        assert found.tolerance < 20 * (2 * np.pi / samples) ** 2


def test_the_linear_model_knows_a_peak_between_the_samples():
    got = step_response(spring().wired, "u", size=0.1, length=8.0)
    fine = np.linspace(0.0, 8.0, 64 * (len(got.t) - 1) + 1)
    s = control.tf("s")
    _, exact = control.step_response((3 * s + 40) / (s**2 + 3 * s + 40), fine)
    assert got.between[0] == pytest.approx(0.1 * (np.max(exact) - np.max(exact[::64])), rel=1e-6)
    found = measure_step(got.t, got.v, held=got.is_steady(0), expected=got.expected(0), accuracy=1e-7)["peak"]
    assert 0.0 < 0.1 * np.max(exact) - found.value <= found.tolerance < 1e-5


def test_a_mode_that_lasts_less_than_a_sample_is_seen_by_the_linear_model():
    """y = exp(−t/ε) − exp(−t) with ε = 1e-7: it comes to −1, from 1, within the first sample."""
    wish = Constant(value=0.0, name="wish").named("w")
    fast = TransferFunction(numerator=[1e-7, 0.0], denominator=[1e-7, 1.0], name="fast")
    lead = TransferFunction(numerator=[1e-5, 0.0], denominator=[1e-5, 1.0], name="lead")
    slow = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="slow")
    diagram = Diagram("stiff", Sum(signs="-+-", name="sum")(fast(wish), lead(wish), slow(wish)).named("y"))
    got = step_response(diagram.wired, "w", size=1.0, length=5.0, outputs=["y"])
    t = np.geomspace(1e-9, 1e-3, 20001)
    peak = np.max(np.abs(-np.exp(-t / 1e-7) + np.exp(-t / 1e-5) - (1 - np.exp(-t))))
    found = np.max(np.abs(got.prediction[:, 1])) + got.between[1]
    assert found == pytest.approx(max(peak, 1 - np.exp(-5.0)), rel=0.05)


def test_held_signals_have_no_peak_between_the_samples():
    got = step_response(sampled().wired, "controller.u", size=0.1, length=1.0, outputs=["lag.y", "controller.gain.y"])
    assert got.steady.tolist() == [True, False, True]
    found = measure_step(got.t, got.v, held=got.is_steady(0), expected=got.expected(0))["peak"]
    assert found.tolerance <= 0.1 * 0.97 ** (len(got.t) - 2) + 1e-9  # what is still to come


def test_a_step_of_the_diagrams_own_source_does_not_meet_the_added_one():
    """y' = 10 (r − y) within ±1 from rest, with a step of 0.5 at r: y = t to 0.4, then 0.5 − 0.1 e^(−10 (t − 0.4))."""
    place = Integrator(name="place")
    wanted = Step(times=0.1, values=2.0, name="wanted")
    pull = Saturation(lower=-1.0, upper=1.0, name="limits")(Gain(gain=10.0, name="kp")(wanted.y - place.y))
    found = step_response(Diagram("slide", place(pull)).wired, "wanted.y", size=0.5, length=1.0, outputs=["place.y"])
    t = found.t - found.t[0]
    expected = np.where(t < 0.4, t, 0.5 - 0.1 * np.exp(-10.0 * (t - 0.4)))
    np.testing.assert_allclose(found.y[:, 0], expected, atol=2e-8)
    assert found.moved == 0.0
