"""Limits of a number, and the verdict on a number against them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple

from ...blocks.core import OptionError
from ..frequency import MARGIN_UNITS, Number


class Verdict(StrEnum):
    """Answer to the question whether a requirement is met; its value is in the report and in its JSON."""

    PASSED = "passed"
    """The number is within its limits, with its tolerance."""
    FAILED = "failed"
    """The number is beyond a limit, with its tolerance; or the closed loop is unstable."""
    UNDECIDED = "not decided"
    """There is no number, or it is not known well enough: no requirement is met."""


class Reason(StrEnum):
    """Cause of a verdict; its value is in the JSON."""

    COMPARED = "compared"
    """The number was compared with its limits."""
    UNSTABLE = "unstable"
    """The closed loop is unstable, and has no such number."""
    WITHIN_TOLERANCE = "within tolerance"
    """The number's tolerance reaches over the limit."""
    NO_NUMBER = "no number"
    """The report has no such number."""
    PERIODIC = "periodic"
    """The loop is renewed several times in the period of all clocks, and has no such number at one rate."""
    NO_VALUE = "no value"
    """The number does not exist (NaN), or its tolerance is not known."""
    NO_UNCERTAINTY = "no uncertainty"
    """The number was measured, and the data don't say how well."""
    NOT_CONFIRMED = "not confirmed"
    """No independent computation confirms the number."""
    FINDINGS = "findings"
    """The linear model behind the number leaves something out at its operating point."""
    SEVERAL_CUTS = "several cuts"
    """The wire feeds several blocks that may be the plant, and the verdict depends on the one at which it is cut."""
    REFUTED = "refuted"
    """The running co-simulation was measured, and contradicts the linear model."""
    NOT_MEASURED = "not measured"
    """The co-simulation was to be measured, and gave no number."""
    DIVERGES = "diverges"
    """The response grows without end, though the linear model's doesn't."""
    OSCILLATES = "oscillates"
    """The response keeps oscillating to the end of its record, which its linear model doesn't: a limit cycle."""
    NOT_SETTLED = "not settled"
    """The response still moves at the end of its record: its numbers so far are least values."""
    SIZE_NOT_GIVEN = "size not given"
    """The response to a step depends on the size of the step, and the requirement gives none."""
    MOVING = "moving"
    """The operating point is not an equilibrium."""
    ON_THE_LIMIT = "on the limit"
    """A pole lies on the limit of stability, within rounding."""
    NOT_ANALYSED = "not analysed"
    """The variant could not be analysed."""


class Limit(NamedTuple):
    """A range that a number has to be in, ends included; infinite where there is no limit on that side.

    Examples
    --------
    >>> Limit(45.0, math.inf).distance(50.0)
    5.0
    >>> Limit(-math.inf, 1.6).distance(1.75) < 0
    True
    """

    low: float
    high: float

    def distance(self, value: float) -> float:
        """Return the distance to the nearest limit, negative beyond it."""
        below = math.inf if self.low == -math.inf else value - self.low
        above = math.inf if self.high == math.inf else self.high - value
        return min(below, above)

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"≥ {self.low:g}"
        if self.low == -math.inf:
            return f"≤ {self.high:g}"
        return f"{self.low:g} … {self.high:g}"


class Sense(StrEnum):
    """Meaning of a limit that is given as one number."""

    LEAST = "at least"
    MOST = "at most"


SENSES: Mapping[str, Sense] = MappingProxyType(
    {
        "gain_margin_low": Sense.MOST,
        "gain_margin_high": Sense.LEAST,
        "phase_margin_deg": Sense.LEAST,
        "delay_margin_s": Sense.LEAST,
        "delay_margin_samples": Sense.LEAST,
        "modulus_margin": Sense.LEAST,
        "disk_margin": Sense.LEAST,
        "ms": Sense.MOST,
        "mt": Sense.MOST,
        "bandwidth": Sense.LEAST,
    }
)
"""Numbers of a loop that can be limited, by the names that end their paths."""

STEP_SENSES: Mapping[str, Sense] = MappingProxyType(
    {"overshoot": Sense.MOST, "settling": Sense.MOST, "rise": Sense.MOST, "peak": Sense.MOST}
)
"""Numbers of a step response that can be limited."""
STEP_UNITS: Mapping[str, str] = MappingProxyType({"settling": "s", "rise": "s"})
"""Units of those that are the same for all signals."""


def unit_of(quantity: str) -> str:
    """Return the unit of a number by its name or dotted path; empty for a pure number, or where neither says it.

    Examples
    --------
    >>> unit_of("phase_margin_deg"), unit_of("step.settling"), unit_of("stable"), unit_of("ms")
    ('deg', 's', '1/s', '')
    """
    if quantity == "stable":
        return "1/s"
    return {**MARGIN_UNITS, **STEP_UNITS}.get(quantity.rpartition(".")[2], "")


def make_limit(name: str, given: Any, sense: Sense | None, port: str = "") -> Limit:
    """Return a limit as a range; without a ``sense`` both ends have to be given."""
    where = port or name
    expected = "two numbers, low and high" if sense is None else f"a number ({sense}), or two: low and high"
    ends = given if isinstance(given, tuple | list) else (given,)
    step = f"Give {name} = [low, high]{'' if sense is None else ', or one number'}."
    good = all(isinstance(end, int | float) and not isinstance(end, bool) and not math.isnan(end) for end in ends)
    if not good or len(ends) != (2 if sense is None or ends is given else 1):
        raise OptionError(f"found {given!r}; expected {expected}. {step}", port=where)
    if len(ends) == 1:
        end = float(ends[0])
        if math.isinf(end):
            raise OptionError(f"found {given!r}, which limits nothing; expected {expected}. Leave it out.", port=where)
        _refuse_vacuous(name, end, where)
        return Limit(end, math.inf) if sense is Sense.LEAST else Limit(-math.inf, end)
    low, high = map(float, ends)
    if not low <= high or (low == -math.inf and high == math.inf) or low == math.inf or high == -math.inf:
        raise OptionError(
            f"found {given!r}; expected a range with low ≤ high, and one of them finite. {step}",
            port=where,
        )
    return Limit(low, high)


def _refuse_vacuous(name: str, end: float, port: str) -> None:
    """Refuse a limit that every loop meets, as it is meant in another unit: a share in per cent, a factor in dB."""
    if name == "overshoot" and end > 1.0:
        raise OptionError(
            f"found {end:g}, which is {100.0 * end:g} % of the final change; expected a share of it, up to 1. Give "
            f"{name} = {end / 100.0:g} for {end:g} %, or the range (0, {end:g}) for {100.0 * end:g} %.",
            port=port,
        )
    side = {"gain_margin_high": "above", "gain_margin_low": "below"}.get(name)
    if (side == "above" and end <= 1.0) or (side == "below" and end >= 1.0):
        raise OptionError(
            f"found {end:g}, which every stable loop meets; expected a factor {side} 1. Give gain_margin_high = 2.0, "
            "which is 6 dB, and gain_margin_low = 0.5 for the one to lower gains.",
            port=port,
        )


def judge_interval(value: float, low: float, high: float, limit: Limit) -> tuple[Verdict, Reason, float]:
    """Return the verdict on a number that is known to lie in an interval, its reason, and its value's distance.

    It is passed if the whole interval is within the limits, failed if the whole interval is beyond one of them.
    """
    distance = limit.distance(value)
    if math.isnan(value) or math.isnan(low) or math.isnan(high):
        return Verdict.UNDECIDED, Reason.NO_VALUE, math.nan
    if high < limit.low or low > limit.high:
        return Verdict.FAILED, Reason.COMPARED, distance
    if limit.low <= low and high <= limit.high:
        return Verdict.PASSED, Reason.COMPARED, distance
    return Verdict.UNDECIDED, Reason.WITHIN_TOLERANCE, distance


def is_doubtful(number: Number) -> bool:
    """Whether a finding puts a number in doubt, so that it meets no requirement.

    A kink, a slope of zero, stairs by their slope of zero, an event within the period and inexact derivatives do. The
    mean slope of a converter or an encoder (†) does not: the loop is the one that is meant, for motions of many quanta.
    """
    return any(finding.puts_in_doubt for finding in number.findings)


def judge(number: Number, limit: Limit) -> tuple[Verdict, Reason, float]:
    """Return the verdict on a number, its reason, and the distance to the nearest limit, negative beyond it.

    A number is passed only if it is confirmed, or a given, and within the limits by its tolerance. One whose linear
    model leaves something out that puts it in doubt (`is_doubtful`) is not passed either; beyond a limit it fails,
    where its error is known.
    """
    distance = limit.distance(number.value)
    if math.isfinite(number.value) and math.isnan(number.tolerance) and number.findings:
        return Verdict.UNDECIDED, Reason.FINDINGS, distance
    if math.isnan(number.value) or not number.tolerance < math.inf:
        return Verdict.UNDECIDED, Reason.NO_VALUE, math.nan
    if not number.confirmed_by.strip():
        return Verdict.UNDECIDED, Reason.NOT_CONFIRMED, distance
    if distance + number.tolerance < 0.0:
        return Verdict.FAILED, Reason.COMPARED, distance
    if distance - number.tolerance < 0.0:
        return Verdict.UNDECIDED, Reason.WITHIN_TOLERANCE, distance
    if is_doubtful(number):
        return Verdict.UNDECIDED, Reason.FINDINGS, distance
    return Verdict.PASSED, Reason.COMPARED, distance
