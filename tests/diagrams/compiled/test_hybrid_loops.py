"""Algebraic loops beside continuous states in C: closed forms, and SciPy with the loop solved by hand."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from loopwright.blocks import Clock, Function, Gain, Integrator, Relay, Sum
from loopwright.diagrams import Diagram, subsystem

QUIET = {"progress": False}


def cubic():
    """x' = −v with the root v of v + v³ = x: dv/dt = −v / (1 + 3 v²), so that ln v + 1.5 v² = ln v₀ + 1.5 v₀² − t."""
    x = Integrator(name="x", initial_value=2.0)
    root = Sum(signs="+-", name="root")
    cube = Function(lambda v: v**3, name="cube")
    closing = root(x.y, cube(root.y))
    return Diagram("cubic", x(Gain(gain=-1.0, name="down")(closing)), loops="solve")


@pytest.mark.parametrize(("solver", "bound"), [("RK45", 1e-7), ("DOP853", 5e-7), ("Radau", 1e-7), ("rk4", 1e-8)])
def test_a_loop_in_the_rates_is_that_of_the_closed_form(solver, bound):
    run = cubic().simulate(3.0, step=0.01, solver=solver, rtol=1e-8, atol=1e-10, compile=True, **QUIET)
    assert not any(m.startswith("Interpreted") for m in run.messages)
    v = run["root.y"]
    invariant = np.log(v) + 1.5 * v**2 + run.t
    assert np.max(np.abs(v + v**3 - run["x.y"])) < 1e-12
    assert np.max(np.abs(invariant - invariant[0])) < bound
    usual = cubic().simulate(3.0, step=0.01, solver=solver, rtol=1e-8, atol=1e-10, **QUIET)
    assert np.max(np.abs(run.data - usual.data)) < 1e-10


def test_a_stiff_system_with_a_loop_has_its_slope_through_the_loop():
    """x' = −1e4 (x − cos t) by a loop of gain 1/2: u = −5e3 (x − cos t) + u / 2."""
    x = Integrator(name="x", initial_value=0.0)
    wave = Function(lambda t: np.cos(t), name="wave")(Clock())
    rate = Sum(signs="++", name="rate")
    closing = rate(Gain(gain=-5e3, name="pull")(x.y - wave), Gain(gain=0.5, name="half")(rate.y))
    made = Diagram("d", x(closing), loops="solve")
    options = {"step": 0.05, "solver": "Radau", "rtol": 1e-7, "atol": 1e-9}
    usual = made.simulate(5.0, **options, **QUIET)
    with made.simulation(compile=True, **options) as simulation:
        simulation.advance(5.0)
        steps, rejected, _, slopes = simulation._engine._ticks._loop.counts
        run = simulation.run()
    a = 1e4
    exact = a * (a * np.cos(run.t) + np.sin(run.t)) / (a * a + 1.0)
    errors = [np.max(np.abs(r["x.y"] - exact)[1:]) for r in (usual, run)]
    assert errors[1] < min(1.05 * errors[0], 5e-5)
    assert (steps, rejected, slopes) < (200, 10, 20)  # Newton's method has the slope of the whole


def root_of(x):
    """The root v of v + v³ = x."""
    return brentq(lambda v: v + v**3 - x, -10.0, 10.0, xtol=1e-15, rtol=1e-14)


def heated(end):
    """Times of the relay's events, and x at samples each 0.05 s: x' = 2 h − v, h is 1 below v = 0.7 until v = 0.9."""
    t, x, on, told, found = 0.0, 2.0, False, [], []
    samples = 0.05 * np.arange(round(end / 0.05) + 1)
    while True:
        level = 0.9 if on else 0.7
        reach = lambda t, x, at=level: root_of(x[0]) - at  # noqa: E731
        reach.terminal, reach.direction = True, 1.0 if on else -1.0
        rates = lambda t, x, h=on: [2.0 * h - root_of(x[0])]  # noqa: E731
        done = solve_ivp(rates, (t, end), [x], "DOP853", dense_output=True, events=reach, rtol=1e-12, atol=1e-13)
        last = done.t[-1] if done.status else np.inf
        found += [done.sol(at)[0] for at in samples[(samples >= t) & (samples < last)]]
        if not done.status:
            return told, np.array(found)
        t, x, on = last, done.y[0, -1], not on
        told.append((t, "rise" if on else "fall"))


def test_events_and_ticks_beside_a_loop_are_those_of_scipy():
    @subsystem(sample_time=0.05, name="box")
    def box(u):
        return Gain(gain=0.5)(u)

    x = Integrator(name="x", initial_value=2.0)
    root = Sum(signs="+-", name="root")
    closing = root(x.y, Function(lambda v: v**3, name="cube")(root.y))
    down = Gain(gain=-1.0, name="down")(closing)
    low = Relay(on_point=-0.7, off_point=-0.9, on_value=2.0, name="low")(down)
    made = Diagram("d", x(down + low), Gain(gain=1.0)(box(closing)), loops="solve")
    told, x = heated(5.0)
    assert len(told) >= 5
    for form in (False, True):
        run = made.simulate(5.0, compile=form, rtol=1e-8, atol=1e-10, **QUIET)
        assert not any(m.startswith("Interpreted") for m in run.messages)
        assert [(e.block, e.event) for e in run.events] == [("low", event) for _, event in told]
        assert np.max(np.abs(np.array([e.t for e in run.events]) - [t for t, _ in told])) < 1e-7
        assert np.max(np.abs(run["x.y"] - x)) < 1e-7
        assert np.max(np.abs(run["box.gain.y"] - [0.5 * root_of(value) for value in x])) < 1e-7
