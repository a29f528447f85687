"""A requirement with its verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from ...blocks.core import print_unit
from ..frequency import Number
from .verdicts import Limit, Reason, Verdict, judge, unit_of


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
