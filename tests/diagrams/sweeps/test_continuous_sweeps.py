"""Sweeps of diagrams with continuous states, events and algebraic loops: in threads, bound once, each a single run."""

import sys

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Event,
    Function,
    Gain,
    Integrator,
    Relay,
    SimulationError,
    Sine,
    State,
    Step,
    Sum,
    TransferFunction,
    UnitDelay,
    parameter,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.sweeps import bound_run
from loopwright.sweeps import Failure, final

QUIET = {"progress": False}


class Ball(Block):
    """A ball that leaves the floor with a fraction of its speed."""

    fraction: float = parameter(default=0.7)
    height = State(start=1.0, output=True)
    speed = State(start=0.0)
    bounce = Event(direction="falling")

    def derivative(self, t, x, u):
        return x.speed, 0.0 * x.speed - 9.81

    def indicators(self, t, x, u):
        return x.height

    def jump(self, t, x, u, fired):
        return 0.0 * x.height, -self.fraction * x.speed


class VanDerPol(Block):
    mu: float = parameter(default=1000.0)
    x = State(start=2.0, output=True)
    v = State(output=True)

    def derivative(self, t, x, u):
        return x.v, self.mu * (1.0 - x.x**2) * x.v - x.x


def controlled(source=None):
    """A PI controller at 100 Hz on two lags, with a jump at t = 0 and a relay beside it."""

    @subsystem(sample_time=0.01, name="controller")
    def controller(y, r):
        e = r - y
        total = UnitDelay(initial_value=0.0, name="total")
        total(total.y + 0.01 * e)
        return Gain(gain=2.0, name="kp")(e) + Gain(gain=5.0, name="ki")(total.y)

    lag = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="lag")
    wanted = source or Step(times=(0.0, 0.3), values=(1.0, 0.5), name="wanted")
    driven = lag(controller(lag.y, wanted))
    switch = Relay(on_point=0.6, off_point=0.4, name="switch")(lag.y)
    return Diagram("controlled", driven.named("y"), switch.named("s"))


def cubic():
    """x' = −g v with the root v of v + v³ = x."""
    x = Integrator(name="x", initial_value=2.0)
    root = Sum(signs="+-", name="root")
    closing = root(x.y, Function(lambda v: v**3, name="cube")(root.y))
    return Diagram("cubic", x(Gain(gain=-1.0, name="down")(closing)).named("y"), loops="solve")


def sampled_loop():
    """y = u − g y at every tick."""

    @subsystem(sample_time=0.01, name="box")
    def box(u):
        around = Function(lambda v, u: u - v, name="f")
        return around(Gain(gain=1.0, name="g")(around.y), u)

    return Diagram("loop", box(Sine(frequency=2.0, name="source")).named("y"), loops="solve")


CASES = {
    "controlled": (
        lambda: controlled(Step(times=(0.1, 0.3), values=(1.0, 0.5), name="wanted")),
        {"kp.gain": (2.0, 9.0), "wanted.values": ((1.0, 0.5), (0.3, 2.0)), "wanted.times": ((0.1, 0.3), (0.2, 0.25))},
        0.6,
        {},
    ),
    "a jump at the start": (controlled, {"kp.gain": (2.0, 9.0, 0.5)}, 0.3, {"solver": "Radau"}),
    "rk4": (controlled, {"lag.denominator": ([0.05, 1.0], [0.2, 1.0])}, 0.3, {"solver": "rk4"}),
    "a longest step": (
        lambda: controlled(Sine(frequency=1.0, name="w")),
        {"w.frequency": (1.0, 30.0, 2.0)},
        0.3,
        {"solver": "RK45"},
    ),
    "ball": (
        lambda: Diagram("b", Ball(name="ball").named("y")),
        {"ball.fraction": (0.7, 0.4, 0.8)},
        1.5,
        {"step": 0.1},
    ),
    "stiff": (
        lambda: Diagram("vdp", VanDerPol(name="of").x.named("y")),
        {"of.mu": (1000.0, 2.0, 500.0, 1000.0)},
        30.0,
        {"step": 1.0, "rtol": 1e-5, "atol": 1e-8},
    ),
    "loop in the rates": (cubic, {"down.gain": (-1.0, -3.0, -0.1)}, 1.0, {"step": 0.05}),
    "loop at ticks": (sampled_loop, {"g.gain": (1.0, 3.0, -0.5)}, 0.3, {}),
}


@pytest.mark.drawn(3)
@pytest.mark.parametrize("case", CASES)
def test_runs_that_follow_each_other_in_one_thread_have_the_bits_of_single_ones(case, monkeypatch):
    make, parameters, duration, options = CASES[case]
    made = make()
    bound = []
    begin = bound_run.BoundRun.begin
    monkeypatch.setattr(
        bound_run.BoundRun, "begin", lambda self, numbers: (bound.append(self), begin(self, numbers))[1]
    )
    found = made.sweep(
        parameters, duration, signals="y", reduce={"events": lambda run: len(run.events)}, workers=1, **options, **QUIET
    )
    assert len(set(map(id, bound))) == 1  # one set-up, which all runs share
    for sample, outcome in zip(found.samples, found.outcomes, strict=True):
        try:
            single = made.replace(sample.parameters).simulate(duration, compile=True, **options, **QUIET)
        except SimulationError as error:
            kind, block, port = type(error).__name__, error.block or "", error.port or ""
            failure = Failure(sample.index, kind, str(error), float(error.run.t[-1]), block, port)
        else:
            failure = None
        assert outcome.failure == failure
        if failure:
            continue
        assert outcome.signals["y"].tobytes() == single["y"].tobytes(), sample
        assert outcome.t.tobytes() == single.t.tobytes()
        assert outcome.numbers["events"] == len(single.events)
        assert outcome.messages == single.messages


@pytest.mark.parametrize("case", ["a jump at the start", "loop at ticks"])
def test_they_run_in_threads_with_the_same_bits(case, monkeypatch):
    make, parameters, duration, options = CASES[case]
    monkeypatch.setattr(sys.modules["loopwright.diagrams.sweeps.ways_to_run"], "run_in_processes", None)
    two, one = (
        make().sweep(parameters, duration, signals="y", workers=workers, **options, **QUIET) for workers in (2, 1)
    )
    assert two["y"].tobytes() == one["y"].tobytes()


def test_lags_of_all_gains_end_at_their_exponentials():
    lag = TransferFunction(numerator=1.0, denominator=[0.5, 1.0], name="lag")
    made = Diagram("lag", Gain(gain=1.0, name="k")(lag(Step(times=0.0, values=1.0, name="r"))).named("y"))
    gains = np.linspace(0.5, 3.0, 6)
    options = {"step": 0.1, "rtol": 1e-9, "atol": 1e-12}
    found = made.sweep({"k.gain": gains}, 1.0, reduce={"end": final("y")}, workers=1, **options, **QUIET)
    assert np.max(np.abs(found["end"] - gains * (1.0 - np.exp(-2.0)))) < 1e-8


def test_a_run_that_fails_between_ticks_harms_no_other():
    made = Diagram(
        "root",
        Integrator(name="x", initial_value=0.0)(
            Function(lambda v: np.sqrt(v), name="root")(
                Gain(gain=1.0, name="k")(Sine(frequency=0.25, phase=1.0, name="s"))
            )
        ).named("y"),
    )
    found = made.sweep({"k.gain": (1.0, -1.0, 2.0)}, 0.2, step=0.05, signals="y", workers=1, **QUIET)
    assert [failure.index for failure in found.failures] == [1]
    for i in (0, 2):
        single = made.replace(found.samples[i].parameters).simulate(0.2, step=0.05, compile=True, **QUIET)
        assert found.outcomes[i].signals["y"].tobytes() == single["y"].tobytes()
