"""Responses that end in a limit cycle: a longer record would be no help, so the verdict says how large it is."""

import numpy as np
import pytest

from loopwright import Diagram, Requirements, analyse, subsystem
from loopwright.blocks import Integrator, Quantizer, Step
from loopwright.diagrams.requirements import Reason, Verdict, explain


@pytest.mark.slow
def test_a_required_step_that_ends_in_a_limit_cycle_says_its_amplitude_and_period():
    """x⁺ = x + 0.1 k (w − q(x)), q rounding to 0.5: with w = 0.75 between two steps of q it goes up and down for ever."""
    tank = Integrator(name="tank")
    wish = Step(times=1.0, values=0.0, initial_value=0.0, name="source").y.named("wish")

    @subsystem(sample_time=0.1)
    def control(wish, level):
        return (2.0 * (wish - Quantizer(quantum=0.5, name="converter")(level))).named("flow")

    diagram = Diagram("loop", tank(control(wish, tank.y.named("level"))))
    asked = Requirements(step=[{"input": "wish", "output": "level", "size": 0.7, "settling": 1.0}])
    report = analyse(diagram, requirements=asked, only=("poles", "steps"))
    (result,) = [result for result in report.review.results if result.is_step]
    x, record = 0.0, []
    for _ in range(4000):
        record.append(x)
        x += 0.1 * 2.0 * (0.7 - 0.5 * np.round(x / 0.5))
    tail = np.array(record[2000:])
    around = tail - 0.5 * (tail.max() + tail.min())
    crossings = np.flatnonzero((around[:-1] < 0) != (around[1:] < 0))
    period = 0.1 * 2 * (crossings[-1] - crossings[0]) / (len(crossings) - 1)
    numbers = report.numbers()
    cycle = numbers["steps.wish_to_level.sampled_d0.limit_cycle"]
    assert abs(cycle.value - 0.5 * np.ptp(tail)) <= cycle.tolerance
    assert abs(numbers["steps.wish_to_level.sampled_d0.limit_cycle_period"].value / period - 1) < 0.1
    assert (result.verdict, result.reason) == (Verdict.UNDECIDED, Reason.OSCILLATES)
    assert "keeps oscillating: by ± " in explain(result)
    assert "longer length" not in explain(result)
