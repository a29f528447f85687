"""A multistep method starts again after each event; its first step must not find the same crossing once more."""

import numpy as np
import pytest

from loopwright.blocks import Compare, Counter, Gain, Integrator, PulseTrain, Relay, TransportDelay
from loopwright.diagrams import Diagram
from loopwright.diagrams.solvers import Problem, make_solver
from support.hybrid_blocks import Lag


def oscillator(level, start=(1.0, 0.0)):
    """ẍ = −x, and how often x rises above a level."""
    x, v = Integrator(name="x", initial_value=start[0]), Integrator(name="v", initial_value=start[1])
    position = x(v.y)
    return Diagram("oscillator", v(-position.y), Counter(name="n")(Compare(">", name="c")(position.y, level)))


@pytest.mark.parametrize(
    ("solver", "level", "start", "options"),
    [
        ("CVODE_Adams", 0.9, (1.0, 0.0), {"rtol": 1e-7}),
        ("CVODE_Adams", 0.99, (1.0, 0.0), {"rtol": 1e-9}),
        ("CVODE_Adams", 0.99, (0.0, 1.0), {"rtol": 1e-10, "atol": 1e-10}),
        ("CVODE_BDF", 0.99, (1.0, 0.0), {"rtol": 1e-10, "atol": 1e-10}),
    ],
)
def test_a_crossing_is_counted_once(solver, level, start, options):
    run = oscillator(level, start).simulate(24.0, solver=solver, progress=False, **options)
    phase = np.arctan2(start[1], start[0])  # x = cos(t − phase)
    rises = phase - np.arccos(level) + 2 * np.pi * np.arange(6)
    falls = phase + np.arccos(level) + 2 * np.pi * np.arange(6)
    expected = np.sort([t for t in (*rises, *falls) if 0.0 < t < 24.0])
    found = [e.t for e in run.events if e.block == "c"]
    assert len(found) == len(expected)
    assert found == pytest.approx(expected, abs=1e4 * options["rtol"])
    assert run["n.y"][-1] == sum(0.0 < t < 24.0 for t in rises)


@pytest.mark.parametrize("name", ["BDF", "LSODA", "CVODE_BDF", "CVODE_Adams"])
def test_the_dense_output_leaves_the_start_of_a_step_along_the_rates(name):
    """ẍ = −x: within 1e-12 of a step, x is x₀ + t f(x₀) to the last bit."""
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    problem = Problem(2, lambda t, x: turn @ x, lambda t, x: turn, ["x", "v"])
    solver = make_solver(name, problem, rtol=1e-9, atol=1e-9, step=1.0, max_step=None)
    x, steps = np.array([1.0, 0.0]), 0
    solver.restart(0.25, x, 12.25)
    while True:
        step = solver.step()
        h = step.t - step.t_old
        for part in (0.0, 1e-14, 1e-13, 1e-12):
            t = step.t_old + h * part
            line = x + (t - step.t_old) * (turn @ x)
            assert np.all(np.abs(step.interpolate(t) - line) <= np.spacing(np.abs(x)) + 1e-16 * h)
        x, steps = step.x, steps + 1
        if step.t == 12.25:
            break
    assert steps > 100


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", ["LSODA", "BDF", "CVODE_BDF", "CVODE_Adams", "auto"])
def test_rounding_of_an_indicator_itself_fires_nothing(solver):
    """A delay's output is interpolated: just after a crossing it may be an ulp on the other side again."""
    lag, relay = Lag(name="lag", k=1.5), Relay(name="relay", on_point=0.45, off_point=0.3)
    late = TransportDelay(delay=0.23, name="late")(lag.y)
    heat = 1.0 - relay(late) + PulseTrain(period=0.77, amplitude=0.2)
    diagram = Diagram("d", lag(heat + Gain(gain=0.1, name="k")(late)))
    for rtol in (1e-5, 1e-6, 1e-7):
        run = diagram.simulate(6.0, step=0.1, solver=solver, rtol=rtol, progress=False)
        assert [e.event for e in run.events] == ["rise", "fall"] * (len(run.events) // 2) + ["rise"] * (
            len(run.events) % 2
        )
        assert np.min(np.diff([e.t for e in run.events])) > 0.23
