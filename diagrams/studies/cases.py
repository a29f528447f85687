"""Cases of a study: parameters, an operating point, and what came of them; and the numbers that a study looks at."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from ...blocks.core import OptionError, near
from ..frequency import Number
from ..requirements import SENSES, Limit, Requirements, Sense


class CaseState(StrEnum):
    """Outcome of one case."""

    STABLE = "stable"
    """All loops are stable; their numbers are there."""
    UNSTABLE = "unstable"
    """A closed loop is unstable."""
    MOVING = "moving"
    """The operating point is not at rest with these parameters: the numbers belong to a point that passes."""
    FAILED = "failed"
    """It could not be analysed: the parameters are refused, no operating point is found, or no linear model."""


class CaseOrigin(StrEnum):
    """Where a case comes from."""

    NOMINAL = "nominal"
    """The diagram as it is."""
    SAMPLE = "sample"
    """A sample of the ranges."""
    CORNER = "corner"
    """A corner of the ranges."""
    SEARCH = "search"
    """A step of the local search."""


@dataclass(frozen=True)
class StudyCase:
    """One choice of parameters at one operating point, with its numbers."""

    index: int  # place among all cases
    origin: CaseOrigin
    parameters: Mapping[str, Any]  # as `Diagram.replace` takes them; {} of the diagram as it is
    point: int  # place of the operating point among those asked for
    state: CaseState
    goodness: float  # distance to the limit, or the number by its sense: the smaller, the worse
    loop: tuple[str, ...] = ()  # to which the goodness belongs
    quantity: str = ""  # number of the loop to which the goodness belongs
    numbers: Mapping[tuple[str, ...], Mapping[str, Number]] = field(default_factory=dict, repr=False)
    growth: float = math.nan  # of the fastest unstable pole in 1/s; NaN of a stable case
    reason: str = ""  # why it failed

    @property
    def value(self) -> float:
        """The number that the goodness belongs to; NaN where there is none."""
        number = self.numbers.get(self.loop, {}).get(self.quantity)
        return math.nan if number is None else number.value

    def as_dict(self) -> dict[str, Any]:
        """Return the facts by name, the parameters by their paths."""
        facts: dict[str, Any] = {
            "case": self.index,
            "origin": self.origin.value,
            "point": self.point,
            "state": self.state.value,
        }
        facts |= {"value": self.value, "quantity": self.quantity, "loop": ", ".join(self.loop)}
        return facts | {"growth": self.growth, "reason": self.reason, **self.parameters}


@dataclass(frozen=True)
class Goal:
    """The numbers whose worst case is looked for: by loop, each with its limit, or one number without a limit."""

    loops: Mapping[tuple[str, ...], Mapping[str, Limit | None]]
    left_out: tuple[str, ...] = ()
    """Requirements that a worst case is not looked for with, as those of steps."""

    def goodness(self, loop: tuple[str, ...], quantity: str, value: float) -> float:
        """Return a number's distance to its limit over the limit's size, or by its sense; infinite ones are best."""
        limit = self.loops[loop][quantity]
        if limit is None:
            return _sign_of(quantity) * value
        return limit.distance(value) / _size_of(limit)

    def slope(self, loop: tuple[str, ...], quantity: str, value: float) -> float:
        """Return the derivative of the goodness by the number."""
        limit = self.loops[loop][quantity]
        if limit is None:
            return _sign_of(quantity)
        return (1.0 if value - limit.low < limit.high - value else -1.0) / _size_of(limit)


def _sign_of(quantity: str) -> float:
    """Return 1 for a number that is the worse, the smaller, else −1."""
    return 1.0 if SENSES.get(quantity, Sense.LEAST) is Sense.LEAST else -1.0


def _size_of(limit: Limit) -> float:
    return max(abs(end) for end in limit if math.isfinite(end)) or 1.0


def describe(case: StudyCase) -> str:
    """Return one line about a case."""
    if case.state is CaseState.FAILED:
        return f"failed: {case.reason}"
    if case.state is CaseState.UNSTABLE:
        return f"unstable at {', '.join(case.loop)}, growth {case.growth:.4g} 1/s"
    moving = " (the point is not at rest)" if case.state is CaseState.MOVING else ""
    number = case.numbers[case.loop][case.quantity]
    return f"{case.quantity} = {number} at {', '.join(case.loop)}{moving}"


def make_goal(
    loops: str | Iterable[str] | None, quantity: str | None, requirements: Requirements | None, diagram: str
) -> Goal:
    """Return the numbers to be looked at."""
    if (quantity is None) == (requirements is None):
        raise OptionError(
            f"found quantity={quantity!r} and requirements={requirements!r}; expected one of them. Give a number, such "
            "as quantity='disk_margin', or Requirements(phase_margin_deg=45).",
            block=diagram,
        )
    # A number without a limit, of one loop.
    if quantity is not None and quantity not in SENSES:
        raise OptionError(
            f"a loop has no number {quantity!r}. {near(quantity, SENSES)}", block=diagram, port="quantity"
        )
    wires = [loops] if isinstance(loops, str) else list(loops or ())
    if requirements is None:
        if not wires:
            raise OptionError("found no loop; expected the name of a wire. Give loop='u'.", block=diagram, port="loop")
        assert quantity is not None
        if len(wires) > 1 and quantity != "disk_margin":
            raise OptionError(
                f"found {quantity!r} of {len(wires)} wires; a loop that is cut at several wires at once has a disk "
                f"margin alone. Give one wire, quantity='disk_margin', or requirements=Requirements({quantity}=…), "
                "which take each wire as a loop of its own.",
                block=diagram,
                port="loop",
            )
        return Goal({tuple(wires): {quantity: None}})
    # Each wire is a separate loop, with the limits that apply to it.
    found: dict[tuple[str, ...], Mapping[str, Limit | None]] = {}
    for wire in dict.fromkeys(wires or requirements.loops):
        limits = requirements.limits_of([wire], "")
        if limits:
            found[wire,] = dict(limits)
    if not found:
        raise OptionError(
            "found requirements that limit no number of a loop; expected some, such as phase_margin_deg=45, and "
            "loop='u'. Limits of step responses, contacts and the report's numbers belong to report(); contact={…} or "
            "a function as quantity looks for their worst case.",
            block=diagram,
        )
    # These requirements belong to the report; the result names them as not looked at.
    steps = [requirements.step, *requirements.steps, *(of.step for of in requirements.loops.values())]
    left_out = [f"step.{name}" for step in steps if step is not None for name in step.limits]
    left_out += [f"loops.{name}" for name in requirements.loops if wires and name not in wires]
    left_out += [f"numbers.{path}" for path in requirements.numbers]
    left_out += ["contact"] if requirements.contacts else []
    return Goal(found, tuple(dict.fromkeys(left_out)))
