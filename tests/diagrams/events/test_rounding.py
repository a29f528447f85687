"""A multistep method starts again after each event; its first step must not find the same crossing once more."""

import hashlib
import struct

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
    TransportDelay,
    parameter,
)
from loopwright.diagrams import Diagram
from loopwright.diagrams.events import Domains, evaluate_many
from loopwright.diagrams.solvers import AcceptedStep, Problem, make_solver
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


# --- rounding errors of an indicator, of a size that is given ---------------------------------------------------------


class Watched(Block):
    """A block with an event, of which `crossings` takes the place of the indicator."""

    x = State()
    cross = Event("both")

    def derivative(self, t, x, u):
        return 0.0 * x.x

    def indicators(self, t, x, u):
        return x.x

    def jump(self, t, x, u, fired):
        return x.x


def crossings(indicator, begin, end, restart):
    """Return the events that the search finds: in one step first, after each in steps that grow from a short one."""
    opened = np.ones(1)

    def g(t, x):
        return np.array([indicator(t)])

    def many(times, states):
        return evaluate_many(g, opened, times, states)

    flat = Diagram("d", Watched(name="watched")).flatten(10.0)
    domains = Domains(flat, g, many, lambda t, x: np.zeros(1), opened, 10.0)
    domains.begin(begin, np.zeros(1))
    t, h, found = begin, end - begin, []
    while t < end:
        step = AcceptedStep(t, min(t + h, end), np.zeros(1), lambda: lambda time: np.zeros(1))
        event = domains.locate(step)
        if event is None:
            t, h = step.t, 4.0 * h
            continue
        t, fired = event
        found.append(t)
        domains.count(t, np.zeros(1), fired)
        assert not domains.update(t, np.zeros(1)).any()
        h = restart
    return found


def rounding(size, seed):
    """Return an error up to a size, independent at any two instants, always the same at one."""

    def error(t):
        digest = hashlib.blake2b(struct.pack("dq", t, seed), digest_size=8).digest()  # quicker than a generator
        return size * (int.from_bytes(digest, "little") / 2**63 - 1.0)

    return error


@pytest.mark.parametrize("size", [3e-16, 3e-13])
@pytest.mark.parametrize("restart", [1e-12, 1e-9, 1e-6, 1e-3, 0.1])
def test_an_indicator_with_rounding_errors_crosses_zero_once_however_short_the_next_step_is(restart, size):
    for seed in range(40):
        draw = np.random.default_rng(seed)
        at, slope = 10.0 ** draw.uniform(-1.0, 1.5), draw.choice([-1.0, 1.0]) * 10.0 ** draw.uniform(-3.0, 1.0)
        error = rounding(size, seed)
        begin = at - 0.3 * min(1.0, at)
        found = crossings(lambda t, a=at, s=slope, e=error: s * (t - a) + e(t), begin, at + 1.0, restart)
        assert found == pytest.approx([at], rel=1e-15, abs=2.0 * size / abs(slope) + 1e-14), seed


@pytest.mark.parametrize("apart", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("restart", [1e-9, 1e-6, 0.1])
def test_a_second_crossing_soon_after_is_found(restart, apart):
    """(t − a)(a + d − t), with errors of 1e-12 d²: the second one is where it is to 1e-12 d, and to ulps of the time."""
    for seed in range(5):
        at = 10.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0)
        error = rounding(1e-12 * apart**2, seed)
        begin = at - 0.1 * apart  # the next crossing is in the same step
        found = crossings(
            lambda t, a=at, e=error: (t - a) * ((a + apart) - t) + e(t), begin, at + 10.0 * apart, restart
        )
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


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(
    "solver", ["auto", "RK45", "DOP853", "Radau", "rk4", "BDF", "LSODA", "CVODE_Adams", "CVODE_BDF"]
)
@pytest.mark.drawn(6)
def test_the_phase_of_an_oscillator_crosses_a_level_twice_a_turn(solver, compiled):
    for level in (0.3, 0.99):
        for rtol in (1e-5, 1e-8):
            options = {"solver": solver, "rtol": rtol, "step": 0.05, "compile": compiled}
            run = Diagram("d", Angle(level=level, name="angle")).simulate(32.0, progress=False, **options)
            turns = 2 * np.pi * np.arange(6)
            expected = np.sort(np.concatenate([turns + np.arccos(level), turns - np.arccos(level)]))
            expected = expected[(expected > 0.0) & (expected < 32.0)]
            assert [e.t for e in run.events] == pytest.approx(expected.tolist(), abs=0.02)
