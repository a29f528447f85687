"""Margins over parameters: sensitivity of the loops of the diagram as it is, and a worst case over ranges."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from ...blocks.core import LoopwrightError, OptionError
from .. import report_figures as figures
from ..flat import WiredDiagram
from ..frequency import Number
from ..report_writing import Plot, Section, Table, Texts
from ..studies import Case as StudyCase
from ..studies import CaseOrigin, CaseState, Sensitivities, Sensitivity, WorstCase, confirm_parameter, sensitivities_of
from .case import Case
from .content_hash import content_hash
from .section_loops import ROWS

TEXTS = Texts(__package__, "sensitivity")
QUANTITIES = ("disk_margin", "phase_margin_deg", "ms")
"""Numbers of a loop whose changes are shown; the first that any parameter changes orders the parameters."""
SHOWN = 4
"""Number of parameters of a loop that are shown and confirmed."""
SMALL = 1e-6
"""Change per 1 %, relative to the number, below which a parameter counts as without effect."""


def sensitivity(case: Case) -> Section | None:
    """Return the section on sensitivities, one part for each loop; None where no loop has any."""
    variant = case.actual
    if variant is None or variant.problem:
        return None
    text, parts = [*TEXTS.paragraphs("about", title=variant.title)], []
    for key, wire in case.sensitivity_wires().items():
        try:
            found = sensitivities_of(variant.model, (wire,))
        except LoopwrightError as error:
            text.append(TEXTS.line("left_out", wire=wire, message=error.message))
            continue
        if not found.stable:
            text.append(TEXTS.line("unstable", wire=wire))
        elif found.rows:
            parts.append(_part(case, key, wire, found))
    return Section("sensitivity", "Sensitivity to parameters", tuple(text), sections=tuple(parts)) if parts else None


def _part(case: Case, key: str, wire: str, found: Sensitivities) -> Section:
    shown = [name for name in QUANTITIES if name in found.quantities]
    first = next((name for name in shown if any(map(_acts, found.of(name)))), shown[0])
    largest = [row for row in found.of(first) if _acts(row)]
    names = [row.parameter for row in largest[:SHOWN]]
    others = [row.parameter for row in largest[SHOWN:]]
    rows: list[tuple[object, ...]] = []
    numbers: dict[str, Number] = {}
    bars: dict[str, float] = {}
    kinks: list[str] = []
    lost: list[str] = []
    text: list[str] = []
    for name in names:
        try:
            made = confirm_parameter(found, name, shown)
        except LoopwrightError as error:
            text.append(TEXTS.line("left_out", wire=wire, message=error.message))
            rough = [found[name, quantity] for quantity in shown]
            made = [replace(row, slope=replace(row.slope, confirmed_by="")) for row in rough]
        bars[name] = next(row for row in made if row.quantity == first).per_percent.value
        for row in made:
            numbers[f"{_path(name)}.{row.quantity}_per_percent"] = row.per_percent
            kinks += [name] if row.kink else []
            lost += [name] if row.rest_lost else []
        cells = [row.per_percent for row in made]
        value = found[name, first]
        rows.append((name, Number(value.value, value.unit or "1", 0.0, "", given=True), *cells))
    if kinks:
        text.append(TEXTS.line("kink", wire=wire, names=", ".join(dict.fromkeys(kinks))))
    if lost:
        text.append(TEXTS.line("lost", wire=wire, names=", ".join(dict.fromkeys(lost))))
    if others:
        text.append(TEXTS.line("others", wire=wire, names=", ".join(others), number=ROWS[first]))
    small = [row.parameter for row in found.of(first) if not _acts(row)]
    none = sorted({*found.without_effect, *small})
    if none:
        text.append(TEXTS.line("without", wire=wire, count=len(none), number=ROWS[first]))
    columns = ("parameter", "value", *(f"{ROWS[quantity]} per +1 %" for quantity in shown))
    table = Table(f"Largest sensitivities at {wire}", columns, tuple(rows), digits=4)
    plot = figures.sensitivity_bars(f"sensitivity_{key}", wire, ROWS[first], bars)
    return Section(key, f"Sensitivity of {wire}", tuple(text), (table,), (plot,), numbers)


def _acts(row: Sensitivity) -> bool:
    return abs(row.per_percent.value) > SMALL * abs(row.number.value)


def _path(parameter: str) -> str:
    """Return a parameter's part of dotted paths."""
    return re.sub(r"\W+", "_", parameter).strip("_")


def check_worst_case(diagram: WiredDiagram, found: WorstCase) -> None:
    """Check that a worst case is one of this diagram.

    Raises
    ------
    OptionError
        If there is something else, or a worst case of another diagram.
    """
    if not isinstance(found, WorstCase):
        raise OptionError(f"found {found!r}; expected a worst case. Give diagram.worst_case(…).", port="worst_case")
    if content_hash(found.base) != content_hash(diagram):
        raise OptionError(
            f"found a worst case of another diagram; expected one of {diagram.name!r} with its present parameters. "
            "Make it by diagram.worst_case(…).",
            port="worst_case",
        )


def worst_case_outcomes(found: WorstCase) -> dict[str, StudyCase]:
    """Return the diagram as it is and the worst case, by the paths that their numbers stand below."""
    nominal = min(found.nominal, key=lambda case: case.goodness)
    return {"worst_case.as_it_is": nominal, "worst_case.worst": found.worst}


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _ranges(found: WorstCase) -> Table:
    """Return the table of the ranges that were searched, or of the samples that were given in their place."""
    rows: list[tuple[str, str, str, str]] = []
    for name in dict.fromkeys(name for case in found.cases for name in case.parameters):
        box = found.boxes.get(name)
        if box is not None:
            rows.append((name, _text(box.low), _text(box.high), f"range, {box.scale}"))
            continue
        values = [case.parameters[name] for case in found.cases if name in case.parameters]
        plain = all(isinstance(value, float | int) and not isinstance(value, bool) for value in values)
        low, high = (_text(min(values)), _text(max(values))) if plain else ("–", "–")
        rows.append((name, low, high, "given samples"))
    return Table("Ranges of the parameters", ("parameter", "from", "to", "values"), tuple(rows))


def worst_case_of(found: WorstCase) -> Section:
    """Return the section on a worst case: its parameters, its number beside the nominal one, its run, and a scatter."""
    nominal, worst = worst_case_outcomes(found).values()
    origins = {case.origin for case in found.cases}
    facts = {"corners": CaseOrigin.CORNER in origins, "searched": CaseOrigin.SEARCH in origins}
    counts = {"cases": len(found.cases), "unstable": len(found.unstable), "failed": len(found.failures)}
    text = [TEXTS.line("worst", **counts, **facts)]
    confirmed = ""
    try:
        made = found.confirm()
        confirmed = made.trial if made.agrees else ""
        text.append(str(made) + ".")
    except LoopwrightError as error:
        text.append(TEXTS.line("left_out", wire=", ".join(worst.loop) or "worst case", message=error.message))
    numbers: dict[str, Number] = {}
    for name, case in (("as_it_is", nominal), ("worst", worst)):
        if case.state is CaseState.UNSTABLE:
            numbers[f"{name}.worst_growth"] = Number(case.growth, "1/s", 1e-6 * abs(case.growth), confirmed)
        elif case.quantity:
            number = case.numbers[case.loop][case.quantity]
            how = f"{number.confirmed_by}; {confirmed}" if confirmed and case is worst else number.confirmed_by
            numbers[f"{name}.{case.quantity}"] = replace(number, confirmed_by=how)
    rows = [
        (path.partition(".")[0].replace("_", " "), path.partition(".")[2], number) for path, number in numbers.items()
    ]
    tables = [Table("Worst case, beside the diagram as it is", ("case", "number", "value"), tuple(rows), digits=4)]
    given = tuple((name, _text(value)) for name, value in worst.parameters.items())
    if given:
        tables.append(Table("Parameters of the worst case", ("parameter", "value"), given))
    tables.append(_ranges(found))
    plots = []
    if any(np.ndim(value) == 0 for value in worst.parameters.values()):
        plots.append(Plot("worst_case", TEXTS.line("scatter"), found.plot()))
    return Section("worst_case", "Worst case", tuple(text), tuple(tables), tuple(plots), numbers)
