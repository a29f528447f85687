"""Blocks without an initial value start from the input just before t = 0, where a source may jump."""

import numpy as np
import pytest

from loopwright.blocks import FIR, Backlash, Delay, MovingAverage, RateLimiter, Sine, Step, TransportDelay, UnitDelay
from loopwright.diagrams import Diagram, subsystem

T = 0.1
BEFORE, AFTER = 1.0, 5.0

EXPECTED = {  # the first four outputs for a source that is 1 before t = 0 and 5 from then on, by hand
    "moving average": (MovingAverage(samples=4, name="block"), [2.0, 3.0, 4.0, 5.0]),
    "fir": (FIR(coefficients=[0.5, 0.25, 0.25], name="block"), [3.0, 4.0, 5.0, 5.0]),
    "delay": (Delay(steps=2, name="block"), [1.0, 1.0, 5.0, 5.0]),
    "transport delay": (TransportDelay(delay=2 * T, initial_value=None, name="block"), [1.0, 1.0, 5.0, 5.0]),
    "unit delay": (UnitDelay(name="block"), [1.0, 5.0, 5.0, 5.0]),
    "rate limiter": (RateLimiter(rising=15.0, name="block"), [2.5, 4.0, 5.0, 5.0]),
    "backlash": (Backlash(width=1.0, name="block"), [4.5, 4.5, 4.5, 4.5]),
}


def outputs(block, source):
    """Return the outputs of the first run of a diagram, and of a further one, whose start is a traced function."""

    @subsystem(sample_time=T)
    def box():
        return block(source)

    diagram = Diagram("d", box())
    return np.array([diagram.simulate(3 * T, progress=False)["box.block.y"] for _ in range(2)])


@pytest.mark.parametrize("name", EXPECTED)
def test_a_jump_at_the_start_is_a_jump_of_the_input(name):
    block, expected = EXPECTED[name]
    source = Step(times=0.0, values=AFTER, initial_value=BEFORE, name="source")
    np.testing.assert_allclose(outputs(block, source), [expected, expected], rtol=1e-14)


@pytest.mark.parametrize("name", [name for name in EXPECTED if name != "backlash"])
def test_without_a_jump_it_is_the_first_input(name):
    block, _ = EXPECTED[name]
    source = Sine(frequency=1.0, amplitude=0.1, bias=2.0, phase=0.3, name="source")
    assert outputs(block, source)[:, 0] == pytest.approx([2.0 + 0.1 * np.sin(0.3)] * 2, rel=1e-14)


def test_a_transport_delay_in_continuous_time_starts_from_the_value_after_the_jump():
    source = Step(times=0.0, values=AFTER, initial_value=BEFORE, name="source")
    delay = TransportDelay(delay=2.5 * T, initial_value=None, name="block")
    run = Diagram("d", delay(source)).simulate(4 * T, step=T)
    np.testing.assert_allclose(run["block.y"], [5.0] * 5, rtol=1e-14)


@pytest.mark.parametrize("kind", [MovingAverage, FIR, Delay, UnitDelay, RateLimiter, Backlash])
def test_the_docstring_says_so(kind):
    assert "just before t = 0" in kind.__doc__
    assert "just before t = 0" in kind.parameter_specs["initial_value"].description
