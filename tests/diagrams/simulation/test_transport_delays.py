"""Transport delays in continuous time, by the method of steps, and in sampled boxes."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    Function,
    Gain,
    Integrator,
    OptionError,
    PulseTrain,
    SampleTimeError,
    Saturation,
    ShapeError,
    SimulationError,
    Sine,
    Step,
    Sum,
    TransportDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, mass_spring_damper
from support.hybrid_blocks import TIGHT, Crossings, Lag
from support.work_in_c import simulate_counted


def delayed_feedback(tau=0.25, gain=1.0, initial=0.0):
    """Ẏ = 1 − gain y(t − τ)."""
    i = Integrator(name="i")
    late = TransportDelay(delay=tau, initial_value=initial, name="late")
    return Diagram("loop", i(1.0 - Gain(gain=gain, name="g")(late(i.y))))


def method_of_steps(t, tau=0.25, gain=1.0):
    """Return y of ẏ = 1 − gain y(t − τ), y = 0 before the start: Σ (−gain)ᵏ (t − kτ)₊ᵏ⁺¹ / (k + 1)!."""
    t = np.asarray(t)
    terms = ((-gain) ** k * np.clip(t - k * tau, 0, None) ** (k + 1) / math.factorial(k + 1) for k in range(60))
    return sum(terms)


@pytest.mark.slow
def test_a_delay_in_a_loop_is_the_method_of_steps():
    run = delayed_feedback().simulate(5.0, step=0.01, **TIGHT)
    assert np.max(np.abs(run["i.y"] - method_of_steps(run.t))) < 1e-11


@pytest.mark.slow
@pytest.mark.drawn(3)
@pytest.mark.parametrize("solver", ["RK45", "Radau", "BDF", "LSODA", "CVODE_BDF", "auto"])
def test_every_solver_meets_its_tolerance_with_a_delay(solver):
    run = delayed_feedback(gain=4.0).simulate(3.0, step=0.01, rtol=1e-8, atol=1e-10, solver=solver, progress=False)
    assert np.max(np.abs(run["i.y"] - method_of_steps(run.t, gain=4.0))) < 2e-6


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("solver", "order"), [("rk4", 4), ("heun", 2), ("euler", 1)])
def test_a_fixed_step_keeps_its_order_with_a_delay_that_is_no_multiple_of_it(solver, order):
    errors, n = [], (30, 60, 120)
    for steps in n:
        run = delayed_feedback(tau=0.37, gain=2.0).simulate(3.0, step=3.0 / steps, solver=solver, progress=False)
        errors.append(np.max(np.abs(run["i.y"] - method_of_steps(run.t, tau=0.37, gain=2.0))))
    assert -np.polyfit(np.log(n), np.log(errors), 1)[0] == pytest.approx(order, abs=0.45)


def test_a_smooth_signal_comes_out_as_it_went_in():
    run = Diagram("d", Integrator(name="i")(TransportDelay(delay=0.3, name="late")(Sine(frequency=1.0)))).simulate(
        2.0, step=0.01, **TIGHT
    )
    s = np.clip(run.t - 0.3, 0, None)
    assert np.max(np.abs(run["late.y"] - np.where(run.t < 0.3 - 1e-9, 0, np.sin(2 * np.pi * s)))) < 1e-9
    assert np.max(np.abs(run["i.y"] - (1 - np.cos(2 * np.pi * s)) / (2 * np.pi))) < 1e-10


def test_a_step_comes_out_at_its_time_sharply():
    late = TransportDelay(delay=0.3, name="late")(Step(times=(0.25, 0.35), values=(1.0, -2.0)))
    run = Diagram("d", Integrator(name="i")(late)).simulate(1.0, step=0.01, solver="rk4", progress=False)
    expected = np.clip(run.t - 0.55, 0, None) - 3 * np.clip(run.t - 0.65, 0, None)
    assert np.max(np.abs(run["i.y"] - expected)) < 1e-13
    inner = np.min(np.abs(run.t[:, None] - [0.55, 0.65]), axis=1) > 1e-6
    late = np.select([run.t < 0.55, run.t < 0.65], [0.0, 1.0], -2.0)
    assert np.max(np.abs(run["late.y"] - late)[inner]) < 1e-14


@pytest.mark.drawn(1)
@pytest.mark.parametrize("frequency", [10.0, 1.0, 53.0])
def test_a_signal_that_is_faster_than_the_steps_of_the_solver_comes_out_as_it_went_in(frequency):
    """Nothing but the delay looks at the sine in the first second: the solver would go there in one step."""
    late = TransportDelay(delay=1.0, name="late")(Sine(frequency=frequency))
    run = Diagram("d", Integrator(name="i")(late)).simulate(3.0, step=0.25, rtol=1e-9, atol=1e-12, progress=False)
    s = np.clip(run.t - 1.0, 0, None)
    assert np.max(np.abs(run["late.y"] - np.sin(2 * np.pi * frequency * s))) < 1e-8
    assert np.max(np.abs(run["i.y"] - (1 - np.cos(2 * np.pi * frequency * s)) / (2 * np.pi * frequency))) < 1e-8


@pytest.mark.slow
def test_a_kink_of_what_goes_in_comes_out():
    """A saturated sine is no polynomial anywhere near its kinks."""
    late = TransportDelay(delay=0.7, name="late")(Saturation(lower=-0.5, upper=0.5)(Sine(frequency=3.0)))
    run = Diagram("d", Integrator(name="i")(late)).simulate(3.0, step=0.01, rtol=1e-9, progress=False)
    sine = np.sin(2 * np.pi * 3.0 * np.clip(run.t - 0.7, 0, None))
    assert np.max(np.abs(run["late.y"] - np.clip(sine, -0.5, 0.5))) < 5e-4


@pytest.mark.parametrize("smoothed", [True, False])
def test_discontinuities_are_landed_on_until_states_have_smoothed_them(smoothed):
    """Two delays would have quadratically many, two that feed through to each other do; a step ends at each, and at ticks.

    The start is a discontinuity: it comes out at all sums of the delays, up to the eighth derivative that jumps.
    """
    one, two = (TransportDelay(delay=d, name=n) for d, n in ((0.01, "one"), (0.0137, "two")))
    state = Integrator(name="state", initial_value=1.0)
    if smoothed:
        diagram = Diagram("d", state(-one(state.y) - two(state.y)))
    else:
        diagram = Diagram("d", two(one(0.5 * two.y + state.y)), state(Constant(value=0.0)))
    _, work = simulate_counted(diagram, 1.0, step=0.01, solver="euler")
    sums = ((i, k, 100 * i + 137 * k) for i in range(101) for k in range(74))
    edges = {s for i, k, s in sums if 0 < s <= 10_000 and (not smoothed or i + k <= 8)}
    assert work.steps == len(edges | {100 * k for k in range(1, 101)})


def test_pulses_keep_their_edges_through_two_delays():
    first, second = TransportDelay(delay=0.13, name="first"), TransportDelay(delay=0.31, name="second")
    wired = Integrator(name="i")(second(first(PulseTrain(period=0.5, duty=0.2, delay=0.1))))
    run = Diagram("d", wired).simulate(3.0, step=0.02, solver="heun", progress=False)
    expected = sum(np.clip(run.t - (0.54 + 0.5 * k), 0, 0.1) for k in range(6))
    assert np.max(np.abs(run["i.y"] - expected)) < 1e-13


def test_until_its_delay_has_passed_it_puts_out_its_initial_value():
    run = Diagram(
        "d", TransportDelay(delay=0.35, initial_value=7.0, name="late")(Clock()), Lag(name="l")(Constant(value=1.0))
    ).simulate(1.0, step=0.1, progress=False)
    assert np.allclose(run["late.y"], np.where(run.t < 0.35, 7.0, run.t - 0.35), atol=1e-14)


def test_without_an_initial_value_it_takes_its_first_input():
    first = TransportDelay(delay=0.25, initial_value=None, name="first")
    second = TransportDelay(delay=0.1, initial_value=None, name="second")
    wired = Integrator(name="i")(second(Gain(gain=2.0)(first(Clock() + 3.0))))
    run = Diagram("d", wired).simulate(1.0, step=0.05, **TIGHT)
    assert np.max(np.abs(run["second.y"] - 2 * (3 + np.clip(run.t - 0.35, 0, None)))) < 1e-12


def test_a_first_input_that_depends_on_the_output_is_an_error_that_asks_for_an_initial_value():
    late = TransportDelay(delay=0.25, initial_value=None, name="late")
    total = Sum(signs="++", name="total")
    with pytest.raises(SimulationError, match=r"late.*depends on its own output.*Give it an initial_value"):
        Diagram("d", late(total(late.y, 1.0))).simulate(1.0, step=0.1, progress=False)


def test_vectors_are_delayed_entry_by_entry():
    late = TransportDelay(delay=0.2, initial_value=(1.0, 2.0), name="late")
    run = Diagram("d", Integrator(initial_value=(0.0, 0.0), name="i")(late(Constant(value=(3.0, 5.0))))).simulate(
        1.0, step=0.1, **TIGHT
    )
    passed = np.clip(run.t - 0.2, 0, None)[:, None]
    assert (
        np.max(np.abs(run["i.y"] - (np.array([1.0, 2.0]) * (run.t[:, None] - passed) + np.array([3.0, 5.0]) * passed)))
        < 1e-13
    )


def test_a_held_signal_jumps_at_the_output_when_its_tick_has_passed():
    """A sampled controller behind a delay that is no multiple of its sample time; exact with rk4 on this polynomial."""

    @subsystem(sample_time=0.1)
    def box(t):
        return Gain(gain=1.0, name="g")(t)

    wired = Integrator(name="i")(TransportDelay(delay=0.07, name="late")(box(Clock())))
    run = Diagram("d", wired).simulate(1.0, step=0.05, solver="rk4", progress=False)

    def held(t):  # ∫ of the staircase
        k = np.floor(t / 0.1 + 1e-9)
        return 0.01 * k * (k - 1) / 2 + 0.1 * k * (t - 0.1 * k)

    assert np.max(np.abs(run["i.y"] - np.where(run.t > 0.07, held(np.clip(run.t - 0.07, 0, None)), 0))) < 1e-14


def test_an_event_of_a_delayed_signal_is_found():
    late = TransportDelay(delay=0.3, name="late")(Sine(frequency=1.0, phase=-0.5))
    run = Diagram("d", Crossings(name="c")(late)).simulate(2.0, step=0.05, rtol=1e-10, progress=False)
    phase = 0.5 / (2 * np.pi)
    # from its initial value 0 it falls: no crossing counts before it rises
    assert [e.t for e in run.events if e.t > 0.31] == pytest.approx(
        [0.3 + phase + k / 2 for k in range(4) if 0.3 + phase + k / 2 < 2], abs=1e-10
    )


def test_a_jump_goes_in_at_its_event_and_comes_out_a_delay_later():
    """A comparison of the time at an odd instant feeds a delay; the integral of what comes out has one kink."""
    wired = Integrator(name="i")(TransportDelay(delay=0.2, name="late")(Compare(">", name="c")(Clock(), 0.333)))
    run = Diagram("d", wired).simulate(1.0, step=0.1, solver="rk4", progress=False)
    assert np.max(np.abs(run["i.y"] - np.clip(run.t - 0.533, 0, None))) < 1e-14


def test_a_delay_behind_a_solved_loop_is_given_its_solution():
    """E + e³ = t; what comes out is e a quarter later."""
    cube = Function(lambda v: v**3, name="cube")
    e = Sum(signs="+-", name="e")
    late = TransportDelay(delay=0.25, name="late")
    wired = Integrator(name="i")(late(e(Clock(), cube(e.y))))
    run = Diagram("d", wired, loops="solve").simulate(4.0, step=0.1, **TIGHT)

    # with t(e) = e + e³ the integral of e over t is e²/2 + 3 e⁴/4
    def exact(t):
        if t <= 0:
            return 0.0
        v = brentq(lambda v: v + v**3 - t, 0, 5, xtol=1e-15)
        return v**2 / 2 + 3 * v**4 / 4

    assert np.max(np.abs(run["i.y"] - [exact(t - 0.25) for t in run.t])) < 1e-10


def test_three_delays_in_a_loop_with_multiples_that_differ_by_rounding_only():
    """0.1 + 0.2 is not 0.3: edges one rounding error apart do no harm."""
    i = Integrator(name="i", initial_value=1.0)
    delays = [TransportDelay(delay=0.1 * k, initial_value=1.0, name=f"late_{k}") for k in (1, 2, 3)]
    total = Sum(signs="---", name="total")
    wired = i(total(*(d(i.y) for d in delays)))
    run = Diagram("d", wired).simulate(1.0, step=0.1, **TIGHT)

    def course(h):  # trapezoidal rule, extrapolated below by Richardson's
        n = round(0.1 / h)
        past = lambda k: 1.0 if k <= 0 else y[k]  # noqa: E731
        y = [1.0]
        for k in range(round(1.0 / h)):
            rate = [-sum(past(k + j - m * n) for m in (1, 2, 3)) for j in (0, 1)]
            y.append(y[-1] + h * (rate[0] + rate[1]) / 2)
        return np.array(y)[::n]

    coarse, fine, finest = (course(0.1 / n) for n in (50, 100, 200))
    first, second = (4 * fine - coarse) / 3, (4 * finest - fine) / 3
    exact = (16 * second - first) / 15
    assert np.max(np.abs(run["i.y"] - exact)) < 1e-10


def test_a_nonlinear_delay_equation_agrees_with_scipy_by_steps():
    """Mackey and Glass's equation over three delays, integrated interval by interval with dense output."""
    i = Integrator(name="x", initial_value=0.5)
    late = TransportDelay(delay=2.0, initial_value=0.5, name="late")
    growth = Function(lambda v: 2.0 * v / (1.0 + v**9.65), name="growth")
    run = Diagram("mg", i(growth(late(i.y)) - i.y)).simulate(6.0, step=0.5, **TIGHT)
    pieces = [lambda t: 0.5]
    y, times, values = 0.5, [], []
    for k in range(3):
        before = pieces[-1]
        found = solve_ivp(
            lambda t, y, before=before: 2 * before(t - 2.0) / (1 + before(t - 2.0) ** 9.65) - y,
            (2.0 * k, 2.0 * k + 2),
            [y],
            "DOP853",
            dense_output=True,
            rtol=1e-12,
            atol=1e-13,
        )
        pieces.append(lambda t, f=found.sol: f(t)[0])
        y = found.y[0, -1]
        times += [2.0 * k + s for s in (0.5, 1.0, 1.5, 2.0)]
        values += [found.sol(t)[0] for t in times[-4:]]
    assert np.max(np.abs(run["x.y"][1:] - values)) < 1e-9


def test_a_delay_fed_by_an_fmu_sees_its_held_output():
    """The FMU's output is held from one communication point to the next; the integral is that of a staircase."""
    plant = Fmu(mass_spring_damper.build(), name="plant")
    port = next(iter(plant.outputs))
    late = TransportDelay(delay=0.025, name="late")
    wired = Integrator(name="i")(late(getattr(plant, port)))
    u = {name: Constant(value=1.0) for name in plant.inputs}
    run = Diagram("d", wired, plant(**u)).simulate(1.0, step=0.01, solver="rk4", progress=False)
    y, k = run[f"plant.{port}"], np.arange(101)
    area = np.concatenate([[0], np.cumsum(y[:-1] * 0.01)])  # ∫ of the held output up to tick k
    expected = np.where(k >= 3, 0.5 * (area[np.maximum(k - 3, 0)] + area[np.maximum(k - 2, 0)]), 0.0)
    assert np.max(np.abs(y)) > 0
    assert np.max(np.abs(run["i.y"] - expected)) < 1e-14


def test_in_a_sampled_box_it_is_a_delay_by_samples():
    @subsystem(sample_time=0.1)
    def box(t):
        return TransportDelay(delay=0.3, initial_value=-1.0, name="late")(t)

    run = Diagram("d", box(Clock()).named("y")).simulate(0.8, progress=False)
    assert np.allclose(run["y"], [-1, -1, -1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5], atol=1e-15)


def test_in_a_sampled_box_of_another_raster_it_is_refused_when_the_diagram_is_built():
    @subsystem(sample_time=0.1)
    def box(t):
        return TransportDelay(delay=0.25, name="late")(t)

    with pytest.raises(
        SampleTimeError, match=r"box\.late.*delay of 0\.25 s in a subsystem with a sample time of 0\.1 s"
    ):
        Diagram("d", box(Clock()))


def test_a_fixed_step_longer_than_the_delay_is_refused():
    with pytest.raises(OptionError, match=r"the step of 0\.5 s is longer than a transport delay of 0\.25 s"):
        delayed_feedback().simulate(5.0, step=0.5, solver="rk4", progress=False)


def test_an_initial_value_of_another_shape_is_refused():
    late = TransportDelay(delay=0.2, initial_value=(1.0, 2.0, 3.0), name="late")
    with pytest.raises(
        ShapeError, match=r"late\.initial_value: found an initial_value of shape \(3,\); expected \(2,\)"
    ):
        Diagram("d", late(Constant(value=(1.0, 2.0)))).simulate(1.0, step=0.1, progress=False)
