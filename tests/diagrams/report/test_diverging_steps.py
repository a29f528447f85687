"""Steps that a loop doesn't survive, though its linear model does: the run decides.

ẏ = y + sat(4 (w − y)) with |sat| ≤ 1 rests at y = 4 w/3. Beyond y = 1 the limit can't hold it, so steps above 0.75 diverge.
"""

import math

import numpy as np
import pytest

from loopwright import Diagram, Requirements, analyse
from loopwright.blocks import Gain, Saturation, StateSpace, Step
from loopwright.diagrams.requirements import Reason, Verdict, explain


def unstable_plant():
    plant = StateSpace(A=[[1.0]], B=[[1.0]], C=[[1.0]], name="plant")
    wish = Step(times=1.0, values=0.0, initial_value=0.0, name="source").y.named("wish")
    u = Gain(gain=4.0, name="controller")(wish - plant.y.named("y")).named("u")
    return Diagram("unstable", plant(Saturation(lower=-1.0, upper=1.0, name="drive")(u)))


def verdicts(size):
    asked = Requirements(step=[{"input": "wish", "output": "y", "size": size, "overshoot": 0.5, "settling": 3.0}])
    report = analyse(unstable_plant(), requirements=asked, only=("poles", "steps"))
    return report, {result.quantity: result for result in report.review.results}


def departure(size, part=0.05):
    """Return the time at which y leaves the linear response by a part of it for good, piece by piece in closed form."""
    upper, lower = size - 0.25, size + 0.25  # y at which u comes from its limits 1 and −1
    first = math.log(1 + upper)
    second = first + math.log((4 * size / 3 - upper) / (4 * size / 3 - lower)) / 3
    t = np.linspace(second, second + 3, 300001)
    off = 1 + (lower - 1) * np.exp(t - second) - 4 * size / 3 * (1 - np.exp(-3 * t))
    return float(t[np.flatnonzero(np.abs(off) <= part * 4 * size / 3)[-1]])


@pytest.mark.parametrize("size", [2.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_a_required_step_that_diverges_fails_with_the_time_from_which_it_does(size):
    report, found = verdicts(size)
    assert found["stable"].verdict is Verdict.PASSED  # for small signals
    for name in ("step.overshoot", "step.settling"):
        assert found[name].verdict is Verdict.FAILED
        assert found[name].reason is Reason.DIVERGES
        assert "diverges from t = " in explain(found[name])
    since = report.numbers()["steps.wish_to_y.continuous.diverges"]
    assert abs(since.value - departure(size)) <= since.tolerance + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("size", "verdict"), [(0.7, Verdict.PASSED), (0.7501, Verdict.FAILED), (0.76, Verdict.FAILED)])
def test_the_largest_step_that_the_limit_bears_passes_and_one_just_above_diverges(size, verdict):
    """At 0.7501 the response still looks settled at the end of its record: it is followed further."""
    _, found = verdicts(size)
    assert found["step.overshoot"].verdict is verdict
    assert (found["step.overshoot"].reason is Reason.DIVERGES) == (verdict is Verdict.FAILED)


@pytest.mark.slow
def test_a_response_that_a_limit_only_slows_down_is_not_called_diverging():
    """The same loop around a stable plant: limits act, and the response comes to rest all the same."""
    plant = StateSpace(A=[[-1.0]], B=[[1.0]], C=[[1.0]], name="plant")
    wish = Step(times=1.0, values=0.0, initial_value=0.0, name="source").y.named("wish")
    u = Gain(gain=4.0, name="controller")(wish - plant.y.named("y")).named("u")
    diagram = Diagram("stable", plant(Saturation(lower=-1.0, upper=1.0, name="drive")(u)))
    asked = Requirements(step=[{"input": "wish", "output": "y", "size": 5.0, "overshoot": 0.5}])
    report = analyse(diagram, requirements=asked, only=("poles", "steps"))
    assert "steps.wish_to_y.continuous.diverges" not in report.numbers()
    (result,) = [result for result in report.review.results if result.is_step]
    assert result.reason is not Reason.DIVERGES


@pytest.mark.slow
def test_steps_of_several_sizes_at_the_same_wires_have_a_run_and_a_verdict_each():
    """The small step's numbers stood for the large one, too, which diverges: it passed."""
    ends = {"input": "wish", "output": "y"}
    asked = Requirements(step=[{**ends, "size": 2.0, "overshoot": 0.5}, {**ends, "size": 0.1, "overshoot": 0.5}])
    report = analyse(unstable_plant(), requirements=asked, only=("poles", "steps"))
    found = [(r.size.value, r.verdict, r.path) for r in report.review.results if r.is_step]
    start, end = "steps.wish_to_y", "continuous.overshoot"
    assert sorted(found) == [(0.1, Verdict.PASSED, f"{start}_2.{end}"), (2.0, Verdict.FAILED, f"{start}.{end}")]
    at_loop = Requirements(step=[{"size": 0.1, "peak": 0.3}, {"input": "u", "size": 1.0, "peak": 0.3}])
    report = analyse(unstable_plant(), loops=["u"], requirements=at_loop, only=("poles", "steps"))
    found = {r.size.value: r.verdict for r in report.review.results if r.is_step}
    assert found == {0.1: Verdict.PASSED, 1.0: Verdict.FAILED}
