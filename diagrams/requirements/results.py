"""A requirement with its verdict; in words why, and of one that is not decided also what would decide it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from ...blocks.core import print_unit
from ..frequency import Number, is_at_steps_only
from .verdicts import Limit, Reason, Verdict, judge, unit_of

MEASURED, WORST_CASE, CONTACT = "measured", "worst_case", "contact"
"""Keys of results that belong to no variant of the diagram: of measured loops, searches and contacts."""


class StepSize(StrEnum):
    """Origin of a step's height; its value is in the JSON."""

    GIVEN = "given"
    """The requirement says it."""
    SOURCE = "its source's own step"
    """The wire comes from a source that steps, such as `Step`: the height of its step."""
    CHOSEN = "chosen small"
    """Nothing says it: it is small compared with the signal, and large compared with quanta."""


@dataclass(frozen=True)
class RequirementResult:
    """A requirement with its verdict, which is open, as there is no number, until one is judged.

    Attributes
    ----------
    quantity : str
        Name of the number, such as ``phase_margin_deg``.
    loop : str
        Key of the loop in the report; empty of the whole diagram.
    variant : str
        Key of the variant, such as ``sampled_d0``.
    limit : Limit
        The range that is required.
    verdict : Verdict
        Whether it is met.
    reason : Reason
        Why.
    distance : float
        Distance to the nearest limit in the number's unit, negative beyond it; NaN where there is no number.
    path : str
        Dotted path of the number; empty where there is none.
    number : Number, optional
        The number.
    detail : str
        More about the reason, in words.
    place : str
        Wires of a step from one to another, such as "wish → y"; empty of all other numbers.
    unit : str
        Unit of the limit: the number's, or where there is none that of the quantity; empty if neither says it.
    size : Number, optional
        Height of the step that the number belongs to; it says in its ``confirmed_by`` where that comes from. None of
        all other numbers.
    words, where, title : str
        The quantity, the place and the variant in words, as a report names them; empty where no report does.
    """

    quantity: str
    loop: str
    variant: str
    limit: Limit
    verdict: Verdict = Verdict.UNDECIDED
    reason: Reason = Reason.NO_NUMBER
    distance: float = math.nan
    path: str = ""
    number: Number | None = None
    detail: str = ""
    place: str = ""
    unit: str = ""
    size: Number | None = None
    words: str = field(default="", repr=False, compare=False)
    where: str = field(default="", repr=False, compare=False)
    title: str = field(default="", repr=False, compare=False)

    def __post_init__(self) -> None:
        unit = self.unit or unit_of(self.quantity) if self.number is None else self.number.unit
        object.__setattr__(self, "unit", unit)

    def judged(self, number: Number, path: str = "") -> RequirementResult:
        """Return the result with the verdict on a number."""
        verdict, reason, distance = judge(number, self.limit)
        return replace(self, verdict=verdict, reason=reason, distance=distance, number=number, path=path)

    def failed(self, reason: Reason, detail: str = "") -> RequirementResult:
        """Return the result as one that fails for a reason."""
        return replace(self, verdict=Verdict.FAILED, reason=reason, detail=detail)

    def undecided(self, reason: Reason, detail: str = "") -> RequirementResult:
        """Return the result as one that is open for a reason."""
        return replace(self, verdict=Verdict.UNDECIDED, reason=reason, detail=detail)

    @property
    def required(self) -> str:
        """The limit with its unit, such as "≥ 45°"."""
        unit = print_unit(self.unit) if self.unit else ""
        return f"{self.limit}{'' if unit in ('', '°') else ' '}{unit}"

    @property
    def step(self) -> str:
        """The height of the step in words, such as "a step of 2 rad/s"; empty of all other numbers."""
        if self.size is None:
            return ""
        unit = "" if self.size.unit == "1" else f" {print_unit(self.size.unit)}"
        why = "" if self.size.confirmed_by == StepSize.GIVEN else f", {self.size.confirmed_by}"
        return f"a step of {self.size.value:.4g}{unit}{why}"

    @property
    def is_step(self) -> bool:
        """Whether the number is one of a step response."""
        return self.quantity.partition(".")[0] == "step"

    @property
    def relative(self) -> float:
        """The distance over the limit's size, by which results are compared; NaN where there is none."""
        ends = [abs(end) for end in self.limit if math.isfinite(end)]
        return self.distance / (max(ends) or 1.0) if ends else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return the facts by name, as in the JSON."""
        return {
            "quantity": self.quantity,
            "loop": self.loop,
            "variant": self.variant,
            "low": self.limit.low,
            "high": self.limit.high,
            "verdict": self.verdict.value,
            "reason": self.reason.value,
            "distance": self.distance,
            "path": self.path,
            "value": math.nan if self.number is None else self.number.value,
            "detail": self.detail,
            "place": self.place,
            "size": math.nan if self.size is None else self.size.value,
            "size_from": "" if self.size is None else self.size.confirmed_by,
        }


def explain(result: RequirementResult) -> str:
    """Return the reason of a verdict, and the step that would decide an open one; empty where numbers were compared.

    A failed one may have more about its reason.

    Examples
    --------
    >>> from loopwright.diagrams.requirements import Limit
    >>> open_ = Limit(40.0, math.inf), Verdict.UNDECIDED, Reason.MOVING
    >>> explain(RequirementResult("phase_margin_deg", "u", "sampled_d0", *open_, detail="plant.v"))
    'the operating point moves (plant.v); give one at rest, such as at=diagram.trim(…)'
    """
    if result.reason is Reason.COMPARED:
        return ""
    if result.verdict is not Verdict.UNDECIDED:
        is_contact = result.variant == CONTACT  # whose detail is its environment
        if result.reason is Reason.DIVERGES:
            return f"diverges {result.detail}"
        return f"{result.reason}: {result.detail}" if result.detail and not is_contact else str(result.reason)
    why, step = _find_reason(result)
    why = why.rstrip(".")
    return f"{why}{' Or ' if why.endswith('?') else '; '}{step}" if step else why


def _find_reason(result: RequirementResult) -> tuple[str, str]:
    """Return why a verdict is open, and what would decide it."""
    number = result.number
    is_contact, is_searched = result.variant == CONTACT, result.variant == WORST_CASE
    detail = "" if is_contact else result.detail  # a contact's is its environment
    about = f": {detail}" if detail else ""
    by_run = is_contact or is_searched  # or by the injection check
    match result.reason:
        case Reason.UNSTABLE:
            return "the closed loop is unstable", ""
        case Reason.WITHIN_TOLERANCE:
            return f"the limit is within {_interval(number, detail)}", _sharpen(result)
        case Reason.NO_NUMBER:
            why = f"the report has no such number{f'. {detail}' if detail else ''}"
            return why, "limit one that report.numbers() has"
        case Reason.PERIODIC:
            why = "a wire that is renewed several times in the period has no such number"
            return why, "limit ms, disk_margin, gain_margin_high or phase_margin_deg"
        case Reason.NO_VALUE:
            step = "limit another one" if result.is_step else "limit another margin, such as disk_margin"
            if is_searched:
                return "one of the cases has no such number", step
            return f"the number does not exist here{_reason_of(number)}", step
        case Reason.NO_UNCERTAINTY:
            return "the data don't say how uncertain they are", "give their uncertainty"
        case Reason.NOT_CONFIRMED:
            return "nothing confirms the number", "limit one that a second computation confirms"
        case Reason.FINDINGS:
            why = f"the linear model leaves something out (†){_finding_of(number)}"
            return why, "limit a step response, which the run decides, or give the loop as measured"
        case Reason.SEVERAL_CUTS:
            why = f"several blocks on the wire may be the plant, and it depends on where it is cut: {detail}"
            step = "name the plant's inputs as to=… in the requirements' loops, or to=[] for all blocks together"
            return why, step
        case Reason.REFUTED:
            why = f"the {'nonlinear run' if by_run else 'injection check'} contradicts the linear model"
            return why, "the run counts: look at it" if by_run else "limit a step response, which the run decides"
        case Reason.NOT_MEASURED:
            step = "" if detail else "name a step's input and output, one entry each"
            return f"no response was measured{about}", step
        case Reason.SIZE_NOT_GIVEN:
            why = f"the response to a small step is not that of the linear model: {detail}"
            return why, "give the size for which the limit holds, size=…"
        case Reason.DIVERGES:
            return f"the response diverges{about}", "give a smaller size, or the actuator more room"
        case Reason.OSCILLATES:
            step = "give a size of which 2 % are more than that, or make quanta or friction on the loop smaller"
            return f"the response keeps oscillating{about}", step
        case Reason.NOT_SETTLED:
            return f"the response has not settled in its record of {detail}", "give a longer length"
        case Reason.MOVING:
            at = "lambda d: d.trim(…)" if is_searched else "diagram.trim(…)"
            return f"the operating point moves{f' ({detail})' if detail else ''}", f"give one at rest, such as at={at}"
        case Reason.ON_THE_LIMIT:
            step = "feed it back, or take it out: the chapter on poles names it"
            return f"a pole lies on the limit of stability{about}", step
        case Reason.NOT_ANALYSED:
            return f"not analysed{about}", "" if detail else "the diagram as it is has to be analysed"
    raise AssertionError(f"{result.reason!r} decides, and explains nothing")


def _interval(number: Number | None, detail: str) -> str:
    if detail:
        return f"the interval {detail}"
    if number is None:
        return "the number's tolerance"
    return f"the number's tolerance, {number.value - number.tolerance:.5g} … {number.value + number.tolerance:.5g}"


def _sharpen(result: RequirementResult) -> str:
    """Return how the tolerance of a number gets smaller."""
    if result.variant == MEASURED:
        return "measure more points, or with less uncertainty"
    if result.is_step and result.number is not None and is_at_steps_only(result.number.confirmed_by):
        return "give the FMU shorter communication steps, which show what it does between its points"
    if result.is_step:
        return "give a longer length or a larger size, or a limit farther away"
    why = "" if result.number is None else result.number.confirmed_by
    if "FMU" in why:
        return "give a limit farther away, or an FMU with derivatives of its own: the tolerance is that of its model"
    return "give a limit farther away"


def _reason_of(number: Number | None) -> str:
    """Return the reason that a number without a value carries."""
    if number is None:
        return ""
    if math.isnan(number.value) and number.confirmed_by:
        return f": {number.confirmed_by}"
    return ": its tolerance is not known" if not number.tolerance < math.inf else ""


def _finding_of(number: Number | None) -> str:
    """Return the first finding of a number, one that puts it in doubt if there is any."""
    if number is None or not number.findings:
        return ""
    findings = sorted(number.findings, key=lambda finding: not finding.puts_in_doubt)
    return f": {str(findings[0]).rstrip('.')}"
