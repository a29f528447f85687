"""Verdicts on the requirements of a design."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ...blocks.core import brief, explain_calls, print_unit
from ..frequency import Number
from .number_limits import Limit, Reason, Verdict, unit_of


@dataclass(frozen=True)
class RequirementResult:
    """A requirement with its verdict.

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
    """

    quantity: str
    loop: str
    variant: str
    limit: Limit
    verdict: Verdict
    reason: Reason
    distance: float = math.nan
    path: str = ""
    number: Number | None = None
    detail: str = ""
    place: str = ""
    unit: str = ""

    def __post_init__(self) -> None:
        unit = self.unit or unit_of(self.quantity) if self.number is None else self.number.unit
        object.__setattr__(self, "unit", unit)

    @property
    def required(self) -> str:
        """The limit with its unit, such as "≥ 45°"."""
        unit = print_unit(self.unit) if self.unit else ""
        return f"{self.limit}{'' if unit in ('', '°') else ' '}{unit}"

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
        }


@explain_calls
@dataclass(frozen=True)
class Review:
    """All requirements of a design with their verdicts.

    Attributes
    ----------
    results : tuple of RequirementResult
        In the order of the report.
    free : tuple of FreeMotion
        Motions that nothing notices, and that don't count as instabilities: ``motor.angle drifts: nothing feeds it
        back``. A forgotten wire looks the same.
    """

    results: tuple[RequirementResult, ...]
    free: tuple[Any, ...] = ()

    def __repr__(self) -> str:
        told = [f"{len(self.of(verdict))} {verdict.value}" for verdict in Verdict if self.of(verdict)]
        return brief(f"review of {len(self.results)} requirements", *told, then=".results, .of(Verdict.FAILED)")

    @property
    def verdict(self) -> Verdict:
        """Failed if one requirement fails; else not decided if one isn't, or there is none; else passed."""
        found = {result.verdict for result in self.results}
        if Verdict.FAILED in found:
            return Verdict.FAILED
        return Verdict.PASSED if found == {Verdict.PASSED} else Verdict.UNDECIDED

    def of(self, verdict: Verdict) -> tuple[RequirementResult, ...]:
        """Return the results with a verdict."""
        return tuple(result for result in self.results if result.verdict is verdict)

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict, the counts and all results, as in the JSON."""
        return {
            "verdict": self.verdict.value,
            **{verdict.name.lower(): len(self.of(verdict)) for verdict in Verdict},
            "free": [str(motion) for motion in self.free],
            "results": [result.as_dict() for result in self.results],
        }
