"""Mistakes that come naturally to whoever knows another tool: the error says what to write."""

import math

import numpy as np
import pytest

from loopwright.blocks import Block, Gain, Input, LoopwrightError, Sine, State, Step
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import build
from loopwright.frequency import margins
from support.public_calls import drive

STEP = Step(times=0.0, values=1.0, name="r")


class Tank(Block):
    flow = Input()
    h = State(start=0.1, output=True)

    def derivative(self, t, x, u):
        return u.flw


class Vessel(Tank):
    def derivative(self, t, x, u):
        return self.flow


class Leak(Block):
    flow = Input()
    level = State(start=0.0, output=True)

    def derivative(self, t, x, u):
        return u.flow - np.sqrt(x.level)


@subsystem(sample_time=0.01)
def nothing(e):
    Gain(gain=1.0)(e)


@subsystem(sample_time=0.01)
def watched(e):
    Gain(gain=2.0, name="double")(e)
    return ()


def test_a_subsystem_without_outputs_says_so_by_an_empty_tuple_and_runs():
    run = Diagram("t", watched(Sine(amplitude=3.0, frequency=2.0))).simulate(0.1, progress=False)
    assert run["watched.double.y"][-1] == pytest.approx(6.0 * math.sin(0.4 * math.pi), rel=1e-12)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda: float(STEP()), r"r: a function of numbers can't be applied to a signal.*np\.sin\(u\) for math"),
        (lambda: math.sin(STEP().named("r1")), r"which make blocks: np\.sin\(u\)"),
        (lambda: STEP >> Gain(gain=1.0), r"wired by calls, not by >>"),
        (lambda: margins(drive()), r"found a Diagram; expected the loop at a wire. Give diagram\.linearize\(\)\.loop"),
        (lambda: margins(drive().linearize()), r"found a Linearization; .*Give model\.loop"),
        (lambda: Diagram("t", Tank()(STEP)), r"has no attribute 'flw'\. Did you mean 'flow'\? Correct"),
        (lambda: Diagram("t", Vessel()(STEP)), r"read it in an equation as u\.flow\. Correct"),
        (
            lambda: Diagram("t", Gain(gain=1.0)(nothing(STEP))),
            r"nothing: its function returns nothing. End it with return and its outputs, such as return u",
        ),
        (lambda: nothing(STEP), r"nothing: its function returns nothing. .* with return \(\) if it has none"),
        (lambda: Diagram("t", Gain(gain=1.0)(watched(STEP))), r"watched: it has no outputs: its function ends with"),
        (lambda: Diagram("t", Leak()(STEP)).trim(), r"derivative of the diagram's equations that is not finite"),
        (lambda: build(Leak, "leak.fmu"), r"found the class Leak; expected a block, such as Leak\(…\)"),
        (lambda: drive().simulate(0.1, dt=0.01), r"no argument 'dt'\. Did you mean step=… \(seconds\)\?"),
    ],
)
def test_a_natural_mistake_is_told_with_what_to_write(ask, said):
    with pytest.raises(LoopwrightError, match=said):
        ask()


def test_a_call_of_a_subsystem_prints_as_that():
    assert repr(watched(STEP)) == "<call of watched>"


def test_a_run_of_some_signals_names_those_that_it_has():
    run = drive().simulate(0.1, record=["plant.y"], progress=False)
    assert "(named: y)" in repr(run)
    assert "run['y']" in repr(run)
