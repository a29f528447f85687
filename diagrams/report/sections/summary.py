"""The first page of a report: verdicts, the weakest margin, and all that was not analysed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ....blocks.core import LoopwrightError, print_unit
from ...frequency import Number, find_disk_frequency, order_key, realize
from ...linearization import Linearization, find_signal
from ...requirements import (
    COLUMNS,
    DIGITS,
    MOST_REQUIREMENTS,
    NOTHING,
    RequirementResult,
    Review,
    Verdict,
    by_loop,
    explain,
    rank,
    reason_in_table,
    row_of,
)
from ...studies import CaseState
from ..case import Case
from ..case_verdicts import weakest
from ..figures import HEIGHTS, fit_overview
from ..pages import SUMMARY, Judged, Plot, Section, Table, Texts, compare_columns
from ..stability import free_motions
from ..variant import Cut, Implementation, Variant
from ..wires_on_loops import find_same
from .contacts import KEY as CONTACT
from .loops import ROWS
from .measured_loops import MEASURED
from .poles import unstable_first
from .step_responses import NAMES
from .step_runs import APART, step_tests
from .worst_case import KEY as WORST_CASE
from .worst_case import MissingWorstCase, ReportedWorstCase

TEXTS = Texts(__package__, "summary")
TITLE = "Summary"
LOOP_NUMBERS = (
    "phase_margin_deg",
    "gain_margin_low",
    "gain_margin_high",
    "delay_margin_s",
    "disk_margin",
    "ms",
    "bandwidth",
)
"""Numbers of the loops that stand on the first page."""
ALIKE = 0.05
"""Relative difference up to which a margin is hardly changed."""


def summarize(
    case: Case,
    reviewed: Review | None,
    numbers: Mapping[str, Number],
    worst_case: ReportedWorstCase | MissingWorstCase | None = None,
    more: Sequence[Table] = (),
    sections: Sequence[Section] = (),
) -> Section:
    """Return the first section of a report, which can stand alone; ``sections`` are the others, with small figures."""
    unstable = unstable_first(case)
    text = [*(unstable.text if unstable is not None else ())]
    tables = []
    if reviewed is None:
        text.append(TEXTS.line("no_requirements"))
    else:
        counts = {verdict.name.lower(): len(reviewed.of(verdict)) for verdict in Verdict}
        said = TEXTS.line("verdict", verdict=reviewed.verdict.name, total=len(reviewed.results), **counts)
        text.append(Judged(said, reviewed.verdict))
        tables.append(_requirements(reviewed, MOST_REQUIREMENTS))
    motions = free_motions(case.judged()) if reviewed is None else reviewed.free
    text += [TEXTS.line("drifts", motions=[str(motion) for motion in motions])] if motions else []
    text += _weakest(case, numbers)
    text += [_worst_case(worst_case)] if worst_case is not None else []
    loops = _loops(case, numbers)
    tables += [*([loops] if loops is not None else []), *more]
    plots, left_out = _overview(case, numbers, sections)
    missing = list(dict.fromkeys([*_not_analysed(case, numbers), *_not_confirmed(worst_case)]))
    if missing:
        text += [TEXTS.line("not_analysed"), *(f"- {line}" for line in missing)]
    text += [TEXTS.line("loops_left_out", wires=left_out)] if left_out else []
    return Section(SUMMARY, TITLE, tuple(text), tuple(tables), plots)


def all_requirements(reviewed: Review | None) -> Section | None:
    """Return the chapter with all requirements, None where the summary has them all."""
    if reviewed is None or len(reviewed.results) <= MOST_REQUIREMENTS:
        return None
    return Section("requirements", "Requirements", (), (_requirements(reviewed, len(reviewed.results)),))


def _requirements(reviewed: Review, most: int) -> Table:
    """Return the table of so many requirements: those that fail first, then those that are not decided."""
    ranked = rank(reviewed.results)
    rows = tuple(_row(result) for result in by_loop(ranked[:most]))
    note = TEXTS.line("distance")
    if len(ranked) > most:
        note = TEXTS.line("more_requirements", shown=most, total=len(ranked)) + f" {note}"
    terms = {"distance": "distance_to_limit"}
    return Table("Requirements", COLUMNS, rows, note, digits=DIGITS, terms=terms, brief=True)


def _overview(
    case: Case, numbers: Mapping[str, Number], sections: Sequence[Section]
) -> tuple[tuple[Plot, ...], list[str]]:
    """Return the small figures of each loop, side by side, and the wires of loops for which there is no room."""
    # a loop that another one shows has none; those with the smallest disk margins are shown, then required steps
    groups: dict[str, list[Plot]] = {}
    for plot in _small_figures(sections):
        groups.setdefault(plot.group, []).append(plot)
    wires = case.loop_wires()
    by_loop: dict[str, dict[str, Number]] = {key: {} for key in wires}
    for path, number in numbers.items():
        first, _, rest = path.partition(".")
        key, _, end = rest.partition(".")
        if first == "inner" and key in by_loop and ".control." not in path:
            by_loop[key][end] = number
    hidden = find_same(by_loop)
    loops = [key for key in wires if key in groups and key not in hidden]
    shown = set(sorted(loops, key=lambda key: _smallest_margin(case, key, by_loop[key]))[: len(HEIGHTS)])
    others = [key for key in groups if key not in wires][: len(HEIGHTS) - len(shown)]
    kept = [*(key for key in loops if key in shown), *others]
    return fit_overview([groups[key] for key in kept]), [wires[key] for key in loops if key not in shown]


def _smallest_margin(case: Case, key: str, numbers: Mapping[str, Number]) -> float:
    """Return the smallest disk margin of a loop of the diagram as it is, for an order that rounding doesn't change."""
    actual = [] if case.actual is None else [case.actual.key]
    found = weakest({f"inner.{key}.{end}": number for end, number in numbers.items()}, actual)
    return math.inf if found is None else order_key(found[1].value)


def _small_figures(sections: Sequence[Section]) -> Iterator[Plot]:
    for section in sections:
        yield from section.overview
        yield from _small_figures(section.sections)


def with_words(case: Case, reviewed: Review) -> Review:
    """Return a review whose results have their quantities, places and variants in words."""
    return replace(reviewed, results=tuple(_with_words(case, result) for result in reviewed.results))


def _with_words(case: Case, result: RequirementResult) -> RequirementResult:
    variant = case.variants.get(result.variant)
    place = case.loop_wires().get(result.loop, result.loop) or result.place
    place = f"{place}, with {result.detail}" if result.variant == CONTACT and place and result.detail else place
    place = f"{place}: {result.step}" if result.step else place
    place = TEXTS.line("all_renewals", wire=place) if f".{Cut.PERIODIC}." in result.path else place
    others = {MEASURED: "measured", WORST_CASE: "worst case", CONTACT: "as it is"}
    title = variant.title if variant else others.get(result.variant, NOTHING)
    return replace(result, words=words_of(result.quantity), where=place, title=title)


def _row(result: RequirementResult) -> tuple[Any, ...]:
    verdict, *others = row_of(result)
    why = reason_in_table(result)
    said = Judged(str(verdict), verdict, why)
    if not why and (word := explain(result)):  # which the row has
        said = Judged(f"{verdict}: {word}", verdict)
    return (said, *others)


def words_of(quantity: str) -> str:
    """Return the name of a quantity in words."""
    if quantity == "stable":
        return TEXTS.line("stable")
    head, _, tail = quantity.partition(".")
    if head == CONTACT:
        return TEXTS.line("contact", vary=tail)
    return NAMES.get(tail, tail) if head == "step" else ROWS.get(quantity, quantity)


def _weakest(case: Case, numbers: Mapping[str, Number]) -> Iterator[str]:
    """Yield the weakest margin of the diagram as it is, and the same place in variants that leave something out."""
    actual = case.actual
    if actual is None:
        return
    found = weakest(numbers, [actual.key])
    if found is None and not case.loop_wires():
        return
    if found is None:
        yield TEXTS.line("no_margin")
        return
    path, number = found
    alpha = number.value
    facts: dict[str, Any] = {"wire": _wire(case, path), "alpha": alpha, "place": case.name_place(_place(path))}
    if path.rpartition(".")[2] != "disk_margin":
        yield TEXTS.line("weakest_modulus", **facts)
        return
    facts |= {"low": (2 - alpha) / (2 + alpha), "high": (2 + alpha) / (2 - alpha) if alpha < 2 else math.inf}
    facts |= {
        "phase": 2 * math.degrees(math.atan(alpha / 2)),
        "frequency": _frequency(actual, facts["wire"], path, numbers),
    }
    yield TEXTS.line("weakest", **facts)
    others = [(v, numbers[p].value) for v, p in _elsewhere(case, path) if p in numbers]
    raised = [(v.title, value) for v, value in others if value > alpha * (1 + ALIKE)]
    if raised:
        best = sorted(raised, key=lambda item: -item[1])
        yield TEXTS.line("why", others=best)
    elif others:
        yield TEXTS.line("why_not", titles=[v.title for v, _ in others])


def _worst_case(reported: ReportedWorstCase | MissingWorstCase) -> str:
    """Return the line on a worst case: its number, its growth, or the reason why it could not be analysed."""
    if isinstance(reported, MissingWorstCase):
        return TEXTS.line("no_worst_case", reason=reported.problem)
    found, worst = reported.found, reported.found.worst
    number = worst.numbers.get(worst.loop, {}).get(worst.quantity)
    shown = "" if number is None else print_unit(number.unit)
    return TEXTS.line(
        "worst_case",
        state=worst.state.name,
        wire=", ".join(worst.loop),
        cases=len(found.cases),
        quantity=words_of(worst.quantity),
        value=worst.value,
        unit=shown,
        spaced=shown not in ("", "°"),
        growth=worst.growth,
        reason=worst.reason.rstrip("."),
    )


def _not_confirmed(reported: ReportedWorstCase | MissingWorstCase | None) -> Iterator[str]:
    """Yield a line on a worst case that no run confirms."""
    if isinstance(reported, ReportedWorstCase) and reported.found.worst.state is not CaseState.FAILED:
        run = reported.run
        if run is None or not run.agrees:
            trial = "" if run is None else run.trial
            yield TEXTS.line("worst_case_not_confirmed", trial=trial, problem=reported.problem)


def _frequency(v: Variant, wire: str, path: str, numbers: Mapping[str, Number]) -> float | None:
    """Return the frequency in rad/s of a disk margin; None where it is not known. It need not be that of M_s."""
    start = path.rpartition(".")[0]
    for name in ("disk_frequency", "frequency"):
        if f"{start}.{name}" in numbers and math.isfinite(numbers[f"{start}.{name}"].value):
            return numbers[f"{start}.{name}"].value
    if f"{start}.ms_frequency" not in numbers:
        return None
    try:
        cut, _, L = v.fullest_loop(wire)
    except LoopwrightError:
        return None
    is_this = path.split(".")[3:-1] == ([] if cut is Cut.PLAIN else [cut.value])
    found = find_disk_frequency(realize(L)) if is_this else math.inf
    return found if math.isfinite(found) else None


def _elsewhere(case: Case, path: str) -> Iterator[tuple[Variant, str]]:
    first, loop, key, *rest = path.split(".")
    for v in case.usable():
        if v.key != key:
            yield v, ".".join([first, loop, v.key, *rest])


def _wire(case: Case, path: str) -> str:
    key = path.split(".")[1]
    return case.loop_wires().get(key, key)


def _place(path: str) -> str:
    """Return the part of a path between the variant and the number, such as a point of the path."""
    return ".".join(path.split(".")[3:-1])


def _loops(case: Case, numbers: Mapping[str, Number]) -> Table | None:
    """Return the table of the loops of the diagram as it is."""
    actual = case.actual
    if actual is None:
        return None
    found: dict[str, dict[str, Number]] = {}
    for key, wire in case.loop_wires().items():
        starts = (f"inner.{key}.{actual.key}.{cut}" for cut in ("", "periodic."))
        start = next((s for s in starts if f"{s}stable" in numbers or f"{s}disk_margin" in numbers), None)
        if start is not None:
            found[wire] = {name: numbers[f"{start}{name}"] for name in LOOP_NUMBERS if f"{start}{name}" in numbers}
    if not found:
        return None
    names = {name: ROWS[name] for name in LOOP_NUMBERS if any(name in values for values in found.values())}
    note = TEXTS.line("confirmed")
    return compare_columns(TEXTS.line("loops"), names, found.items(), note, digits=DIGITS, brief=True)


def _not_analysed(case: Case, numbers: Mapping[str, Number]) -> Iterator[str]:
    if case.actual is None:
        yield TEXTS.line("no_actual")
    for v in case.variants.values():
        if v.problem:
            yield TEXTS.line("variant_left_out", variant=v.title, problem=v.problem)
    actual = case.actual
    if actual is None or actual.problem:
        return
    found = {path.split(".")[1] for path in numbers if path.split(".")[0::2][:2] == ["inner", actual.key]}
    analysed = [wire for key, wire in case.loop_wires().items() if key in found]
    for key, wire in case.loop_wires().items():
        by_slower = key in found and actual.goes_by_slower(wire)
        if "inner" in case.keys and (key not in found or by_slower):
            elsewhere, judged = actual.loops_elsewhere(wire, analysed), case.requirements is not None
            if elsewhere or not by_slower:
                yield TEXTS.line("loop_left_out", wire=wire, elsewhere=elsewhere, judged=judged, by_slower=by_slower)
    yield from _apart(case, numbers)
    model = _model(actual)
    if model is not None and not actual.rests and not actual.moving_alone:
        yield TEXTS.line("moving", largest=actual.moves_most)
    for finding in () if model is None else model.findings:
        yield str(finding)
    if "inner" in case.keys and not case.loop_wires():
        yield TEXTS.line("no_loop")
        return
    flat = actual.diagram.flatten_like(actual.point)
    several = all(len(find_signal(flat, wire).entries) > 1 for wire in case.loop_wires().values())
    sampled = any(case.usable(Implementation.SAMPLED, Implementation.DELAYED, Implementation.OWN))
    for key in ("steps", "injection"):
        if key in case.keys and not any(path.split(".")[0] == key for path in numbers):
            yield TEXTS.line("no_run", key=key, several=several, sampled=sampled)


def _apart(case: Case, numbers: Mapping[str, Number]) -> Iterator[str]:
    """Yield a line on each response that is limited and that the linear model does not have."""
    for v in case.judged():
        for test in step_tests(case, v) if not v.problem else ():
            difference = numbers.get(f"steps.{test.key}.{v.key}.difference")
            if test.limits is not None and difference is not None and difference.value > APART:
                variant = "" if v.is_actual else v.title
                yield TEXTS.line("apart", step=str(test), variant=variant, difference=difference.value)


def _model(v: Variant) -> Linearization | None:
    try:
        return v.model
    except LoopwrightError:
        return None
