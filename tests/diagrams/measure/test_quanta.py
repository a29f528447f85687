"""Test signals are large beside the quanta of converters and encoders, and a run tells what is left at rest."""

import math
from types import MappingProxyType

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import (
    Block,
    Constant,
    DefinitionError,
    Encoder,
    Function,
    Gain,
    Input,
    Integrator,
    Output,
    Quantizer,
    Saturation,
    Sum,
    TransferFunction,
    parameter,
)
from loopwright.diagrams import Diagram, Requirements, subsystem
from loopwright.diagrams.measure import LEAST, LEAST_SINE, find_least_sine, find_least_step, find_quantum
from loopwright.types import MeanSlope

T, KP, KD, Q = 1e-3, 400.0, 40.0, 1e-5


def servo(limit=None, quantum=Q):
    """A double integrator under −KP p − KD v, with p and v of an encoder."""
    v, x = Integrator(name="speed"), Integrator(name="angle")

    @subsystem(sample_time=T)
    def drive(x, v):
        p, w = Encoder(quantum=quantum, name="encoder")(x, v)
        return Sum(signs="--")(Gain(gain=KP, name="kp")(p), Gain(gain=KD, name="kd")(w)).named("torque")

    u = drive(x.y, v.y)
    return Diagram("servo", x(v.y), v(u if limit is None else Saturation(limit=limit, name="limit")(u)))


def by_hand(count=600):
    """Return −v/d of a step d at the torque, without quanta: the recursion of the held double integrator."""
    x = v = last = 0.0
    found = []
    for _ in range(count):
        u = -KP * x - KD * (x - last) / T
        last = x
        found.append(-u)
        a = u + 1.0
        x, v = x + T * v + a * T * T / 2, v + T * a
    return np.array(found)


def test_the_quantum_of_a_signal_is_its_largest_change_by_one_step():
    diagram = servo()
    point = diagram.operating_point()
    found = find_quantum(diagram.wired, point, "torque", 0.5)
    assert found.value == pytest.approx(Q * (KP + KD / T), rel=1e-12)  # the difference sees the step in one sample
    assert found.converter == "drive.encoder.position"
    height, _ = find_least_step(diagram.wired, point, "torque", "torque", 0.5)
    assert height == pytest.approx(LEAST * Q * (KP + KD / T) / by_hand(500).max(), rel=1e-9)
    w = np.array([10.0, 100.0])
    z = np.exp(1j * w * T)
    L = T**2 / 2 * (z + 1) / (z - 1) ** 2 * (KP + KD * (z - 1) / (T * z))
    amplitude, _ = find_least_sine(diagram.wired, point, "torque", diagram.linearize().loop("torque"), w)
    assert amplitude == pytest.approx(LEAST_SINE * found.value / np.min(np.abs(L / (1 + L))), rel=1e-9)


def test_nothing_is_asked_for_where_no_converter_moves_the_signal():
    x, other = Integrator(name="x"), Integrator(name="other")
    seen = Quantizer(quantum=0.1, name="seen")(other.y)
    diagram = Diagram("d", x(Gain(gain=-2.0)(x.y).named("u")), other(Gain(gain=-1.0)(seen)))
    assert find_least_step(diagram.wired, diagram.operating_point(), "u", "u", 1.0) is None


def section(report, key):
    return next(s for s in report.sections if s.key == key)


@pytest.mark.slow
def test_a_report_steps_and_injects_many_quanta():
    report = servo().report(only=("inner", "steps", "injection"))
    numbers, expected = report.numbers(), by_hand()
    for name, value in (("final", 1.0), ("overshoot", expected.max() - 1.0)):
        number = numbers[f"steps.torque.sampled_d0.{name}"]
        assert abs(number.value - value) <= number.tolerance < 0.01
    assert numbers["steps.torque.sampled_d0.drive_encoder_position.oscillation"].value < 0.5
    assert numbers["injection.torque.sampled_d0.deviation"].value < 1e-3
    assert any("quanta of drive.encoder.position" in line for line in section(report, "steps").text)
    assert not any("limit cycle is possible" in line for s in section(report, "inner").sections for line in s.text)


def test_a_report_says_where_the_range_does_not_allow_it():
    report = servo(limit=1.0).report(only=("steps",))
    assert any(
        "the range doesn't allow a step of 400 quanta of drive.encoder.position" in line.replace("&#39;", "'")
        for line in section(report, "steps").text
    )


def test_a_report_says_how_many_quanta_a_required_step_has():
    asked = Requirements(step={"overshoot": 0.3, "size": 1.0}, stable=False)
    report = servo().report(only=("steps",), requirements=asked)
    quanta = by_hand().max() / (Q * (KP + KD / T))
    (line,) = [line for line in section(report, "steps").text if "which show" in line]
    assert f"by {quanta:.3g} quanta" in line
    asked = Requirements(step={"overshoot": 0.3, "size": 200.0}, stable=False)
    text = section(servo().report(only=("steps",), requirements=asked), "steps").text
    assert not any("quanta of" in line for line in text)  # it is large enough, and as it was given


def cubic(gain):
    """A quantizer of step 0.1 ahead of gain/(s (s + 1) (s + 2)), whose gain margin is 6/gain."""
    plant = TransferFunction(name="plant", numerator=[gain], denominator=[1.0, 3.0, 2.0, 0.0])
    seen = Quantizer(quantum=0.1, name="seen")(plant.y)
    return Diagram("cubic", plant(Gain(gain=-1.0, name="minus")(seen).named("u")))


def describing_function(a):
    """Gain of a quantizer of step 1 for an amplitude a, the larger steps included."""
    edges = np.arange(0.5, a, 1.0)
    return 4.0 / (np.pi * a) * float(np.sum(np.sqrt(1.0 - (edges / a) ** 2)))


@pytest.mark.slow
def test_a_limit_cycle_is_flagged_and_measured_in_quanta():
    gain = 5.0
    expected = brentq(lambda a: describing_function(a) - 6.0 / gain, 1.0 / math.sqrt(2.0), 1.49)
    report = cubic(gain).report(only=("inner", "steps"))
    said = [line for s in section(report, "inner").sections for line in s.text if "limit cycle is possible" in line]
    assert any("1.2 is below 4/π" in line for line in said)
    found = report.numbers()["steps.u.continuous.seen_u.oscillation"]
    assert found.unit == "quanta"
    assert found.value == pytest.approx(expected, rel=0.1)  # the describing function leaves harmonics out
    report = cubic(3.0).report(only=("inner", "steps"))
    assert not any("limit cycle is possible" in line for s in section(report, "inner").sections for line in s.text)
    assert report.numbers()["steps.u.continuous.seen_u.oscillation"].value < 0.5


def test_a_block_of_ones_own_may_name_its_steps():
    class Converter(Block):
        """A converter that rounds down."""

        quanta = MappingProxyType({"u": "step"})
        step: float = parameter(default=0.01, above=0.0)
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return self.step * np.floor(u.u / self.step)

    lin = rounded(Converter(name="adc")).linearize()
    assert lin.findings == (MeanSlope("box.adc", "y", "u", pytest.approx(1.0, rel=1e-14)),)
    assert not lin.findings[0].puts_in_doubt
    with pytest.raises(DefinitionError, match="expected an input, and the parameter that holds its step"):
        type("Wrong", (Converter,), {"quanta": {"u": "stp"}})


def rounded(block):
    x = Integrator(name="x")

    @subsystem(sample_time=0.01)
    def box(x):
        return Gain(gain=8.0, name="k")(block(x))

    return Diagram("rounded", x(Sum(signs="+-")(Constant(value=0.0), box(x.y)).named("u")))


@pytest.mark.slow
def test_a_worst_case_is_confirmed_with_its_treatment_of_stairs():
    found = rounded(Quantizer(quantum=1e-3, name="seen")).worst_case({"k.gain": (6.0, 10.0)}, "u", count=2, starts=0)
    assert found.confirm().agrees
    gear = rounded(Function(lambda u: 1e-3 * np.floor(u / 1e-3 + 0.5), name="gear"))
    found = gear.worst_case({"k.gain": (6.0, 10.0)}, "u", count=2, starts=0, stairs="gain")
    assert found.confirm(amplitude=20.0).agrees
