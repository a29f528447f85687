"""Worst case over ranges of parameters: its section, its run, and verdicts on the limits of the search."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError, OptionError
from ...flat import WiredDiagram
from ...frequency import Number
from ...requirements import Limit, Reason, RequirementResult, Requirements, TomlFile, Verdict, judge
from ...studies import (
    CaseOrigin,
    CaseState,
    LoopPlace,
    RunConfirmation,
    StudyCase,
    WorstCase,
    WorstCaseTask,
    cut_places,
    plot_cases,
)
from ..content_hash import content_hash
from ..error_sentences import say
from ..pages import Plot, Section, Table, TableForm, Texts
from .loops import ROWS

TEXTS = Texts(__package__, "worst_case")
KEY = "worst_case"
"""Key of the section, and the variant that its verdicts belong to."""
GROWING, GROWTH = "worst_growth", "growth of the fastest pole"
"""End of the path of an unstable case's number, and its name in words."""

NEXT_TO_NOMINAL = TableForm(
    "Worst case, next to the diagram as it is", {"case": "case", "number": "words", "value": "number"}, digits=4
)
PARAMETERS = TableForm("Parameters of the worst case", {"parameter": "name", "value": "value"})
RANGES = TableForm("Ranges of the parameters", {"parameter": "name", "from": "low", "to": "high", "values": "kind"})


def read_task(
    diagram: WiredDiagram,
    given: WorstCase | WorstCaseTask | str | os.PathLike[str] | None,
    file: TomlFile | None,
    requirements: Requirements | None,
) -> WorstCase | WorstCaseTask | None:
    """Return the worst case of a report, or the task to find it, checked; None where none is asked for."""
    if file is not None and file.table(KEY):
        if given is not None:
            raise file.error(
                "found a worst case here, and another one in worst_case; expected one. Leave one out.", KEY
            )
        given = WorstCaseTask.read(file)
    elif isinstance(given, str | os.PathLike):
        given = WorstCaseTask.read(given)
    if isinstance(given, WorstCaseTask):
        given.check(diagram, requirements)
        return given
    if given is None:
        return None
    if not isinstance(given, WorstCase):
        raise OptionError(
            f"found {given!r}; expected a worst case. Give diagram.worst_case(…), or a TOML file.", port="worst_case"
        )
    if content_hash(given.wired if given.given is None else given.given) != content_hash(diagram):
        raise OptionError(
            f"found a worst case of another diagram; expected one of {diagram.name!r} with its present parameters. "
            "Make it by diagram.worst_case(…).",
            port="worst_case",
        )
    return given


def find_reported(
    diagram: WiredDiagram,
    given: WorstCase | WorstCaseTask,
    requirements: Requirements | None,
    at: Any,
    stairs: str | None,
    notify: Callable[[str], None],
    places: Mapping[str, LoopPlace],
) -> ReportedWorstCase | MissingWorstCase:
    """Return the worst case of a report: one that was found, or one that a file asks for, with its run.

    The loops of a file are cut where the report cuts them: at ``places``, by their keys.
    """
    if isinstance(given, WorstCaseTask):
        options = {} if stairs is None else {"stairs": stairs}
        asked = _name_wires(requirements, places, given.loops)
        diagram = cut_places(diagram, tuple(places.values()))
        moved = [place for place in places.values() if place.to]  # others keep the names of the file
        names = {w: p.name for w in given.loops for p in moved if w == p.wire or p.wire.endswith(f".{w}")}
        given = task = replace(given, loops=tuple(names.get(wire, wire) for wire in given.loops))
        try:
            given = task.find(diagram, asked, at=at, progress=lambda line: notify(f"{KEY}: {line}"), **options)
        except LoopwrightError as error:
            return MissingWorstCase(task.find_limits(diagram, asked), say(error))
    notify("confirming the worst case by a run")
    try:
        return ReportedWorstCase(given, given.confirm())
    except LoopwrightError as error:
        return ReportedWorstCase(given, problem=say(error))


def _name_wires(
    requirements: Requirements | None, places: Mapping[str, LoopPlace], loops: tuple[str, ...]
) -> Requirements | None:
    """Return requirements whose loops are named by wires, as a worst case names them, and not by keys of the report."""
    if requirements is None:
        return None
    names: dict[str, str] = {}
    for key, place in places.items():
        named = next((w for w in loops if place.wire == w or place.wire.endswith(f".{w}")), place.wire)
        names |= dict.fromkeys((key, place.wire, named, place.name), place.name if place.to else named)
    return requirements.with_loops(names)


@dataclass(frozen=True)
class MissingWorstCase:
    """Worst case that a file asks for, and that could not be looked for; its limits by loops and numbers."""

    limits: Mapping[tuple[str, ...], Mapping[str, Limit | None]]
    problem: str

    def outcomes(self) -> dict[str, StudyCase]:
        """Return no case."""
        return {}

    def results(self) -> Iterator[RequirementResult]:
        """Yield an open verdict on each limit."""
        for loop, limits in self.limits.items():
            for quantity, limit in limits.items():
                if limit is not None:
                    place, why = ", ".join(loop), self.problem
                    yield RequirementResult(quantity, place, KEY, limit).undecided(Reason.NOT_ANALYSED, why)

    def section(self) -> Section:
        """Return the section, which has the reason alone."""
        return Section(KEY, "Worst case", (TEXTS.line("missing", message=self.problem),))


@dataclass(frozen=True)
class ReportedWorstCase:
    """Worst case of a report, with its run where it has one."""

    found: WorstCase
    run: RunConfirmation | None = None
    problem: str = ""

    def outcomes(self) -> dict[str, StudyCase]:
        """Return the diagram as it is and the worst case, by the paths of their numbers."""
        nominal = min(self.found.nominal, key=lambda case: case.goodness)
        return {f"{KEY}.as_it_is": nominal, f"{KEY}.worst": self.found.worst}

    def results(self) -> Iterator[RequirementResult]:
        """Yield the verdicts on the limits that the worst case was looked for with, one for each loop and number."""
        for loop, limits in self.found.goal.loops.items():
            for quantity, limit in limits.items():
                if limit is not None:
                    yield self._result(loop, quantity, limit)

    def _result(self, loop: tuple[str, ...], quantity: str, limit: Limit) -> RequirementResult:
        found = self.found
        result = RequirementResult(quantity, ", ".join(loop), KEY, limit)
        if found.unstable:
            return result.failed(Reason.UNSTABLE)
        mine = [case for case in found.cases if quantity in case.numbers.get(loop, {})]
        numbers = [(case, case.numbers[loop][quantity]) for case in mine]
        known = [(case, n) for case, n in numbers if not math.isnan(n.value)]
        if not known:
            return result
        case, number = min(known, key=lambda pair: limit.distance(pair[1].value))
        is_worst = case is found.worst
        result = result.judged(number, f"{KEY}.worst.{quantity}" if is_worst and quantity == case.quantity else "")
        if found.failures and result.verdict is not Verdict.FAILED:
            return result.undecided(Reason.NOT_ANALYSED, found.failures[0].reason.rstrip("."))
        if result.verdict is Verdict.PASSED and len(known) < len(numbers):  # some case has no such number
            return result.undecided(Reason.NO_VALUE)
        if result.verdict is Verdict.PASSED and any(one.state is CaseState.MOVING for one in found.cases):
            return result.undecided(Reason.MOVING)
        if is_worst and loop == case.loop:
            there = {at: numbers.get(quantity) for at, numbers in found.elsewhere.items()}
            if any(n is None or judge(n, limit)[0] is not result.verdict for n in there.values()):
                said = [f"{n.value:.4g} at {at}" for at, n in {"this cut": number, **there}.items() if n is not None]
                return result.undecided(Reason.SEVERAL_CUTS, ", ".join(said))
        if is_worst and self.run is not None and not self.run.agrees:
            return result.undecided(Reason.REFUTED)
        return result


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _ranges(found: WorstCase) -> Table:
    """Return the table of the ranges that were searched, or of the samples that were given in their place."""
    rows: list[dict[str, str]] = []
    for name in dict.fromkeys(name for case in found.cases for name in case.parameters):
        box = found.boxes.get(name)
        if box is not None:
            ends = {"low": _text(box.low), "high": _text(box.high)}
            rows.append({"name": name, **ends, "kind": f"range, {box.scale}"})
            continue
        values = [case.parameters[name] for case in found.cases if name in case.parameters]
        plain = all(isinstance(value, float | int) and not isinstance(value, bool) for value in values)
        low, high = (_text(min(values)), _text(max(values))) if plain else ("–", "–")
        rows.append({"name": name, "low": low, "high": high, "kind": "given samples"})
    return RANGES.fill(rows)


def worst_case_of(reported: ReportedWorstCase | MissingWorstCase) -> Section:
    """Return the section on a worst case: its parameters, its number and the nominal one, its run, and a scatter."""
    if isinstance(reported, MissingWorstCase):
        return reported.section()
    found, run = reported.found, reported.run
    nominal, worst = reported.outcomes().values()
    origins = {case.origin for case in found.cases}
    facts = {"corners": CaseOrigin.CORNER in origins, "searched": CaseOrigin.SEARCH in origins}
    counts = {"cases": len(found.cases), "unstable": len(found.unstable), "failed": len(found.failures)}
    text = [TEXTS.line("worst", **counts, **facts)]
    if found.goal.left_out:
        text.append(TEXTS.line("not_looked_at", names=found.goal.left_out))
    # A run of the worst case confirms it only if it agrees; one that doesn't is in the text.
    confirmed = run.trial if run is not None and run.agrees else ""
    if run is None:
        text.append(TEXTS.line("left_out", wire=", ".join(worst.loop) or "worst case", message=reported.problem))
    else:
        text.append(f"{str(run)[0].upper()}{str(run)[1:]}.")
    numbers: dict[str, Number] = {}
    for name, case in (("as_it_is", nominal), ("worst", worst)):
        if case.state is CaseState.UNSTABLE:
            numbers[f"{name}.{GROWING}"] = Number(case.growth, "1/s", 1e-6 * abs(case.growth), confirmed)
        elif case.quantity:
            number = case.numbers[case.loop][case.quantity]
            how = f"{number.confirmed_by}; {confirmed}" if confirmed and case is worst else number.confirmed_by
            numbers[f"{name}.{case.quantity}"] = replace(number, confirmed_by=how)
    rows = [
        {"case": case.replace("_", " "), "words": ROWS.get(name, GROWTH if name == GROWING else name), "number": number}
        for (case, _, name), number in ((path.partition("."), number) for path, number in numbers.items())
    ]
    tables = [NEXT_TO_NOMINAL.fill(rows)]
    if worst.parameters:
        tables.append(PARAMETERS.fill({"name": name, "value": _text(v)} for name, v in worst.parameters.items()))
    tables.append(_ranges(found))
    plots = []
    if any(np.ndim(value) == 0 for value in worst.parameters.values()):
        plots.append(
            Plot(
                "worst_case",
                TEXTS.line("scatter"),
                plot_cases(found.cases, found.worst, found.goal, found.boxes, is_shown=False),
            )
        )
    return Section(KEY, "Worst case", tuple(text), tuple(tables), tuple(plots), numbers)
