"""Margins of the loops at the wires of a case: those with names that lie on loops, where nothing else is said."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError
from ...frequency import (
    Comparison,
    Margins,
    Number,
    PeriodicMargins,
    Realization,
    compare_margins,
    margins,
    periodic_margins,
    with_findings,
)
from .. import figures
from ..case import Case
from ..pages import Section, Table, Texts
from ..variant import Cut, Variant, in_s
from ..wires import blocks_on_loops
from .disks import several
from .gang import gang_of_four
from .poles import list_poles
from .uncertainty import LoopPart, cut_key, left_out, widened

TEXTS = Texts(__package__, "loops")
ROWS: Mapping[str, str] = {
    "gain_margin_low": "gain margin, low",
    "gain_margin_high": "gain margin, high",
    "phase_margin_deg": "phase margin",
    "delay_margin_s": "delay margin",
    "delay_margin_samples": "delay margin in samples",
    "modulus_margin": "modulus margin",
    "disk_margin": "disk margin α",
    "ms": "M_s",
    "ms_frequency": "M_s at",
    "mt": "M_t",
    "mt_frequency": "M_t at",
    "bandwidth": "bandwidth",
}
LOOPS_TITLE = "Loops"
PERIODIC = frozenset(f.name for f in fields(PeriodicMargins))


def inner(case: Case) -> Section | None:
    """Return the section about the loops, one part for each wire; None where nothing is to be said of any."""
    text, parts = [*TEXTS.paragraphs("margins")], []
    for key, wire in case.loop_wires().items():
        part = _wire(case, key, wire)
        if part is None:
            text += left_out(case, wire, blocks_on_loops(case.diagram))
        else:
            parts.append(widened(wire, part))
    if not parts:
        text = text[len(TEXTS.paragraphs("margins")) :]  # they are about the numbers
        if not text:
            return None
    return Section("inner", LOOPS_TITLE, tuple(text), sections=tuple(parts))


def _wire(case: Case, key: str, wire: str) -> LoopPart | None:
    own: dict[tuple[Variant, Cut], Mapping[str, Number]] = {}
    found: dict[str, Margins] = {}
    loops: dict[str, Any] = {}
    titles: dict[str, str] = {}
    designs: list[str] = []
    periodic: dict[str, PeriodicMargins] = {}
    notes: list[str] = []
    numbers: dict[str, Number] = {}
    beside: list[tuple[Any, ...]] = []
    for v in case.usable():
        try:
            cut, title, L = v.fullest_loop(wire)
            if L.ninputs > 1:
                return several(case, key, wire)
            m = margins(L)
        except LoopwrightError as error:
            notes.append(f"{v.title}: {error.message}")
            continue
        at = cut_key(v, cut)
        found[at], loops[at], titles[at] = m, L, title
        designs += [at] if v.is_design or v.is_actual else []
        own[v, cut] = with_findings(_numbers(m), m.findings)
        numbers |= {f"{at}.{name}": number for name, number in own[v, cut].items()}
        if m.hidden_unstable:
            shown = _poles(m.hidden_unstable, L.dt)
            notes.append(TEXTS.line("hidden_unstable", variant=title, poles=shown))
        if cut is Cut.SLOW_OPEN:
            try:
                p = periodic_margins(v.loop(wire, cut=Cut.PERIODIC))
            except LoopwrightError as error:
                notes.append(f"{v.title}: {error.message}")
            else:
                periodic[v.title] = p
                own[v, Cut.PERIODIC] = with_findings(_periodic_numbers(p), p.findings)
                where = cut_key(v, Cut.PERIODIC)
                numbers |= {f"{where}.{name}": number for name, number in own[v, Cut.PERIODIC].items()}
                if not p.stable:
                    shown = _poles(p.unstable_poles, p.dt)
                    notes.append(TEXTS.line("unstable", variant=v.title, poles=shown))
        if not m.stable:
            notes.append(TEXTS.line("unstable", variant=title, poles=_poles(m.unstable_poles, L.dt)))
        elif v.is_design:
            try:
                with np.errstate(all="ignore"):
                    r = Realization.of(L)
                    rows = compare_margins(r, m, _as_control(r))
            except (LoopwrightError, np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
                notes.append(TEXTS.line("not_compared", variant=title, error=str(error)))
                continue
            for c in rows:
                numbers[f"{at}.control.{c.name}"] = with_findings(_theirs(m, c), m.findings)
                beside.append((title, c.name, c.value, c.control, c.function, c.right, c.why))
    if not found:
        return None
    if periodic:
        notes += TEXTS.paragraphs("periodic", wire=wire)
    tables = [
        Table(
            f"Margins at {wire}",
            ("", *(titles[k] for k in found)),
            tuple(
                (text, *(m.numbers()[name] for m in found.values()))
                for name, text in ROWS.items()
                if name != "delay_margin_samples" or any(L.dt for L in loops.values())
            ),
        ),
        Table(
            f"Crossings at {wire}",
            ("variant", "crossing of", "frequency", "margin there"),
            tuple(_crossings(found, titles)),
            details=True,
        ),
        Table(
            f"Closed-loop poles of the loop at {wire}",
            ("variant", "poles, s = log(z)/T where sampled [1/s]", "hidden: not in this loop"),
            tuple(
                (titles[k], _poles(m.closed_loop_poles, loops[k].dt), _poles(m.hidden_poles, loops[k].dt))
                for k, m in found.items()
            ),
            "Multiple poles scatter, as ε^(1/multiplicity).",
            details=True,
        ),
    ]
    if periodic:
        tables.append(_periodic_table(wire, periodic))
    if beside:
        columns = ("variant", "number", "here", "python-control", "its function", "right", "why")
        title = f"Margins at {wire} beside python-control's own values"
        tables.append(Table(title, columns, tuple(beside), details=True))
    plain = {at: loops[at] for at in designs}
    looks = {at: case.looks[at.partition(".")[0]] for at in designs}
    drawn = figures.DrawnLoops(wire, plain, found, titles, looks, case.axes)
    plots = (
        figures.bode(f"inner_{key}_bode", drawn),
        figures.nyquist(f"inner_{key}_nyquist", drawn),
        figures.sensitivities(f"inner_{key}_sensitivities", drawn),
        *gang_of_four(case, key, wire),
    )
    return LoopPart(Section(key, f"Loop at {wire}", tuple(notes), tuple(tables), plots, numbers), own)


def _numbers(m: Margins) -> dict[str, Number]:
    """Return the numbers of a loop by the ends of their paths."""
    found = {name: number for name, number in m.numbers().items() if number.unit != "samples" or number.value >= 0}
    how = "closed-loop eigenvalues"
    found["stable"] = Number(float(m.stable), "1", 0.0, how)
    found["encirclements"] = Number(
        m.encirclements, "1", 0.0, "winding of 1 + L, and eigenvalues of open and closed loop"
    )
    kinds: tuple[tuple[str, tuple[Any, ...], str], ...] = (
        ("gain_crossover", m.gain_crossovers, "phase_margin_deg"),
        ("phase_crossover", m.phase_crossovers, "gain_margin"),
    )
    for kind, crossings, margin in kinds:
        for i, c in enumerate(crossings, 1):
            found[f"{kind}_{i}.frequency"] = c.frequency
            found[f"{kind}_{i}.{margin}"] = getattr(c, margin)
    return found


def _periodic_numbers(p: PeriodicMargins) -> dict[str, Number]:
    """Return the numbers of a periodic loop by the ends of their paths."""
    return {**p.numbers(), "stable": Number(float(p.stable), "1", 0.0, "closed-loop eigenvalues of the lifted system")}


def _periodic_table(wire: str, periodic: Mapping[str, PeriodicMargins]) -> Table:
    """Return the margins of a wire with all loops closed, one factor at all its renewals."""
    names = {**ROWS, "disk_frequency": "disk margin at"}
    rows = [(text, *(p.numbers()[name] for p in periodic.values())) for name, text in names.items() if name in PERIODIC]
    renewals = {title: (p.renewals, p.dt) for title, p in periodic.items()}
    note = TEXTS.line("renewals", renewals=list(dict.fromkeys(renewals.values())))
    return Table(f"Periodic loop at {wire}, all loops closed", ("", *periodic), tuple(rows), note)


def _as_control(r: Realization) -> Any:
    """Return the loop without hidden modes, as python-control is given it."""
    import control

    return control.ss(r.A + np.eye(r.order) * bool(r.dt), r.B, r.C, r.D, r.dt)


def _theirs(m: Margins, c: Comparison) -> Number:
    unit = m.numbers()[c.name].unit if c.name in m.numbers() else "1"
    error = abs(c.value - c.control) if np.isfinite(c.value) and np.isfinite(c.control) else np.nan
    return Number(c.control, unit, error, f"python-control's {c.function}; right: {c.right}; {c.why}")


def _crossings(found: Mapping[str, Margins], titles: Mapping[str, str]) -> Iterable[tuple[Any, ...]]:
    for key, m in found.items():
        for c in m.gain_crossovers:
            yield titles[key], "|L| = 1", c.frequency, c.phase_margin_deg
        for p in m.phase_crossovers:
            yield titles[key], "L < 0", p.frequency, p.gain_margin


def _poles(poles: Iterable[complex], dt: float) -> str:
    return list_poles(in_s(list(poles), dt), dt)
