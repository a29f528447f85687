"""Algebraic loops beside continuous states in C: closed forms, and the numbers of interpreted runs."""

import numpy as np
import pytest

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
        steps, rejected, _, slopes = simulation._engine._compiled._loop.counts
        run = simulation.run()
    a = 1e4
    exact = a * (a * np.cos(run.t) + np.sin(run.t)) / (a * a + 1.0)
    errors = [np.max(np.abs(r["x.y"] - exact)[1:]) for r in (usual, run)]
    assert errors[1] < min(1.05 * errors[0], 5e-5)
    assert (steps, rejected, slopes) < (200, 10, 20)  # Newton's method has the slope of the whole


def test_events_and_ticks_beside_a_loop_have_the_numbers_of_an_interpreted_run():
    @subsystem(sample_time=0.05, name="box")
    def box(u):
        return Gain(gain=0.5)(u)

    x = Integrator(name="x", initial_value=2.0)
    root = Sum(signs="+-", name="root")
    closing = root(x.y, Function(lambda v: v**3, name="cube")(root.y))
    down = Gain(gain=-1.0, name="down")(closing)
    low = Relay(on_point=-0.7, off_point=-0.9, on_value=2.0, name="low")(down)
    made = Diagram("d", x(down + low), Gain(gain=1.0)(box(closing)), loops="solve")
    runs = [made.simulate(5.0, compile=form, rtol=1e-8, atol=1e-10, **QUIET) for form in (False, True)]
    assert not any(m.startswith("Interpreted") for m in runs[1].messages)
    assert [(e.block, e.event) for e in runs[0].events] == [(e.block, e.event) for e in runs[1].events]
    assert np.max(np.abs(np.array([e.t for e in runs[0].events]) - [e.t for e in runs[1].events])) < 1e-9
    assert np.max(np.abs(runs[0].data - runs[1].data)) < 1e-8
