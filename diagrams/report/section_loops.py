"""Margins of the inner loops: of Fig. 3 at its virtual inputs, of another diagram at every named wire on a loop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ...blocks.core.errors import LoopwrightError
from ..frequency.disk import mimo_disk_margin
from ..frequency.margins import Margins, margins
from ..frequency.number import Number
from ..frequency.python_control import Comparison, compare_margins
from ..frequency.realization import Realization
from . import plots as figures
from .case import FRICTION, SIDES, Case, in_s
from .model import Section, Table
from .templating import Texts
from .uncertainty import left_out, widened

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


def wires_on_loops(case: Case) -> dict[str, str]:
    """Return the wires at which loops are looked at, by their key in a report."""
    if case.is_fig3:
        return {side: f"controller.{name}" for side, name in SIDES.items()}
    if case.wires is not None:
        return {_key(name): name for name in case.wires}
    diagram = case.diagram
    inside = _on_cycles(diagram)
    seen: set[tuple[str, str, Any]] = set()
    names: dict[str, str] = {}
    for name, wire in sorted(diagram.names.items(), key=lambda item: (item[0].count("."), item[0])):
        where = (wire.block, wire.port, str(wire.index))
        if wire.block in inside and where not in seen:
            seen.add(where)
            names[name] = name
    if not names:  # nothing on a loop has a name: what drives the FMUs, else all outputs on loops
        table = diagram.structure
        sources = {f"{w.block}.{w.port}" for w in table.wires.values() if w.block in inside}
        driving = {
            f"{w.block}.{w.port}"
            for (block, _), w in table.wires.items()
            if w.block in inside and table.blocks[block].stepped
        }
        names = {path: path for path in sorted(driving or sources)[:4]}
    ends = [name.rpartition(".")[2] for name in names]
    return {(e if ends.count(e) == 1 else _key(n)): n for e, n in zip(ends, names, strict=True)}


def _key(name: str) -> str:
    return name.replace(".", "_")


def inner(case: Case) -> Section:
    """Return the section about the loops, one part for each wire."""
    text, parts = [*TEXTS.paragraphs("margins")], []
    for key, wire in wires_on_loops(case).items():
        part = _wire(case, key, wire)
        if part is None:
            text += left_out(case, wire, _on_cycles(case.diagram))
        else:
            parts.append(widened(case, wire, part))
    if case.is_fig3:
        parts += _motor_forces(case)
    if not parts and len(text) == 1:
        text.append(TEXTS.line("no_loop"))
    return Section("inner", "Inner loops", tuple(text), sections=tuple(parts))


def _wire(case: Case, key: str, wire: str) -> Section | None:
    found: dict[str, Margins] = {}
    loops: dict[str, Any] = {}
    notes: list[str] = []
    numbers: dict[str, Number] = {}
    beside: list[tuple[Any, ...]] = []
    for v in case.usable():
        try:
            L = v.loop(wire)
            if L.ninputs > 1:
                return _several(case, key, wire)
            m = margins(L)
        except LoopwrightError as error:
            notes.append(f"{v.title}: {error.message}")
            continue
        found[v.key], loops[v.key] = m, L
        numbers |= {f"{v.key}.{name}": number for name, number in _numbers(m).items()}
        if m.hidden_unstable:
            shown = _poles(m.hidden_unstable, L.dt)
            notes.append(TEXTS.line("hidden_unstable", variant=v.title, poles=shown))
        if not m.stable:
            notes.append(TEXTS.line("unstable", variant=v.title))
        elif not v.key.endswith(FRICTION):
            try:
                with np.errstate(all="ignore"):
                    r = Realization.of(L)
                    rows = compare_margins(r, m, _as_control(r))
            except (LoopwrightError, np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
                notes.append(TEXTS.line("not_compared", variant=v.title, error=error))
                continue
            for c in rows:
                numbers[f"{v.key}.control.{c.name}"] = _theirs(m, c)
                beside.append((v.title, c.name, c.value, c.control, c.function, c.right, c.why))
    if not found:
        return None
    titles = {v.key: v.title for v in case.usable()}
    tables = [
        Table(
            f"Margins at {wire}",
            ("", *(titles[k] for k in found)),
            tuple((text, *(m.numbers()[name] for m in found.values())) for name, text in ROWS.items()),
        ),
        Table("Crossings", ("variant", "crossing of", "frequency", "margin there"), tuple(_crossings(found, titles))),
        Table(
            "Closed-loop poles",
            ("variant", "poles, s = log(z)/T where sampled [1/s]", "hidden: not in this loop"),
            tuple(
                (titles[k], _poles(m.closed_loop_poles, loops[k].dt), _poles(m.hidden_poles, loops[k].dt))
                for k, m in found.items()
            ),
            "Multiple poles scatter, as ε^(1/multiplicity).",
        ),
    ]
    if beside:
        columns = ("variant", "number", "here", "python-control", "its function", "right", "why")
        tables.append(Table("Beside python-control's own values", columns, tuple(beside)))
    plain = {k: v for k, v in loops.items() if not k.endswith(FRICTION)}
    plots = (
        figures.bode(f"inner_{key}_bode", wire, plain, found, titles),
        figures.nyquist(f"inner_{key}_nyquist", wire, plain, found, titles),
        figures.sensitivities(f"inner_{key}_sensitivities", wire, plain, found, titles),
    )
    return Section(key, f"Loop at {wire}", tuple(notes), tuple(tables), plots, numbers)


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
    values = in_s(list(poles), dt)
    values = values[np.lexsort((-values.imag, np.abs(values)))]
    shown, skip = [], False
    for v in values:
        if skip:
            skip = False
            continue
        if abs(v.imag) <= 1e-9 * max(abs(v), 1e-300) or not np.isfinite(v):
            shown.append(f"{v.real:.6g}")
        elif dt and abs(abs(v.imag) - np.pi / dt) < 1e-6 / dt:
            shown.append(f"{v.real:.6g} ± jπ/T")
        else:
            shown.append(f"{v.real:.6g} ± {abs(v.imag):.6g}j")
            skip = True
    return ", ".join(shown) or "none"


def _several(case: Case, key: str, wire: str) -> Section | None:
    """Return what is said of a wire with several entries: its MIMO disk margin."""
    numbers: dict[str, Number] = {}
    rows, notes = [], []
    for v in case.usable():
        try:
            disk = mimo_disk_margin(v.loop(wire))
        except LoopwrightError as error:
            notes.append(f"{v.title}: {error.message}")
            continue
        numbers |= _disk(v.key, disk)
        rows.append((v.title, disk.alpha, disk.frequency, _range(disk)))
    if not rows:
        return None
    table = Table(
        f"MIMO disk margin at {wire}", ("variant", "α", "at", "gains and phase of all entries at once"), tuple(rows)
    )
    return Section(key, f"Loops at {wire}", tuple(notes), (table,), (), numbers)


def _disk(start: str, disk: Any) -> dict[str, Number]:
    how = disk.alpha.confirmed_by
    return {
        f"{start}.disk_margin": disk.alpha,
        f"{start}.frequency": disk.frequency,
        f"{start}.gain_low": Number(disk.gain_low, "1", disk.alpha.tolerance, how),
        f"{start}.gain_high": Number(disk.gain_high, "1", disk.alpha.tolerance * disk.gain_high**2, how),
        f"{start}.phase_deg": Number(disk.phase_deg, "deg", 60 * disk.alpha.tolerance, how),
    }


def _range(disk: Any) -> str:
    return f"{disk.gain_low:.4g} … {disk.gain_high:.4g}, ± {disk.phase_deg:.4g}°"


def _motor_forces(case: Case) -> list[Section]:
    """Return the 2×2 loop at the motor forces, at several path points, with and without offset."""
    numbers: dict[str, Number] = {}
    rows, notes = [], []
    for v in case.usable():
        if v.key.endswith(FRICTION) and v.key != "sampled_d0" + FRICTION:
            continue
        for place, eta, xi in places(case):
            at = case.at(v, eta, xi)
            if at is None:
                continue
            try:
                disk = mimo_disk_margin(at.loop("motor_force"))
            except LoopwrightError as error:
                notes.append(f"{v.title} at {place}: {error.message}")
                continue
            numbers |= _disk(f"{v.key}.{place}", disk)
            rows.append((v.title, f"{eta:.3f} m", f"{xi:.3f} m", disk.alpha, disk.frequency, _range(disk)))
    if not rows:
        return []
    text = (
        (
            "Both motor forces are cut at once. The MIMO disk margin is α of the largest symmetric disk of factors, a "
            "different complex one in each motor force, that the closed loop bears; for two channels the "
            "D-scaled bound is "
            "exact. It is not that of one loop after the other."
        ),
        *notes,
    )
    table = Table(
        "MIMO disk margin at the motor forces", ("variant", "η", "ξ", "α", "at", "gains and phase"), tuple(rows)
    )
    return [Section("motor_force", "Loops at the motor forces", text, (table,), (), numbers)]


def places(case: Case) -> list[tuple[str, float, float]]:
    """Return points beside the path, with the names they have in dotted paths."""
    length = case.path.length
    made = []
    for share, xi in ((0.0, 0.0), (0.0, -0.02), (0.15, 0.0), (0.15, 0.02), (0.35, -0.02), (0.35, 0.0)):
        eta = round(share * length, 3)
        made.append((f"eta_{1000 * eta:.0f}mm_xi_{1000 * xi:.0f}mm", eta, xi))
    return made


def _on_cycles(diagram: Any) -> set[str]:
    """Return the blocks that lie on a cycle of wires."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    table = diagram.structure
    index = {path: i for i, path in enumerate(sorted(table.blocks))}
    edges = [(index[w.block], index[block]) for (block, _), w in table.wires.items()]
    if not edges:
        return set()
    rows, columns = zip(*edges, strict=True)
    graph = csr_matrix((np.ones(len(edges)), (rows, columns)), shape=(len(index), len(index)))
    _, labels = connected_components(graph, directed=True, connection="strong")
    own = {a for a, b in edges if a == b}
    return {path for path, i in index.items() if np.sum(labels == labels[i]) > 1 or i in own}
