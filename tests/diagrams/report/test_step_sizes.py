"""Sizes of required steps: those of their sources, which the table, the review and the JSON say; by closed forms."""

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, Pulse, PulseTrain, Saturation, Sine, SmoothStep, Step
from loopwright.diagrams import Diagram, Requirements, subsystem
from loopwright.diagrams.requirements import Verdict

RAMP = 1.8 + np.log(5.0) / 5.0
"""Settling of v' = clip(5 (2 − v), ±1) within 2 %: v = t up to 1.8, then a decay from 0.2 to 0.04."""
SMALL = np.log(50.0) / 5.0
"""That of v' = 5 (r − v)."""


def limited(source):
    v = Integrator(name="v")
    law = Saturation(limit=1.0, name="limit")(Gain(gain=5.0, name="law")(source.y - v.y)).named("u")
    return Diagram("limited", v(law))


def report_of(source, **more):
    asked = Requirements(step={"input": "ref", "output": "v", "settling": 1.0, **more})
    return limited(source).report(only=("steps",), requirements=asked)


def result_of(report):
    (found,) = (r for r in report.review.results if r.is_step)
    return found


@pytest.mark.parametrize(
    ("more", "size", "expected", "origin"),
    [({}, 2.0, RAMP, "its source's own step"), ({"size": 0.1}, 0.1, SMALL, "given")],
)
def test_a_step_has_the_size_of_its_source(more, size, expected, origin):
    """At 2 the limit acts, and 1 s fails; at 0.1 it would pass."""
    result = result_of(report_of(Step(times=0.5, values=2.0, unit="rad/s", name="ref"), **more))
    assert result.number.value == pytest.approx(expected, abs=0.01)
    assert result.verdict is (Verdict.FAILED if expected > 1.0 else Verdict.PASSED)
    facts = result.as_dict()
    assert (facts["size"], facts["size_from"]) == (size, origin)


def test_the_review_says_the_size_and_its_origin():
    said = str(report_of(Step(times=0.5, values=2.0, unit="rad/s", name="ref")).review)
    assert "ref → v: a step of 2 rad/s, its source's own step" in said
    said = str(report_of(Constant(value=0.0, unit="rad/s", name="ref")).review)
    assert "ref → v: a step of 0.01 rad/s, chosen small" in said


def test_a_step_at_the_output_of_a_delay_that_a_variant_adds_is_chosen():
    """v(k+1) = v(k) - v(k-1)/20 has poles at (1 ± √0.8)/2, real: no overshoot, with the added delay neither."""

    @subsystem(sample_time=0.1)
    def controller(ref, v):
        return Gain(gain=0.5, name="law")(ref - v).named("u")

    v = Integrator(name="v")
    diagram = Diagram("held", v(controller(Constant(value=0.0, name="ref"), v.y)))
    asked = Requirements(step={"overshoot": 0.05}, loops={"u": {}}, variants=["sampled_d1"])
    results = [r for r in diagram.report(only=("steps",), requirements=asked).review.results if r.is_step]
    assert {r.variant for r in results} == {"sampled_d0", "sampled_d1"}
    assert all(r.as_dict()["size_from"] == "chosen small" for r in results)
    assert all(r.verdict is Verdict.PASSED and r.number.value < 1e-6 for r in results)


def test_the_step_of_a_source_is_its_next_one():
    step = Step(times=[1.0, 3.0], values=[275.0, 277.0])
    assert [step.own_step(t) for t in (0.0, 1.0, 2.0, 3.0, 9.0)] == [275.0, 2.0, 2.0, 2.0, 2.0]
    assert Step(times=[0.0, 1.0], values=[0.0, -3.0]).own_step(0.0) == -3.0
    assert Step(times=0.0, values=0.0).own_step(0.0) == 0.0
    levels = SmoothStep(levels=[1.0, 1.0, 4.0], start_times=[0.0, 2.0], durations=[1.0, 1.0])
    assert levels.own_step(0.0) == 3.0
    assert Pulse(start_time=1.0, end_time=2.0, amplitude=5.0).own_step(4.0) == 5.0
    assert PulseTrain(amplitude=0.5, period=1.0, base=1.0).own_step(0.0) == 0.5
    assert Sine(frequency=1.0).own_step(0.0) == 0.0
