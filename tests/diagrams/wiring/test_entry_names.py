"""Entries of arrays, named as in texts: ``motor.denominator[1]``, counted from 1."""

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, LoopwrightError, ParameterError, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram
from loopwright.diagrams.sweeps import final


def make_loop():
    motor = TransferFunction(numerator=[2.0], denominator=[0.1, 1.0, 3.0], name="motor")
    mix = Gain(gain=[[1.0, 2.0], [3.0, 4.0]], name="mix")
    wish = Constant(value=[1.0, 1.0], name="wish")
    return Diagram("loop", motor(mix(wish)[0] - motor.y))


def test_an_entry_is_replaced_and_the_others_stay():
    diagram = make_loop()
    found = diagram.replace(
        {"motor.denominator[1]": 0.2, "denominator[3]": 5, "mix.gain[2,1]": 7.0, "mix.gain[2]": 9.0}
    )
    assert found["motor"].denominator.tolist() == [0.2, 1.0, 5.0]
    assert found["mix"].gain.tolist() == [[1.0, 9.0], [7.0, 4.0]]
    assert diagram["motor"].denominator.tolist() == [0.1, 1.0, 3.0]


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        ("motor.denominator[4]", 1.0, UnknownNameError, r"motor: 'denominator' has no entry \[4\]; .* shape \(3,\)"),
        ("motor.denominator[0]", 1.0, UnknownNameError, "counted from 1"),
        ("motor.denominator[1,1]", 1.0, UnknownNameError, r"has no entry \[1, 1\]"),
        ("motor.denominator[1]", [1.0, 2.0], ParameterError, "expected one number"),
        ("motor.denominator[1]", "1", ParameterError, "expected one number"),
        ("motor.denominator[1]", float("nan"), ParameterError, "finite"),
        ("motor.denomnator[1]", 1.0, LoopwrightError, "Did you mean 'denominator'"),
    ],
)
def test_wrong_entries_are_refused_with_the_block(name, value, error, message):
    with pytest.raises(error, match=message) as caught:
        make_loop().replace({name: value})
    assert caught.value.block == "motor"


def test_a_sweep_takes_entries_and_its_runs_are_those_of_the_changed_diagram():
    diagram = make_loop()
    values = [0.05, 0.3]
    sweep = diagram.sweep(
        {"denominator[1]": values},
        0.5,
        reduce={"y": final("motor.y")},
        step=0.1,
        progress=False,
        workers=1,
        compile=False,
    )
    assert sweep.samples.names == ("motor.denominator[1]",)
    for value, y in zip(values, np.asarray(sweep["y"]), strict=True):
        run = diagram.replace({"motor.denominator[1]": value}).simulate(0.5, step=0.1, progress=False, compile=False)
        assert y == run["motor.y"][-1]
    with pytest.raises(UnknownNameError, match=r"motor: 'denominator' has no entry \[4\]"):
        diagram.sweep({"motor.denominator[4]": values}, 0.5, reduce={"y": final("motor.y")}, progress=False)
