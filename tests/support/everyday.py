"""Projects of working engineers: requirements, and the verdict on each that a calculation without the package gives."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from loopwright.blocks import SimulationError
from loopwright.diagrams import Diagram, Requirements
from loopwright.types import Verdict

from .by_hand import step_numbers

VARIANTS = ("as it is", "breaking", "harmless")
QUICK = "as it is"
"""The variant whose report is in the quick set, of a project that asks for it."""
AT_MOST = {"ms", "mt", "gain_margin_low", "overshoot", "settling", "rise", "peak"}
"""Quantities of which one number is the most that is allowed."""
APART = 0.05
"""Least distance of a number from its limit, as a part of the limit: a verdict must not hang on the third digit."""


@dataclass(frozen=True)
class Project:
    """A design with its requirements.

    Attributes
    ----------
    asked : mapping
        Arguments of `Requirements`, with limits by loop and steps with input and output.
    by_hand : callable
        From the changes of a variant to its numbers: ``{"force: phase_margin_deg": 75.5}``.
    diagram : callable
        From the changes of a variant to its diagram. Its sources step from ``step_at`` on, by the sizes of the steps that are
        asked for.
    step_at : float or tuple
        Times of these steps in s, one for each different input.
    duration : float
        Length of the response in s.
    breaking, harmless : mapping
        A change that breaks ``broken``, and one that breaks nothing.
    broken : tuple of str
        The requirements that the breaking change turns. The first one is the one that it is named for.
    more_delay : mapping, optional
        Delay that is added to that of a variant: as it is the loop bears it, with the breaking change it does not.
    at : float, optional
        Time in s at which the diagram is judged; the start without it.
    sampled_every : float, optional
        Time in s between two samples of the run, of a diagram without a clock.
    """

    asked: Mapping[str, Any]
    by_hand: Callable[..., Mapping[str, float]]
    diagram: Callable[..., Diagram]
    step_at: float | tuple[float, ...]
    duration: float
    breaking: Mapping[str, Any]
    harmless: Mapping[str, Any]
    broken: tuple[str, ...]
    as_it_is: Mapping[str, Any] = field(default_factory=dict)
    more_delay: Mapping[str, float] = field(default_factory=dict)
    at: float | None = None
    sampled_every: float | None = None

    def change(self, variant):
        """Return the change of parameters that makes a variant."""
        return {"as it is": self.as_it_is, "breaking": self.breaking, "harmless": self.harmless}[variant]

    def verdicts(self, variant):
        """Return the written verdict on every requirement of a variant: whether it is met."""
        broken = self.broken if variant == "breaking" else ()
        assert set(broken) <= set(self.limits())
        return {name: name not in broken for name in self.limits()}

    def limits(self):
        """Return every limit as ``{"force: ms": 1.5}``, those of steps as ``{"wanted to angle: overshoot": 0.1}``."""
        found = {f"{wire}: {name}": value for wire, of in self.asked["loops"].items() for name, value in of.items()}
        for step in self.asked["step"]:
            for name in AT_MOST & set(step):
                found[f"{step['input']} to {step['output']}: {name}"] = step[name]
        return found


def check_by_hand(project, variant):
    """Assert that the hand calculation gives the written verdicts, with all numbers well away from their limits."""
    numbers = project.by_hand(**project.change(variant))
    for name, met in project.verdicts(variant).items():
        limit, number = project.limits()[name], numbers[name]
        room = limit - number if name.rpartition(" ")[2] in AT_MOST else number - limit
        assert (room > 0) == met, f"{name}: {number:.4g} against {limit:.4g}"
        assert abs(room) > APART * limit, f"{name}: {number:.4g} is too near to {limit:.4g}"
    return numbers


def reports(not_yet=None, *, quick=False):
    """Return the variants as parameters of a test of reports, slow but for one of a quick project.

    Parameters
    ----------
    not_yet : mapping of str to str, optional
        Variants of which the report is not right yet, with the reason.
    quick : bool
        Whether the project as it is belongs to the quick set.
    """
    reasons, found = not_yet or {}, []
    for variant in VARIANTS:
        marks = [] if quick and variant == QUICK else [pytest.mark.slow]
        if variant in reasons:
            marks.append(pytest.mark.xfail(strict=True, reason=reasons[variant]))
        found.append(pytest.param(variant, marks=marks))
    return pytest.mark.parametrize("variant", found)


def of(where, numbers):
    """Return numbers with the name of their loop or step ahead of them."""
    return {f"{where}: {name}": value for name, value in numbers.items()}


def check_report(project, variant, **options):
    """Assert that the report's verdict on every requirement, and on the whole, is the written one; return the report."""
    diagram = project.diagram(**project.change(variant))
    report = diagram.report(requirements=Requirements(**project.asked), **{"at": project.at, **options})
    steps = [f"{s['input']} to {s['output']}: {name}" for s in project.asked["step"] for name in s if name in AT_MOST]
    found = {}
    for result in report.review.results:
        if result.quantity == "stable":
            name = "stable"
        else:
            name = f"{result.loop}: {result.quantity}" if result.loop else steps.pop(0)
        found[name] = result
    assert not steps
    written = {"stable": True} | project.verdicts(variant)
    wrong = [
        f"{name}: {result.verdict.value} ({result.reason.value}; {result.number}; {result.detail})"
        for name, result in found.items()
        if result.verdict is not (Verdict.PASSED if written[name] else Verdict.FAILED)
    ]
    assert not wrong, "\n".join(wrong)
    assert set(found) == set(written)
    assert report.review.verdict is (Verdict.PASSED if all(written.values()) else Verdict.FAILED)
    expected = project.by_hand(**project.change(variant))
    for name in project.verdicts(variant):
        value = found[name].number.value
        assert value == expected[name] or abs(value - expected[name]) < allowed(project, name, expected[name]), name
    return report


def check_run(project, variant):
    """Assert that the nonlinear run has the step responses of the hand calculation."""
    change = project.change(variant)
    numbers = project.by_hand(**change)
    times = np.atleast_1d(project.step_at)
    options = {} if project.sampled_every is None else {"step": project.sampled_every}
    run = project.diagram(**change).simulate(times[-1] + project.duration, **options)
    inputs = list(dict.fromkeys(step["input"] for step in project.asked["step"]))
    for step in project.asked["step"]:
        start = times[inputs.index(step["input"])]
        here = (run.t > start - 1e-9 * project.duration) & (run.t < start + project.duration)
        answer = run[step["output"]][here].copy()
        answer[0] = run[step["output"]][np.flatnonzero(here)[0] - 1]  # a sample at a jump has the value after it
        found = step_numbers(run.t[here] - start, answer, step["size"])
        for name in AT_MOST & set(step):
            expected = numbers[f"{step['input']} to {step['output']}: {name}"]
            room = allowed(project, name, expected)
            assert abs(found[name] - expected) < room, f"{name} of {step['output']}: {found[name]} for {expected}"


def check_stability(project, variant):
    """Assert that the nonlinear run with ``project.more_delay`` settles, but for that of the breaking variant."""
    change = dict(project.change(variant))
    for name, more in project.more_delay.items():
        change[name] = change.get(name, 0) + more
    start, step = np.atleast_1d(project.step_at)[0], project.asked["step"][0]
    options = {} if project.sampled_every is None else {"step": project.sampled_every}
    try:
        run = project.diagram(**change).simulate(start + 2.0 * project.duration, **options)
    except SimulationError:  # it has left what its equations are for
        assert variant == "breaking"
        return
    answer = run[step["output"]]
    before = answer[np.flatnonzero(run.t < start)[-1]]
    left = np.abs(answer[run.t > start + 1.8 * project.duration] - before - step["size"]).max() / step["size"]
    assert left > 0.5 if variant == "breaking" else left < 0.1, f"{left:.3g} of the step is left"


def allowed(project, name, expected):
    """Return the distance that a number may have from that by hand: margins are exact, answers are read at samples."""
    share = {"overshoot": 0.0, "settling": 0.03}.get(name.rpartition(" ")[2], 0.01)
    fixed = {"overshoot": 0.01, "settling": 2e-3 * project.duration}.get(name.rpartition(" ")[2], 0.0)
    return share * expected + fixed
