"""Margins over parameters: sensitivity of the loops of the diagram as it is."""

from __future__ import annotations

import re
from dataclasses import replace

from ....blocks.core import BetweenTicksError, LoopwrightError, PeriodicLoopError
from ...frequency import Number
from ...studies import Sensitivities, Sensitivity, confirm_parameter, sensitivities_of
from .. import figures
from ..case import Case
from ..error_sentences import say
from ..pages import Section, TableForm, Texts
from ..wires_on_loops import find_same, is_same
from .loops import ROWS

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
    confirmed: list[Sensitivity] = []
    for key, wire in case.sensitivity_wires().items():
        case.notify(f"sensitivity at {wire}")
        try:
            found = sensitivities_of(variant.model, (wire,))
        except (PeriodicLoopError, BetweenTicksError) as error:
            text.append(TEXTS.line("no_loop", wire=wire, between=isinstance(error, BetweenTicksError)))
            continue
        except LoopwrightError as error:
            text.append(TEXTS.line("left_out", wire=wire, message=say(error)))
            continue
        if not found.stable:
            text.append(TEXTS.line("unstable", wire=wire))
        elif found.rows:
            parts.append(_part(case, key, wire, found, confirmed))
    wires, shown = case.sensitivity_wires(), find_same({part.key: part.numbers for part in parts})
    for i, part in enumerate(parts):
        if part.key in shown:
            said = TEXTS.line("same", wire=wires[shown[part.key]])
            parts[i] = replace(part, text=(said, *part.text), plots=())
    return Section("sensitivity", "Sensitivity to parameters", tuple(text), sections=tuple(parts)) if parts else None


def _part(case: Case, key: str, wire: str, found: Sensitivities, confirmed: list[Sensitivity]) -> Section:
    """Return the part of one loop; ``confirmed`` are the sensitivities of earlier loops, which one may have again."""
    shown = [name for name in QUANTITIES if name in found.quantities]
    first = next((name for name in shown if any(map(_acts, found.of(name)))), shown[0])
    largest = [row for row in found.of(first) if _acts(row)]
    names = [row.parameter for row in largest[:SHOWN]]
    others = [row.parameter for row in largest[SHOWN:]]
    rows: list[dict[str, object]] = []
    bars: dict[str, float] = {}
    kinks: list[str] = []
    lost: list[str] = []
    text: list[str] = []
    for name in names:
        # Confirming costs linearizations on both sides of the value, so what an earlier loop has confirmed is taken.
        try:
            made = _take_confirmed([found[name, quantity] for quantity in shown], confirmed)
            if not made:
                case.notify(f"confirming the sensitivity at {wire} to {name}")
                made = confirm_parameter(found, name, shown)
                confirmed += made
        except LoopwrightError as error:
            text.append(TEXTS.line("left_out", wire=wire, message=say(error)))
            # The slopes are shown without their confirmation, and the text says why.
            rough = [found[name, quantity] for quantity in shown]
            made = [replace(row, slope=replace(row.slope, confirmed_by="")) for row in rough]
        bars[name] = next(row for row in made if row.quantity == first).per_percent.value
        for row in made:
            kinks += [name] if row.kink else []
            lost += [name] if row.rest_lost else []
        value = found[name, first]
        facts = {"value": Number(value.value, value.unit or "1", 0.0, "", given=True), "key": _path(name)}
        rows.append({"parameter": name, **facts, **{row.quantity: row.per_percent for row in made}})
    if kinks:
        text.append(TEXTS.line("kink", names=", ".join(dict.fromkeys(kinks))))
    if lost:
        text.append(TEXTS.line("lost", names=", ".join(dict.fromkeys(lost))))
    if others:
        text.append(TEXTS.line("others", names=", ".join(others), number=ROWS[first]))
    small = [row.parameter for row in found.of(first) if not _acts(row)]
    none = sorted({*found.without_effect, *small})
    if none:
        text.append(TEXTS.line("without", count=len(none), number=ROWS[first]))
    form = TableForm(
        "Largest sensitivities at {wire}",
        {"parameter": "parameter", "value": "value", **{f"{ROWS[quantity]} per +1 %": quantity for quantity in shown}},
        {quantity: f"{{key}}.{quantity}_per_percent" for quantity in shown},
        digits=4,
        terms={"value": "parameter_value"},
    )
    plot = figures.sensitivity_bars(f"sensitivity_{key}", wire, ROWS[first], bars)
    return Section(key, f"Sensitivity of {wire}", tuple(text), (form.fill(rows, wire=wire),), (plot,))


def _take_confirmed(rows: list[Sensitivity], confirmed: list[Sensitivity]) -> list[Sensitivity]:
    """Return sensitivities with the confirmation of the same ones of an earlier loop; none if one isn't there."""
    # a loop that is cut at another of its wires has the same numbers with the same slopes
    made = []
    for row in rows:
        same = (
            one
            for one in confirmed
            if (one.parameter, one.quantity) == (row.parameter, row.quantity)
            and is_same(one.number.value, row.number.value)
            and is_same(one.slope.value, row.slope.value)
        )
        if (one := next(same, None)) is None:
            return []
        made.append(replace(row, slope=replace(row.slope, confirmed_by=one.slope.confirmed_by)))
    return made


def _acts(row: Sensitivity) -> bool:
    return abs(row.per_percent.value) > SMALL * abs(row.number.value)


def _path(parameter: str) -> str:
    """Return a parameter's part of dotted paths."""
    return re.sub(r"\W+", "_", parameter).strip("_")
