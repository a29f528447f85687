"""A multistep method starts again after each event; its first step must not find the same crossing once more."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Compare,
    Counter,
    Event,
    Gain,
    Integrator,
    PulseTrain,
    Relay,
    State,
    Step,
    TransportDelay,
    parameter,
)
from loopwright.diagrams import Diagram
from loopwright.diagrams.solvers import Problem, make_solver
from support.hybrid_blocks import Lag
from support.work_in_c import simulate_counted


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
@pytest.mark.drawn(2)
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
@pytest.mark.drawn(2)
def test_the_dense_output_leaves_the_start_of_a_step_along_the_rates(name):
    """ẍ = −x: within 1e-12 of a step, x is x₀ + t f(x₀) to the last bit."""
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    problem = Problem(2, lambda t, x: turn @ x, lambda t, x: turn, ["x", "v"])
    solver = make_solver(name, problem, rtol=1e-9, atol=1e-9)
    x, steps = np.array([1.0, 0.0]), 0
    solver.restart(0.25, x, 12.25)
    while True:
        step = solver.step()
        h = step.t - step.t_old
        for part in (0.0, 1e-14, 1e-13, 1e-12):
            t = step.t_old + h * part
            line = x + (t - step.t_old) * (turn @ x)
            assert np.all(np.abs(step.prepare()(t) - line) <= np.spacing(np.abs(x)) + 1e-16 * h)
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


# --- rounding errors of an indicator, of a size that is given ---------------------------------------------------------


class Crossed(Block):
    """A block whose event is followed by short steps: a state moves, as long as ``restart`` in s, and comes to rest."""

    at: float = parameter(default=1.0)
    slope: float = parameter(default=1.0)
    size: float = parameter(default=0.0)
    restart: float = parameter(default=1.0)
    y = State()
    moves = State(discrete=True)
    since = State(discrete=True)
    cross = Event("both")

    def derivative(self, t, x, u):
        return 1e-6 * x.moves * np.exp(-np.maximum(t - x.since, 0.0) / self.restart) / self.restart + 0.0 * x.y

    def indicators(self, t, x, u):
        rounding = np.sin(1e17 * t + self.at)  # of most instants that are next to one another independent
        return self.slope * (t - self.at) + self.size * rounding

    def jump(self, t, x, u, fired):
        return x.y, 1.0 + 0.0 * x.moves, t + 0.0 * x.since


class Twice(Crossed):
    """The indicator comes back through zero soon after."""

    apart: float = parameter(default=0.1)

    def indicators(self, t, x, u):
        return (t - self.at) * ((self.at + self.apart) - t) + self.size * np.sin(1e17 * t + self.at)


def crossings(block, begin, end):
    """Return the events of a run, in which one step goes from ``begin`` towards ``end``, and short ones from an event."""
    bounds = Step(times=[begin, end], values=[1.0, 2.0], name="bounds")
    duration = float(np.ceil(end))
    run, work = simulate_counted(Diagram("d", block, bounds), duration, step=duration, solver="RK45")
    assert work.steps < 60
    return [e.t for e in run.events]


@pytest.mark.parametrize("size", [3e-16, 3e-13])
@pytest.mark.parametrize("restart", [1e-12, 1e-9, 1e-6, 1e-3, 0.1])
@pytest.mark.drawn(2)
def test_an_indicator_with_rounding_errors_crosses_zero_once_however_short_the_next_step_is(restart, size):
    for seed in range(8):
        draw = np.random.default_rng(seed)
        at, slope = 10.0 ** draw.uniform(-1.0, 1.5), draw.choice([-1.0, 1.0]) * 10.0 ** draw.uniform(-3.0, 1.0)
        block = Crossed(at=at, slope=slope, size=size, restart=restart, name="crossed")
        found = crossings(block, at - 0.3 * min(1.0, at), at + 1.0)
        assert found == pytest.approx([at], rel=1e-15, abs=2.0 * size / abs(slope) + 1e-14), seed


@pytest.mark.parametrize("apart", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("restart", [1e-9, 1e-6, 0.1])
@pytest.mark.drawn(1)
def test_a_second_crossing_soon_after_is_found(restart, apart):
    """(t − a)(a + d − t), with errors of 1e-12 d²: the second one is where it is to 1e-12 d, and to ulps of the time."""
    for seed in range(5):
        at = 10.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0)
        block = Twice(at=at, apart=apart, size=1e-12 * apart**2, restart=restart, name="twice")
        found = crossings(block, at - 0.1 * apart, at + 10.0 * apart)  # both are in the same step
        assert found == pytest.approx([at, at + apart], abs=1e-11 * apart + 1e-13)


class Angle(Block):
    """ẍ = −x: the cosine of its phase, with an error as rounding makes it, against a level."""

    level: float = parameter(default=0.3)
    x = State(start=1.0, output=True)
    v = State(start=0.0, output=True)
    cross = Event("both")

    def derivative(self, t, x, u):
        return x.v, -x.x

    def indicators(self, t, x, u):
        return x.x / np.sqrt(x.x * x.x + x.v * x.v) - self.level + 2e-15 * np.sin(3e16 * t)

    def jump(self, t, x, u, fired):
        return x.x, x.v


@pytest.mark.parametrize("compiled", ["auto", True])
@pytest.mark.parametrize(
    "solver", ["auto", "RK45", "DOP853", "Radau", "rk4", "BDF", "LSODA", "CVODE_Adams", "CVODE_BDF"]
)
@pytest.mark.drawn(2)
def test_the_phase_of_an_oscillator_crosses_a_level_twice_a_turn(solver, compiled):
    for level in (0.3, 0.99):
        for rtol in (1e-5, 1e-8):
            options = {"solver": solver, "rtol": rtol, "step": 0.05, "compile": compiled}
            run = Diagram("d", Angle(level=level, name="angle")).simulate(32.0, progress=False, **options)
            turns = 2 * np.pi * np.arange(6)
            expected = np.sort(np.concatenate([turns + np.arccos(level), turns - np.arccos(level)]))
            expected = expected[(expected > 0.0) & (expected < 32.0)]
            assert [e.t for e in run.events] == pytest.approx(expected.tolist(), abs=0.02)
