"""A block with one output is that signal by its own name, wherever signals are named."""

import numpy as np
import pytest

from loopwright.blocks import PID, Constant, Demux, Gain, Step, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram, Requirements, Run, subsystem
from loopwright.sweeps import final


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


@pytest.mark.slow
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


def test_in_runs_from_disk_and_sweeps(loop, tmp_path):
    run = loop.simulate(0.2, progress=False)
    run.save(tmp_path / "saved")
    loop.simulate(0.2, progress=False, to=tmp_path / "streamed")
    for name in ("saved", "streamed"):
        stored = Run.open(tmp_path / name)
        assert np.array_equal(stored["pid"], run["controller.pid.u"])
        assert np.array_equal(stored["wish"], run["wish.y"])
    asked = {"signals": ["wish"], "reduce": {"last": final("pid")}, "record": ["wish", "pid"]}
    sweep = loop.sweep({"pid.kp": [1.0]}, 0.2, **asked, progress=False, compile=True, workers=1)
    assert not sweep.failures
    assert np.array_equal(sweep["wish"][0], run["wish.y"])
    assert sweep["last"][0] == run["controller.pid.u"][-1]


def test_a_cut_ahead_of_a_block_by_its_name(loop):
    model = loop.linearize()
    by_block, by_port = model.loop("y", to="pid"), model.loop("y", to="pid.y")
    assert all(np.array_equal(getattr(by_block, M), getattr(by_port, M)) for M in "ABCD")


def test_several_signals_of_one_name_are_an_error_that_has_them():
    one, two = (subsystem(lambda u, k=k: Gain(gain=k, name="kp")(u), name=name) for name, k in (("a", 2.0), ("b", 3.0)))
    split = Demux(sizes=(1, 1), name="split")
    first, second = split(Constant(value=[1.0, 2.0], name="c"))
    diagram = Diagram("d", one(first), two(second))
    run = diagram.simulate(0.2, step=0.1, progress=False)
    for name, text, known in (
        ("kp", "'kp' stands for 2 blocks; expected a signal. Name one of a.kp.y, b.kp.y.", ("a.kp.y", "b.kp.y")),
        ("split", "'split' is a block with 2 outputs; expected a signal. Name one of split.y1, split.y2.", None),
    ):
        for ask in (lambda name=name: run[name], lambda name=name: diagram.linearize(inputs=name)):
            with pytest.raises(UnknownNameError) as error:
                ask()
            assert text in str(error.value)
            assert known is None or error.value.candidates == known
