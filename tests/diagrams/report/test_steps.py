"""Step responses in a report: their distance from the linear model is that of each signal, and not of rounding."""

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import Constant, Integrator, Sum, TransferFunction
from loopwright.diagrams import Diagram, Requirements, analyse
from loopwright.diagrams.measure import StepResponse
from loopwright.diagrams.report.sections.step_responses import _how
from loopwright.diagrams.report.sections.step_runs import deviation as deviation_of
from loopwright.types import Verdict


def response(outputs, y, linear, before=None, wire_before=0.0):
    """Return a response whose own signal is predicted exactly, beside signals that are given."""
    N = 5
    v, t = -np.ones(N), 0.1 * np.arange(N)
    y, linear = (np.outer(np.ones(N), np.atleast_1d(values)) for values in (y, linear))
    return StepResponse(
        wire="u",
        size=1.0,
        t=t,
        d=np.ones(N),
        v=v,
        outputs=outputs,
        y=y,
        before=np.zeros(len(outputs)) if before is None else np.asarray(before),
        wire_before=wire_before,
        moved=0.0,
        dt=0.1,
        held=True,
        prediction=np.column_stack([v, linear]),
    )


@pytest.mark.parametrize(
    ("outputs", "y", "linear", "before", "deviation"),
    [
        (("f",), [2.0], [1.5], [0.0], 0.25),
        (("f[1]", "f[2]"), [4e-5, 0.4], [0.0, 0.4], [0.0, 43.0], 1e-4),  # entries of one signal share a scale
        (("f", "g"), [4e-5, 0.4], [0.0, 0.4], [0.0, 43.0], 1.0),  # two signals don't
        (("f",), [2e-14], [0.0], [43.0], 0.0),  # rounding of 43
    ],
)
def test_the_deviation_is_relative_to_the_signals_own_largest_change(outputs, y, linear, before, deviation):
    got = response(outputs, y, linear, before)
    assert deviation_of(got) == pytest.approx(deviation, rel=1e-9, abs=1e-12)
    assert ("does not agree" in _how(got).method) == (deviation > 0.01)
    assert f"differs by {deviation:.2g} of" in _how(got)


def lags(share, fast, slow):
    """A wish through two lags: 1 − y = (1 − a) exp(−t/τ₁) + a exp(−t/τ₂)."""
    wish = Constant(value=0.0, name="wish").named("w")
    one = TransferFunction(numerator=[1.0 - share], denominator=[fast, 1.0], name="fast")
    two = TransferFunction(numerator=[share], denominator=[slow, 1.0], name="slow")
    return Diagram("two", Sum(signs="++", name="sum")(one(wish), two(wish)).named("y"))


@pytest.mark.parametrize(("limit", "verdict"), [(13.3e-3, Verdict.FAILED), (14.5e-3, Verdict.PASSED)])
def test_a_settling_time_is_not_that_of_the_records_end(limit, verdict):
    """At 20 ms, the end of the record, 0.5 % are still to come: 2 % of the final value are reached at 13.92 ms."""
    settled = brentq(lambda t: 0.5 * np.exp(-t / 1e-3) + 0.5 * np.exp(-t / 4.325e-3) - 0.02, 0.0, 0.1, xtol=1e-15)
    assert 13.9e-3 < settled < 13.95e-3
    step = {"input": "w", "output": "y", "settling": limit, "length": 0.02}
    report = analyse(lags(0.5, 1e-3, 4.325e-3), only=("steps",), requirements=Requirements(step=step))
    (result,) = (r for r in report.review.results if r.quantity == "step.settling")
    assert abs(result.number.value - settled) <= result.number.tolerance < 0.1e-3
    assert result.verdict is verdict
    linear = report.numbers()["steps.w_to_y.continuous.linear.settling"]
    assert abs(linear.value - settled) <= linear.tolerance < 0.1e-3


def test_the_effort_of_a_step_is_known_to_what_lies_between_the_samples():
    """T = (3 s + 40)/(s² + 3 s + 40): the command is −T of the step, whose largest value is at a slope of zero."""
    place, speed = Integrator(name="place"), Integrator(name="speed")
    diagram = Diagram("spring", place(speed((-3.0 * speed.y - 40.0 * place.y).named("u"))))
    numbers = analyse(
        diagram, only=("steps",), requirements=Requirements(step={"settling": 9.0, "size": 0.1})
    ).numbers()
    w = np.sqrt(40 - 1.5**2)
    t = np.linspace(0.0, 2.0, 2_000_001)
    exact = 0.1 * np.max(1 - np.exp(-1.5 * t) * (np.cos(w * t) - 1.5 / w * np.sin(w * t)))
    effort = numbers["steps.u.continuous.effort.u"]
    assert abs(effort.value - exact) <= effort.tolerance < 1e-3 * exact
    assert abs(effort.value - exact) > 1e-9 * exact  # the samples don't meet the peak
