"""Verdicts on the requirements of a case, from the numbers of its report."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from ...blocks.core import LoopwrightError, UnknownNameError, close_names, near
from ..frequency import Number
from ..linearization import find_signal
from ..requirements import (
    SENSES,
    Limit,
    Reason,
    RequirementResult,
    Requirements,
    Review,
    Verdict,
    judge_interval,
)
from ..studies import CaseState, StudyCase
from .case import Case
from .sections.contacts import ReportedContacts
from .sections.measured_loops import MEASURED, MeasuredLoop
from .sections.worst_case import MissingWorstCase, ReportedWorstCase
from .stability import free_motions
from .variant import STEP
from .variant_verdicts import STABLE, VariantReview


def check_names(case: Case, asked: Requirements, measured: Collection[str] = ()) -> None:
    """Refuse names in requirements that the diagram does not have."""
    names = (name for all_names in case.names_of_loops().values() for name in all_names)
    known = {*names, *case.extra_loops(), *measured}
    for name in asked.loops:
        if name not in known:
            error = UnknownNameError(
                f"found requirements on a loop {name!r}; expected a loop of the report. {near(name, known)}",
                block=case.diagram.name,
            )
            raise asked.error_at(error, f"loops.{name}")
    variants = {**dict.fromkeys(case.variants), **({MEASURED: None} if measured else {})}
    for key in asked.further_variants:
        if key not in variants:
            error = UnknownNameError(
                f"found requirements on a variant {key!r}; expected one of the report. {near(key, variants)}",
                block=case.diagram.name,
            )
            owners = (f"loops.{name}" for name, of in asked.loops.items() if key in of.variants)
            owner = "" if key in asked.variants else next(owners) + "."
            raise asked.error_at(error, f"{owner}variants")
    flat = case.diagram.flatten(None if case.diagram.has_clock else STEP)
    for limits in asked.steps:
        for end, wire in (("input", limits.input), ("output", limits.output)):
            try:
                if wire:
                    find_signal(flat, wire)
            except LoopwrightError as error:
                several = len(asked.steps) > 1 or asked.step is not None
                raise asked.error_at(error, f"step.{end}" if not several else f"step, {end}") from None


def review(
    case: Case,
    asked: Requirements,
    numbers: Mapping[str, Number],
    measured: Sequence[MeasuredLoop] = (),
    worst_case: ReportedWorstCase | MissingWorstCase | None = None,
    contacts: ReportedContacts | None = None,
    absent: Mapping[str, str] | None = None,
) -> Review:
    """Return the verdicts on requirements; ``absent`` has the reasons why numbers are missing, by path."""
    felt = () if contacts is None else contacts.results(numbers)
    outcomes = {} if worst_case is None else worst_case.outcomes()
    searched = () if worst_case is None else worst_case.results()
    plain = (_plain(path, limit, numbers, outcomes) for path, limit in asked.numbers.items())
    return Review(
        (
            *_of_variants(case, asked, numbers, absent or {}),
            *plain,
            *_measured(case, asked, numbers, measured),
            *searched,
            *felt,
        ),
        free_motions(case.judged()),
    )


def _of_variants(
    case: Case, asked: Requirements, numbers: Mapping[str, Number], absent: Mapping[str, str]
) -> Iterator[RequirementResult]:
    """Yield the verdicts on the variants that are judged."""
    if case.actual is None:
        yield RequirementResult("stable", "", "", STABLE, reason=Reason.NOT_ANALYSED)
    for v in list(case.judged()):
        yield from VariantReview(case, asked, numbers, absent, v).results()


def _measured(
    case: Case, asked: Requirements, numbers: Mapping[str, Number], measured: Sequence[MeasuredLoop]
) -> Iterator[RequirementResult]:
    """Yield the verdicts on margins of measured loops: the whole interval has to be within the limits."""
    named, actual = case.names_of_loops(), case.actual
    dt = actual.model.dt if actual is not None and not actual.problem else 0.0
    for of in measured:
        names = tuple(dict.fromkeys((of.key, *named.get(of.key, ()), of.wire)))
        intervals, own = of.intervals(dt), asked.limits_of_variant(names, MEASURED)
        for name, limit in asked.limits_of(names, MEASURED).items():
            result = RequirementResult(name, of.key, MEASURED, limit)
            if name not in intervals:
                if name in own:
                    yield result
                continue  # a general limit of the model's numbers
            at, path = intervals[name], of.path(name)
            verdict, reason, distance = judge_interval(at.value, at.low, at.high, limit)
            if verdict is Verdict.PASSED and of.uncertainty is None:
                verdict, reason = Verdict.UNDECIDED, Reason.NO_UNCERTAINTY
            said = f"{at.low:.4g} … {at.high:.4g}" if reason is Reason.WITHIN_TOLERANCE else ""
            result = replace(result, verdict=verdict, reason=reason, distance=distance, detail=said)
            yield replace(result, path=path, number=numbers[path]) if path in numbers else result


def _plain(
    path: str, limit: Limit, numbers: Mapping[str, Number], outcomes: Mapping[str, StudyCase]
) -> RequirementResult:
    result = RequirementResult(path, "", "", limit)
    if path in numbers:
        return result.judged(numbers[path], path)
    start, _, name = path.rpartition(".")
    of = outcomes.get(start) if name in SENSES else None
    if of is not None and of.state is CaseState.UNSTABLE:
        return result.failed(Reason.UNSTABLE)
    if of is not None and of.state is CaseState.FAILED:
        return result.undecided(Reason.NOT_ANALYSED, of.reason)
    close = close_names(path, numbers)
    return replace(result, detail=near(path, numbers)) if close else result


def weakest(numbers: Mapping[str, Number], variants: Iterable[str]) -> tuple[str, Number] | None:
    """Return the smallest disk margin of some variants with its path, or else the smallest modulus margin; or None."""
    keys = set(variants)
    for name in ("disk_margin", "modulus_margin"):
        found = {}
        for path, number in numbers.items():
            first, *rest, last = path.split(".")
            if first == "inner" and len(rest) > 1 and rest[1] in keys and last == name and "control" not in rest:
                found[path] = number
        found = {path: number for path, number in found.items() if not math.isnan(number.value)}
        if found:
            path = min(found, key=lambda p: found[p].value)
            return path, found[path]
    return None
