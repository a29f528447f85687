"""All requirements of a design with their verdicts, and their table, which the first page of a report has, too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...blocks.core import Grid, Sheet, ShownAsTable, brief, explain_calls
from ..frequency import Number
from .results import CONTACT, RequirementResult, explain
from .verdicts import Verdict

COLUMNS = ("verdict", "requirement", "at", "variant", "required", "found", "distance")
MOST_REQUIREMENTS = 20
"""Requirements that the first page and a text show at most."""
DIGITS = 4
"""Significant digits on the first page and in a text."""
ORDER = (Verdict.FAILED, Verdict.UNDECIDED, Verdict.PASSED)
NOTHING = "–"


def rank(results: Sequence[RequirementResult]) -> list[RequirementResult]:
    """Return results in the order of their urgency: those that fail, those that are not decided, the others."""
    return sorted(results, key=lambda r: (ORDER.index(r.verdict), math.inf if math.isnan(r.relative) else r.relative))


def by_loop(ranked: Sequence[RequirementResult]) -> list[RequirementResult]:
    """Return results with those of a loop together behind the failed ones, in the order of the loops' first ones."""
    places = [(result.loop, result.place) for result in ranked]

    def key(i: int) -> tuple[int, int]:
        verdict = ranked[i].verdict
        first = next(j for j in range(i + 1) if ranked[j].verdict is verdict and places[j] == places[i])
        return ORDER.index(verdict), i if verdict is Verdict.FAILED else first

    return [ranked[i] for i in sorted(range(len(ranked)), key=key)]


def reason_in_table(result: RequirementResult) -> str:
    """Return the reason of a verdict that goes below the table; empty where it is none, or a word in the row."""
    if result.verdict is not Verdict.UNDECIDED and (result.variant == CONTACT or not result.detail):
        return ""
    return explain(result)


def row_of(result: RequirementResult) -> tuple[Any, ...]:
    """Return the entries of the columns; the verdict is the `Verdict`, found and distance are numbers or "–"."""
    distance: Any = NOTHING
    if result.number is not None and not math.isnan(result.distance):
        distance = replace(result.number, value=result.distance, given=False, is_gain=False)  # no factor any more
    return (
        result.verdict,
        result.words or result.quantity,
        result.where or result.loop or result.place or "whole diagram",
        result.title or result.variant or NOTHING,
        result.required,
        result.number if result.number is not None else NOTHING,
        distance,
    )


@explain_calls
@dataclass(frozen=True)
class Review(ShownAsTable):
    """All requirements of a design with their verdicts; ``print`` shows the table of a report's first page.

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
        counts = [f"{len(self.of(verdict))} {verdict.value}" for verdict in Verdict if self.of(verdict)]
        return brief(f"review of {len(self.results)} requirements", *counts, then=".results, .of(Verdict.FAILED)")

    def _sheet(self) -> Sheet:
        ranked = rank(self.results)
        reasons: dict[str, str] = {}
        rows = []
        for result in by_loop(ranked[:MOST_REQUIREMENTS]):
            verdict, *others = row_of(result)
            why = reason_in_table(result)
            letter = reasons.setdefault(why, f"[{len(reasons) + 1}]") if why else ""
            word = "" if why else explain(result)
            said = f"{verdict} {letter}".rstrip() + (f": {word}" if word else "")
            rows.append((said, *(_short(entry) for entry in others)))
        counts = ", ".join(f"{len(self.of(verdict))} {verdict}" for verdict in ORDER if self.of(verdict))
        return Sheet(
            f"review of {len(ranked)} requirements: {self.verdict}",
            (("verdicts", counts), ("free motions", ", ".join(map(str, self.free)))),
            (Grid("", COLUMNS, tuple(rows), total=len(ranked)),),
            tuple(f"{letter} {why}" for why, letter in reasons.items()),
        )

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


def _short(entry: Any) -> Any:
    """Return a number as a text with its unit."""
    if not isinstance(entry, Number):
        return entry
    return str(replace(entry, value=float(f"{entry.value:.{DIGITS}g}")))
