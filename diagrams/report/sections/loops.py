"""Margins of the loops at the wires of a case: of one channel with the gang of four, and of several channels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from ....blocks.core import BetweenTicksError, LoopwrightError
from ....fmus.fmu_block import DerivativeMethod
from ...flat import WiredDiagram
from ...frequency import (
    Comparison,
    Confirmation,
    DiskMargin,
    Margins,
    Number,
    PeriodicMargins,
    Realization,
    compare_margins,
    delayed_system_class,
    margins,
    mimo_disk_margin,
    periodic_margins,
    with_findings,
)
from ...linearization import MeanSlope, SignalPaths, find_signal, linearize
from ...studies import LoopPlace, cut_places, is_zero
from ...wiring import join
from .. import figures
from ..case import Case
from ..error_sentences import say, say_found
from ..pages import Plot, Section, Table, TableForm, Texts, compare_columns
from ..variant import Cut, Variant, in_s
from ..wires_on_loops import blocks_on_loops, find_same
from .poles import list_poles

TEXTS = Texts(__package__, "loops")
STEEPEST = 4.0 / np.pi
"""Largest gain of a quantizer, by its describing function: at an amplitude of 1/√2 of its step."""
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
PEAKS = ("ms", "mt")
"""The numbers that say how much an error of L is amplified."""
LINEAR = 1e-3
"""A difference between an FMU's step and its equations beyond which it is not the solver's: it moves as it steps."""
POINTS = 400
WHOLE = 1e-6
"""Relative deviation of PS·CS from S·T below which the loop goes through both wires."""


def inner(case: Case) -> Section | None:
    """Return the section about the loops, one part for each wire; None where nothing is to be said of any."""
    text, parts, absent = [*TEXTS.paragraphs("margins")], dict[str, LoopPart](), dict[str, str]()
    wires = case.loop_wires()
    for key, wire in wires.items():
        part = _wire(case, key, wire)
        if part is None:
            reasons = left_out(case, wire)
            text += reasons
            absent |= {key: reasons[0]} if reasons else {}
        else:
            parts[key] = part
    if not parts:
        text = text[len(TEXTS.paragraphs("margins")) :]  # they are about the numbers
        if not text:
            return None
    shown = find_same({key: part.by_path for key, part in parts.items()})
    sections = []
    for key, part in parts.items():
        made = widened(wires[key], part)
        if key in shown:
            made = replace(made, text=(TEXTS.line("same", wire=wires[shown[key]]), *made.text))
        elif part.drawn is not None:
            made = _with_figures(case, key, made, part.drawn)
        sections.append(made)
    return Section("inner", LOOPS_TITLE, tuple(text), sections=tuple(sections), absent=absent)


def _with_figures(case: Case, key: str, section: Section, drawn: figures.DrawnLoops) -> Section:
    """Return the section of a loop with its figures, and the small one of the diagram as it is."""
    plots = (
        figures.bode(f"inner_{key}_bode", drawn),
        figures.nyquist(f"inner_{key}_nyquist", drawn),
        figures.sensitivities(f"inner_{key}_sensitivities", drawn),
        *gang_of_four(case, key, drawn.wire),
    )
    actual = {at: L for at, L in drawn.loops.items() if case.variants[at.partition(".")[0]].is_actual}
    overview = (figures.overview_bode(key, drawn._replace(loops=actual)),) if actual else ()
    return replace(section, plots=plots, overview=overview)


@dataclass(frozen=True)
class VariantLoop:
    """The loop at a wire in a variant: its margins, those over the whole period, and those of python-control."""

    variant: Variant
    cut: Cut
    title: str
    L: Any
    margins: Margins | None  # None where all of the loop goes through slower subsystems, which are open in L
    periodic: PeriodicMargins | None  # of a loop whose slower loops are open in ``margins``
    theirs: tuple[Comparison, ...]
    notes: tuple[str, ...]

    @property
    def key(self) -> str:
        """Its part of dotted paths."""
        return cut_key(self.variant, self.cut)

    @cached_property
    def own(self) -> dict[Cut, dict[str, Number]]:
        """The numbers of its margins by the ends of their paths, in each way in which it is cut."""
        m, p = self.margins, self.periodic
        found = {} if m is None else {self.cut: with_findings(_numbers(m, self.L), m.findings)}
        return found if p is None else {**found, Cut.PERIODIC: with_findings(_periodic_numbers(p), p.findings)}

    @property
    def numbers(self) -> dict[str, Number]:
        """All its numbers by their paths behind the loop's key."""
        found = {
            f"{cut_key(self.variant, cut)}.{name}": number
            for cut, numbers in self.own.items()
            for name, number in numbers.items()
        }
        m = self.margins
        if m is None:
            return found
        return found | {f"{self.key}.control.{c.name}": with_findings(_theirs(m, c), m.findings) for c in self.theirs}


CROSSINGS = TableForm(
    "Crossings at {wire}",
    {"variant": "variant", "crossing of": "kind", "frequency": "frequency", "margin there": "margin"},
    details=True,
)
CLOSED_LOOP_POLES = TableForm(
    "Closed-loop poles of the loop at {wire}",
    {
        "variant": "variant",
        "poles, s = log(z)/T where sampled [1/s]": "poles",
        "hidden: not in this loop": "hidden",
    },
    details=True,
)
COMPARED = TableForm(
    "Margins at {wire} next to python-control's own values",
    {
        "variant": "variant",
        "number": "name",
        "here": "value",
        "python-control": "control",
        "its function": "function",
        "right": "right",
        "why": "why",
    },
    details=True,
)
DISKS = TableForm(
    "MIMO disk margin at {wire}",
    {"variant": "variant", "α": "alpha", "at": "frequency", "gains and phase of all entries at once": "range"},
)


def _wire(case: Case, key: str, wire: str) -> LoopPart | None:
    """Return the section of the loop at a wire; None where no variant has one."""
    loops, notes, absent = list[VariantLoop](), list[str](), dict[str, str]()
    for v in case.usable():
        case.notify(f"margins at {wire}, {v.title}")
        try:
            cut, title, L = v.fullest_loop(wire)
            if L.ninputs > 1:
                return several(case, key, wire)
            loops.append(_analyse(case, wire, v, cut, title, L))
            notes += loops[-1].notes
        except LoopwrightError as error:
            notes.append(_no_margins(wire, v, error))
            absent[v.key] = error.what_was_found
    if not loops:
        return None
    periodic = [of for of in loops if of.periodic is not None]
    has_rate = any(of.margins is not None for of in periodic)
    text = [
        *(_other_cuts(case, case.loop_places[key]) if key in case.loop_places else ()),
        *notes,
        *(TEXTS.paragraphs("periodic", wire=wire, has_rate=has_rate) if periodic else ()),
    ]
    numbers = {path: number for of in loops for path, number in of.numbers.items()}
    section = Section(key, f"Loop at {wire}", tuple(text), tuple(_tables(wire, loops)), (), numbers, absent=absent)
    own = {(of.variant, cut): found for of in loops for cut, found in of.own.items()}
    with_margins = {of.key: of.margins for of in loops if of.margins is not None}
    if not with_margins:
        return LoopPart(section, own)
    shown = {of.key: of for of in loops if of.key in with_margins and (of.variant.is_design or of.variant.is_actual)}
    drawn = figures.DrawnLoops(
        wire,
        {at: of.L for at, of in shown.items()},
        with_margins,
        {of.key: of.title for of in loops},
        {at: case.looks[of.variant.key] for at, of in shown.items()},
        case.axes,
    )
    return LoopPart(section, own, drawn)


def _analyse(case: Case, wire: str, v: Variant, cut: Cut, title: str, L: Any) -> VariantLoop:
    """Return the loop at a wire in a variant with its margins, and what there is to say of them."""
    if v.goes_by_slower(wire):
        p = periodic_margins(v.loop(wire, cut=Cut.PERIODIC))
        said = (TEXTS.line("slower_alone", variant=v.title, wire=wire), *_unstable(v.title, p))
        return VariantLoop(v, cut, title, L, None, p, (), said)
    m = margins(L)
    periodic, theirs, notes = None, tuple[Comparison, ...](), list[str]()
    low, high = m.gain_margin_low.value, m.gain_margin_high.value
    # stairs act with up to 4/π times their mean slope, and with none: a margin within that may be a limit cycle
    if (high < STEEPEST or low > 0.0) and any(isinstance(f, MeanSlope) for f in m.findings):
        notes.append(TEXTS.line("limit_cycle", variant=title, high=high if high < STEEPEST else 0.0, low=low))
    if m.hidden_unstable:
        notes.append(TEXTS.line("hidden_unstable", variant=title, poles=_poles(m.hidden_unstable, L.dt)))
    # loops of slower subsystems are open in the margins above, and closed in those over the whole period
    if cut is Cut.SLOW_OPEN:
        try:
            periodic = periodic_margins(v.loop(wire, cut=Cut.PERIODIC))
        except LoopwrightError as error:
            notes.append(f"{v.title}: {say(error)}")
        else:
            notes += _unstable(v.title, periodic)
    notes += _unstable(title, m)
    # python-control is asked about the design alone: a stable, rational loop, as its functions know no other
    if m.stable and v.is_design and isinstance(L, delayed_system_class()):
        notes.append(TEXTS.line("no_rational_model", variant=title))
    elif m.stable and v.is_design:
        case.notify(f"confirming the margins at {wire}, {v.title}")
        try:
            with np.errstate(all="ignore"):
                r = Realization.of(L)
                theirs = compare_margins(r, m, _as_control(r))
        except (LoopwrightError, np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
            notes.append(TEXTS.line("not_compared", variant=title, error=str(error)))
    return VariantLoop(v, cut, title, L, m, periodic, theirs, tuple(notes))


def _unstable(title: str, m: Margins | PeriodicMargins) -> list[str]:
    """Return that a closed loop is unstable, with its poles; nothing of a stable one."""
    return [] if m.stable else [TEXTS.line("unstable", variant=title, poles=_poles(m.unstable_poles, m.dt))]


def _tables(wire: str, loops: Sequence[VariantLoop]) -> Iterator[Table]:
    """Yield the tables of the loop at a wire: its margins, and the details of the appendix."""
    found = [(of.title, of.margins, of.L.dt) for of in loops if of.margins is not None]
    if found:
        sampled = any(dt for _, _, dt in found)
        names = {name: words for name, words in ROWS.items() if sampled or name != "delay_margin_samples"}
        yield compare_columns(f"Margins at {wire}", names, [(title, m.numbers()) for title, m, _ in found])
        yield CROSSINGS.fill((row for title, m, _ in found for row in _crossings(title, m)), wire=wire)
        poles = (
            {"variant": title, "poles": _poles(m.closed_loop_poles, dt), "hidden": _poles(m.hidden_poles, dt)}
            for title, m, dt in found
        )
        yield CLOSED_LOOP_POLES.fill(poles, "Multiple poles scatter, as ε^(1/multiplicity).", wire=wire)
    periodic = [(of.variant.title, of.periodic) for of in loops if of.periodic is not None]
    if periodic:
        every = {**ROWS, "disk_frequency": "disk margin at"}
        names = {name: words for name, words in every.items() if name in PERIODIC}
        note = TEXTS.line("renewals", renewals=list(dict.fromkeys((p.renewals, p.dt) for _, p in periodic)))
        columns = [(title, p.numbers()) for title, p in periodic]
        yield compare_columns(f"Periodic loop at {wire}, all loops closed", names, columns, note)
    compared = [{"variant": of.title, **vars(c)} for of in loops for c in of.theirs]
    differing = [row for row in compared if row["right"] != "both"]
    if differing:
        yield COMPARED.fill(differing, TEXTS.line("agreeing", count=len(compared) - len(differing)), wire=wire)


def _other_cuts(case: Case, place: LoopPlace) -> list[str]:
    """Return what a loop is where its wire has several ways back, with the numbers of its other cuts."""
    v = case.actual
    if v is None or v.problem:
        return []
    inputs, notes = ", ".join(join(*to) for to in place.to), list[str]()
    if place.to:
        others = ", ".join(join(*to) for to in place.own)
        whole = _margins_of(v, place.wire)
        notes.append(TEXTS.line("at_inputs", wire=place.wire, inputs=inputs, own=others, whole=whole))
    if place.others:
        cuts = [(" and ".join(to), _margins_of(v, wire, to)) for wire, to in place.others]
        notes.append(TEXTS.line("parallel", wire=place.wire, at=inputs, inputs=cuts))
    return notes


def _margins_of(v: Variant, wire: str, inputs: Iterable[str] = ()) -> str:
    """Return the phase margin and M_s of a loop in words."""
    try:
        m = margins(v.loop_ahead(wire, inputs))
    except LoopwrightError:
        return TEXTS.line("no_numbers")
    if not m.stable:
        return TEXTS.line("no_numbers")
    return TEXTS.line("numbers", phase=m.phase_margin_deg.value, ms=m.ms.value)


def _numbers(m: Margins, L: Any) -> dict[str, Number]:
    """Return the numbers of a loop by the ends of their paths."""
    found = {name: number for name, number in m.numbers().items() if number.unit != "samples" or number.value >= 0}
    delayed = isinstance(L, delayed_system_class())
    how = "argument of the closed loop's characteristic function" if delayed else "closed-loop eigenvalues"
    found["stable"] = Number(float(m.stable), "1", 0.0, how)
    of = "characteristic functions" if delayed else "eigenvalues"
    said = f"winding of 1 + L, and {of} of open and closed loop"
    found["encirclements"] = Number(m.encirclements, "1", 0.0, said)
    for i, g in enumerate(m.gain_crossovers, 1):
        found[f"gain_crossover_{i}.frequency"] = g.frequency
        found[f"gain_crossover_{i}.phase_margin_deg"] = g.phase_margin_deg
    for i, p in enumerate(m.phase_crossovers, 1):
        found[f"phase_crossover_{i}.frequency"] = p.frequency
        found[f"phase_crossover_{i}.gain_margin"] = p.gain_margin
    return found


def _periodic_numbers(p: PeriodicMargins) -> dict[str, Number]:
    """Return the numbers of a periodic loop by the ends of their paths."""
    return {**p.numbers(), "stable": Number(float(p.stable), "1", 0.0, "closed-loop eigenvalues of the lifted system")}


def _as_control(r: Realization) -> Any:
    """Return the loop without hidden modes, as python-control is given it."""
    import control

    return control.ss(r.A + np.eye(r.order) * bool(r.dt), r.B, r.C, r.D, r.dt)


def _theirs(m: Margins, c: Comparison) -> Number:
    unit = m.numbers()[c.name].unit if c.name in m.numbers() else "1"
    error = abs(c.value - c.control) if np.isfinite(c.value) and np.isfinite(c.control) else np.nan
    return Number(c.control, unit, error, f"python-control's {c.function}; right: {c.right}; {c.why}")


def _crossings(title: str, m: Margins) -> Iterator[dict[str, Any]]:
    """Yield the facts of `CROSSINGS` of a loop."""
    for c in m.gain_crossovers:
        yield {"variant": title, "kind": "|L| = 1", "frequency": c.frequency, "margin": c.phase_margin_deg}
    for p in m.phase_crossovers:
        yield {"variant": title, "kind": "L < 0", "frequency": p.frequency, "margin": p.gain_margin}


def _poles(poles: Iterable[complex], dt: float) -> str:
    return list_poles(in_s(list(poles), dt), dt)


# --- tolerances, and reasons for no margins ---------------------------------------------------------------------------


def left_out(case: Case, wire: str) -> list[str]:
    """Return why there are no margins at a wire."""
    said: dict[str, None] = {}
    for v in case.usable():
        try:
            L = v.loop(wire)
            if is_zero(L):
                said |= dict.fromkeys([_zero(v, wire)])
            else:
                margins(L)
        except LoopwrightError as error:
            said |= dict.fromkeys([_no_margins(wire, v, error)])
    return list(said)


def _no_margins(wire: str, v: Variant, error: LoopwrightError) -> str:
    """Return why a wire has no margins in a variant, for readers of a report; a hint for its author comes last."""
    why = say_found(error)
    if isinstance(error, BetweenTicksError):
        return TEXTS.line("between_ticks", wire=wire, variant=v.title, why=why)
    return TEXTS.line("not_shown", wire=wire, variant=v.title, why=why, step=error.next_step)


def _zero(v: Variant, wire: str) -> str:
    flat = v.diagram.flatten_like(v.point)
    if not SignalPaths(flat).is_on_loop(find_signal(flat, wire).port):
        return TEXTS.line("off_loops", wire=wire)
    found = [finding for finding in v.model.findings if finding.remedy]
    remedies = dict.fromkeys(finding.remedy for finding in found)
    return TEXTS.line("slope_is_zero", wire=wire, flat=[*map(str, found)], remedies=[*remedies])


@dataclass(frozen=True)
class LoopPart:
    """The section of a loop.

    ``numbers``: those of its numbers that come from each variant's loop, by path behind the key of `cut_key`.
    ``drawn``: what its figures draw; None for several channels.
    """

    section: Section
    numbers: Mapping[tuple[Variant, Cut], Mapping[str, Number]]
    drawn: figures.DrawnLoops | None = None

    @property
    def by_path(self) -> dict[str, Number]:
        """The numbers of all variants' loops by their paths behind the loop's key."""
        return {f"{cut_key(*at)}.{name}": number for at, own in self.numbers.items() for name, number in own.items()}


def cut_key(v: Variant, cut: Cut) -> str:
    """Return the part of dotted paths of a variant's loop, such as ``sampled_d0`` or ``sampled_d0.periodic``."""
    return f"{v.key}.{cut}" if cut else v.key


def widened(wire: str, part: LoopPart) -> Section:
    """Return the section of a loop with tolerances that know how far the linear models of its FMUs are right.

    The error of a response is found at the frequencies of the section: by moving the model's entries by the
    differences' own uncertainty, and by the equations held over a step in place of the step that the FMU's solver
    makes, where it names them.
    """
    changed: dict[int, Number] = {}
    numbers, text = dict(part.section.numbers), list(part.section.text)
    for (v, cut), own in part.numbers.items():
        exact = all(derivation.is_exact for derivation in v.model.derivations.values())
        if exact and not v.model.uncertainty:
            continue
        w = [n.value for n in own.values() if n.unit == "rad/s" and 0 < n.value < math.inf]
        if not w:
            continue
        error, said = _relative_error(v, wire, cut, np.unique(w))
        text += [f"{v.title}: {said}"] if said else []
        peaks = [own[name].value for name in PEAKS if name in own and math.isfinite(own[name].value)]
        slopes = 1.0 + 2.0 * max([1.0, *peaks])
        for name, n in own.items():
            more = _floor(n, error * slopes)
            if more > n.tolerance:
                why = Confirmation(n.confirmed_by).and_by(
                    f"tolerance: its FMUs' linear models are right to {error:.1e} of L",
                    "tolerance: from the error of its FMUs' linear models",
                )
                new = replace(n, tolerance=more, confirmed_by=why)
                changed[id(n)] = numbers[f"{cut_key(v, cut)}.{name}"] = new
    tables = tuple(_renewed(table, changed) for table in part.section.tables)
    return replace(part.section, numbers=numbers, tables=tables, text=tuple(text))


def _floor(n: Number, error: float) -> float:
    """Return the error of a number that a relative error of L makes."""
    if not math.isfinite(n.value) or n.value == 0.0:
        return 0.0
    if n.unit == "deg":
        return math.degrees(error)
    whole = n.unit == "1" and n.tolerance == 0.0  # counted
    return 0.0 if whole else error * abs(n.value)


def _relative_error(v: Variant, wire: str, cut: Cut, w: np.ndarray) -> tuple[float, str]:
    """Return the largest relative error of L at frequencies, and the notes on it."""
    L = v.loop(wire, cut=cut)
    points = np.exp(1j * w * L.dt) if L.dt else 1j * w
    nominal = [_model_response(L, p) for p in points]
    sizes = [np.linalg.norm(n) or 1.0 for n in nominal]

    def off(other: Any) -> float:
        moved = [_model_response(other, p) for p in points]
        return float(np.nanmax([np.linalg.norm(m - n) / s for m, n, s in zip(moved, nominal, sizes, strict=True)]))

    rng = np.random.default_rng(0)
    delayed = isinstance(L, delayed_system_class())
    largest = max([1e-300, *(float(np.max(np.abs(M), initial=0.0)) for M in _matrices(L))])
    relative = 0.0 if math.isnan(v.model.uncertainty) else v.model.uncertainty / largest  # tolerances are NaN already
    error = 0.0
    for _ in range(4):
        moved = [M * (1 + relative * rng.choice([-1, 1], M.shape)) for M in _matrices(L)]
        error = max(error, off(L.with_rest(*moved) if delayed else _Moved(*moved)))
    if not any(d.method is DerivativeMethod.STEP_DIFFERENCES for d in v.model.derivations.values()):
        return error, ""
    try:
        held = cut.loop(linearize(v.diagram, v.point, plants="equations", stairs=v.stairs), wire)
    except LoopwrightError:
        return error, TEXTS.line("no_equations")
    solver = off(held)
    if solver > LINEAR:
        return error, TEXTS.line("coarse_step", difference=solver)
    return error + solver, ""


class _Moved:
    """A state-space model, no more than its matrices."""

    def __init__(self, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray):
        self.A, self.B, self.C, self.D = A, B, C, D


def _matrices(L: Any) -> tuple[np.ndarray, ...]:
    of = L.rest if isinstance(L, delayed_system_class()) else L
    return tuple(np.asarray(M, dtype=float) for M in (of.A, of.B, of.C, of.D))


def _model_response(L: Any, p: complex) -> np.ndarray:
    if isinstance(L, delayed_system_class()):
        return np.asarray(L(p, squeeze=False)).reshape(L.noutputs, L.ninputs)
    try:
        return np.asarray(L.C @ np.linalg.solve(p * np.eye(len(L.A)) - L.A, L.B.astype(complex)) + L.D)
    except np.linalg.LinAlgError:  # on a pole
        return np.full(np.shape(L.D), np.nan + 0j)


def _renewed(table: Table, changed: dict[int, Number]) -> Table:
    return replace(table, rows=tuple(tuple(changed.get(id(cell), cell) for cell in row) for row in table.rows))


# --- several channels -------------------------------------------------------------------------------------------------


def several(case: Case, key: str, wire: str) -> LoopPart | None:
    """Return the section about a wire with several entries: its MIMO disk margin; None where it has none."""
    own: dict[tuple[Variant, Cut], Mapping[str, Number]] = {}
    rows, notes = [], []
    for v in case.usable():
        try:
            cut, title, L = v.fullest_loop(wire)
            disk = mimo_disk_margin(L)
        except LoopwrightError as error:
            notes.append(f"{v.title}: {say(error)}")
            continue
        own[v, cut] = disk_numbers(disk)
        facts = {"alpha": disk.alpha, "frequency": disk.frequency, "range": disk_range(disk)}
        rows.append({"variant": title, **facts})
    if not rows:
        return None
    part = LoopPart(Section(key, f"Loops at {wire}", tuple(notes), (DISKS.fill(rows, wire=wire),)), own)
    return replace(part, section=replace(part.section, numbers=part.by_path))


DISK_NUMBERS = ("disk_margin", "frequency", "gain_low", "gain_high", "phase_deg")
"""Numbers of a disk margin, by the ends of their paths."""


def disk_numbers(disk: DiskMargin) -> dict[str, Number]:
    """Return the numbers of a disk margin by the ends of their paths."""
    how = disk.alpha.confirmed_by
    found = {
        "disk_margin": disk.alpha,
        "frequency": disk.frequency,
        "gain_low": Number(disk.gain_low, "1", disk.alpha.tolerance, how),
        "gain_high": Number(disk.gain_high, "1", disk.alpha.tolerance * disk.gain_high**2, how),
        "phase_deg": Number(disk.phase_deg, "deg", 60 * disk.alpha.tolerance, how),
    }
    return with_findings(found, disk.findings)


def disk_range(disk: DiskMargin) -> str:
    """Return the gains and the phase that a disk allows, as text."""
    return f"{disk.gain_low:.4g} … {disk.gain_high:.4g}, ± {disk.phase_deg:.4g}°"


# --- the gang of four -------------------------------------------------------------------------------------------------


def gang_of_four(case: Case, key: str, wire: str) -> tuple[Plot, ...]:
    """Return the figure of the responses PS and CS, which S and T leave open; none where no other wire cuts the loop.

    P leads from the wire to the nearest named one downstream that the whole loop goes through, C back from there.
    """
    for other in wires_downstream(cut_places(case.diagram, tuple(case.loop_places.values())), wire):
        curves = {}
        for v in case.usable():
            if v.is_design or v.is_actual:
                try:
                    found = _gang_responses(v, wire, other)
                except LoopwrightError:
                    continue
                if found is None:
                    break  # the wires are those of all variants
                curves[v.key] = (v.title, *found)
        if curves:
            return (figures.gang(f"inner_{key}_gang", curves, wire, other, case.axes, case.looks),)
    return ()


def wires_downstream(diagram: WiredDiagram, wire: str) -> Iterator[str]:
    """Yield the named scalar wires downstream of a wire on its loops, the nearest first."""
    names, table = diagram.names, diagram.structure
    if wire not in names:
        return
    inside = blocks_on_loops(diagram)
    sources = {(w.block, w.port, str(w.index)): name for name, w in names.items() if name != wire}
    start = names[wire]
    known: Mapping[tuple[str, str], Any] = diagram.checked.shapes
    waiting, seen = deque([(start.block, start.port)]), {start.block}
    while waiting:
        at, port = waiting.popleft()
        for (block, _), w in table.wires.items():
            if w.block != at or block in seen or block not in inside or (at == start.block and w.port != port):
                continue
            seen.add(block)
            yield from sorted(
                name for (b, p, i), name in sources.items() if b == block and i == "None" and known[b, p] == ()
            )
            waiting.append((block, ""))


def _gang_responses(v: Variant, wire: str, other: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return frequencies in rad/s, and the responses from a disturbance at the wire to the other, and back.

    None where the loop does not go through the other wire alone: PS·CS is not S·T then.
    """
    model = linearize(v.diagram, v.point, inputs=[wire, other], outputs=[wire, other], stairs=v.stairs)
    s = np.abs(in_s(model.poles, model.dt))
    s = s[s > 1e-6 * max(1e-300, float(np.max(s, initial=0.0)))]
    top = 0.999 * np.pi / model.dt if model.dt else 30 * float(np.max(s, initial=1.0))
    low = min(float(np.min(s, initial=1.0)) / 10, top / 100)
    w = np.geomspace(max(low, top / 1e6), top, POINTS)
    points = np.exp(1j * w * model.dt) if model.dt else 1j * w
    G = np.moveaxis(np.asarray(model.system(points, squeeze=False)), 2, 0)
    L = figures.response(v.loop(wire), w)
    both, expected = np.abs(G[:, 1, 0] * G[:, 0, 1]), np.abs(L / (1 + L) ** 2)
    if np.max(np.abs(both - expected)) > WHOLE * np.max(expected):
        return None
    return w, np.abs(G[:, 1, 0]), np.abs(G[:, 0, 1])
