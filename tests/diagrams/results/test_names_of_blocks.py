"""A block with one output is that signal by its own name, wherever signals are named."""

import numpy as np
import pytest

from loopwright.blocks import PID, Step, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram, Requirements, subsystem


@pytest.fixture(scope="module")
def loop():
    """The loop of the page on reports."""
    motor = TransferFunction(numerator=[2.0], denominator=[0.1, 1.0], name="motor")

    @subsystem(sample_time=0.01)
    def controller(wish, speed):
        return PID(kp=1.0, ki=5.0, name="pid")(r=wish, y=speed).named("u")

    return Diagram("loop", motor(controller(Step(times=0.1, values=1.0, name="wish"), motor.y)).named("y"))


def test_in_runs_and_snapshots(loop):
    run = loop.simulate(0.5, progress=False)
    assert np.array_equal(run["wish"], run["wish.y"])
    assert np.array_equal(run["pid"], run["controller.pid.u"])  # its other output is a secondary one
    assert "motor" in run
    assert "controller" not in run
    assert run.at(0.2)["wish"] == 1.0
    assert run.unit("wish") == run.unit("wish.y")


def test_a_recording_of_a_block_has_all_its_outputs(loop):
    run = loop.simulate(0.1, progress=False, record=["controller.pid"])
    assert np.array_equal(run["pid"], run["controller.pid.u"])
    assert run["controller.pid.excess"].size


def test_in_linear_models_and_requirements(loop):
    by_block = loop.linearize(inputs="wish", outputs="motor")
    by_port = loop.linearize(inputs="wish.y", outputs="motor.y")
    assert all(np.array_equal(getattr(by_block, M), getattr(by_port, M)) for M in "ABCD")
    asked = Requirements(step={"input": "wish", "output": "y", "size": 0.1, "overshoot": 0.2})
    review = loop.report(requirements=asked, only=("steps",)).review
    assert "step.overshoot" in [result.quantity for result in review.results if result.number is not None], (
        review.results
    )


def test_a_block_with_several_outputs_or_of_a_name_that_stands_twice_is_no_signal(loop):
    with pytest.raises(UnknownNameError, match="no signal 'wishes' was recorded"):
        loop.simulate(0.1, progress=False)["wishes"]
