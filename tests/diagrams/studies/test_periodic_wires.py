"""Studies at a wire whose loop is periodic: they say how the loop at its own rate is written as a function."""

import re

import numpy as np
import pytest

from loopwright import margins
from loopwright.blocks import Constant, Gain, OptionError, TransferFunction
from loopwright.diagrams import Diagram, PeriodicLoopError, subsystem

RANGES = {"current.inner.gain": (2.0, 4.0)}


def make_cascade():
    """A current loop at 2 ms in a speed loop at 10 ms."""
    electric = TransferFunction(numerator=[1.0], denominator=[0.02, 1.0], name="electric")
    mechanic = TransferFunction(numerator=[5.0], denominator=[1.0, 0.2], name="mechanic")

    @subsystem(sample_time=0.01)
    def speed(r, y):
        return Gain(gain=0.5, name="outer")(r - y)

    @subsystem(sample_time=0.002)
    def current(r, y):
        return Gain(gain=3.0, name="inner")(r - y).named("voltage")

    voltage = current(speed(Constant(value=0.0), mechanic.y), electric.y)
    return Diagram("cascade", mechanic(electric(voltage)))


def phase_margin(gain):
    """That of L = gain (1 − a)/(z − a) with a = exp(−0.1): |e^jθ − a| = gain (1 − a) at the crossover."""
    a = np.exp(-0.1)
    theta = np.arccos((1 + a**2 - (gain * (1 - a)) ** 2) / (2 * a))
    return 180.0 - np.degrees(np.angle(np.exp(1j * theta) - a))


def read_function(error):
    return eval(re.search(r"lambda d: -?margins\(.*?\.value", str(error.value))[0], {"margins": margins})


def test_a_worst_case_at_a_periodic_wire_writes_the_function_that_finds_it(cache):
    cascade = make_cascade()
    with pytest.raises(OptionError, match="leave loop out") as error:
        cascade.worst_case(RANGES, "voltage", quantity="phase_margin_deg", count=3, starts=0)
    assert "Mend that first" not in str(error.value)
    found = cascade.worst_case(RANGES, quantity=read_function(error), count=3, starts=0)
    assert found.worst.value == pytest.approx(phase_margin(found.parameters["current.inner.gain"]), rel=1e-9)
    assert found.nominal[0].value == pytest.approx(phase_margin(3.0), rel=1e-9)


def test_a_number_that_is_worse_the_larger_has_its_sign_changed(cache):
    with pytest.raises(OptionError) as error:
        make_cascade().worst_case(RANGES, "voltage", quantity="ms", count=3, starts=0, at=0.0)
    assert 'lambda d: -margins(d.linearize(at=…).loop("voltage", slow="open")).ms.value' in str(error.value)


def test_sensitivities_at_a_periodic_wire_write_the_function_to_difference(cache):
    cascade = make_cascade()
    with pytest.raises(PeriodicLoopError, match="take differences") as error:
        cascade.sensitivities("voltage")
    f, name = read_function(error), "current.inner.gain"
    slope = (f(cascade.replace({name: 3.01})) - f(cascade.replace({name: 2.99}))) / 0.02
    assert slope == pytest.approx((phase_margin(3.01) - phase_margin(2.99)) / 0.02, rel=1e-6)
