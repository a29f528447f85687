"""A drawing that answers: subsystems open and close, blocks and wires say what they are, names are searched for.

It is plain SVG with a few lines of script, without a network. Where no script runs, it is the drawing as it is.
"""

from __future__ import annotations

import hashlib
import inspect
import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import PortUnit, shorten
from ..wiring import Structure
from .diagram_picture import DiagramPicture

MOST_SUBSYSTEMS = 4
"""Number of subsystems up to which every combination of open ones is drawn ahead."""

MOST_VIEWS = 24
BINS = 120
"""Number of bins of a signal's curve; in each of them its smallest and its largest value are kept."""

CURVES = 6
"""Number of entries of a vector up to which each has its curve."""

LONGEST = 200


@dataclass(frozen=True)
class RecordedSignal:
    """A signal of a run: times in s, and values, one row for each time."""

    t: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Facts:
    """What is known of a diagram beyond its wires.

    Attributes
    ----------
    shapes, units : mapping
        Shape and unit of each output, by block path and port.
    recorded : mapping
        Signals of a run, by block path and port.
    """

    shapes: Mapping[tuple[str, str], tuple[int, ...]]
    units: Mapping[tuple[str, str], PortUnit]
    recorded: Mapping[tuple[str, str], RecordedSignal]


def live_html(table: Structure, name: str, facts: Facts, *, subsystem: str, closed: set[str], width: float) -> str:
    """Return a part of a page that shows the drawing, with its script and all that it says.

    Parameters
    ----------
    table, name
        The diagram's blocks and wires, and its name.
    facts : Facts
        Shapes, units and signals.
    subsystem : str
        Path of the subsystem whose inside is drawn; empty for the whole diagram.
    closed : set of str
        Paths of the subsystems that are closed at first.
    width : float
        Width in pixels above which chains are broken into rows.
    """
    inside = [p for p in table.subsystems if p and p != subsystem and (not subsystem or p.startswith(subsystem + "."))]
    first = _reachable(set(inside) - closed, inside)
    title = subsystem or name

    def view(open_ones: set[str]) -> str:
        return DiagramPicture(table, set(inside) - open_ones, width).page(subsystem, title).svg

    shown = view(first)
    sets = list(_views(inside, first)) if inside else []
    views = [{"open": sorted(each), "svg": shown if each == first else view(each)} for each in sets]
    content = {
        "open": sorted(first),
        "subsystems": inside,
        "views": views,
        "blocks": dict(_blocks(table, subsystem)),
        "signals": dict(_signals(table, facts, subsystem)),
    }
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    key = hashlib.sha256(text.encode()).hexdigest()[:12]
    buttons = '<button data-all="open">open all</button><button data-all="close">close all</button>' if inside else ""
    hint = (
        "Click a subsystem to open or close it, a block or a wire to read what it is."
        if inside
        else ("Click a block or a wire to read what it is.")
    )
    return (
        f'<div class="lw-live" id="lw-{key}"><style>{_file("live.css")}</style>\n'
        f'<div class="lw-bar" hidden>{buttons}<input type="search" placeholder="find a block or a signal" '
        f'aria-label="find a block or a signal in {escape(title, quote=True)}">'
        f'<span class="lw-hint">{hint}</span></div>\n'
        f'<div class="lw-view">{shown}</div>\n<div class="lw-panel" aria-live="polite" hidden></div>\n'
        f'<script type="application/json">{text}</script>\n<script>{{{_file("live.js")}}}</script></div>\n'
    )


def _file(name: str) -> str:
    return files(__package__).joinpath("live_page", name).read_text(encoding="utf-8")


# --- views ----------------------------------------------------------------------------------------------------------


def _parent(path: str) -> str:
    return path.rpartition(".")[0]


def _reachable(wanted: set[str], inside: list[str]) -> set[str]:
    """Return those of some open subsystems that are seen: all around them are open, too."""
    seen: set[str] = set()
    for path in sorted(wanted, key=lambda p: p.count(".")):
        around = _parent(path)
        if around not in inside or around in seen:
            seen.add(path)
    return seen


def _views(inside: list[str], first: set[str]) -> Iterator[set[str]]:
    """Yield sets of open subsystems, each once: the one shown at first ahead."""
    if len(inside) <= MOST_SUBSYSTEMS:
        wanted = [set(c) for n in range(len(inside) + 1) for c in itertools.combinations(inside, n)]
    else:
        chains = [{p for p in inside if path == p or path.startswith(p + ".")} for path in inside]
        wanted = [set(), set(inside), *chains][:MOST_VIEWS]
    done: list[set[str]] = []
    for each in [first, *(_reachable(w, inside) for w in wanted)]:
        if each not in done:
            done.append(each)
            yield each


# --- what is said ---------------------------------------------------------------------------------------------------


def _is_within(path: str, subsystem: str) -> bool:
    return not subsystem or path.startswith(subsystem + ".")


def _short(value: Any) -> str:
    """Write a value; of a file its name alone, as the page may go to others."""
    text = value.name if isinstance(value, Path) else shorten(value)
    return text if len(text) <= LONGEST else text[:LONGEST] + "…"


def _blocks(table: Structure, subsystem: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, block in table.blocks.items():
        if not _is_within(path, subsystem):
            continue
        facts = []
        for name, value in block.parameters.items():
            if value is None:
                continue
            spec = type(block).parameter_specs[name]
            unit = getattr(spec, "unit", None)
            shown = isinstance(unit, str) and unit != "1"
            facts.append([name, f"{_short(value)} {unit}" if shown else _short(value)])
        rate = table.rate(table.subsystem_of[path])
        if rate is not None:
            facts.append(["sample time", f"{float(rate):.9g} s"])
        facts += [[f"input {port}", join_wire(wire)] for (owner, port), wire in table.wires.items() if owner == path]
        about = inspect.getdoc(type(block)) or ""
        yield (
            path,
            {"title": f"{path} · {block.drawn_as}", "about": " ".join(about.split("\n\n")[0].split()), "facts": facts},
        )


def join_wire(wire: Any) -> str:
    """Return where a wire comes from, as people read it."""
    return f"{wire.block}.{wire.port}{wire.part if wire.index is not None else ''}"


def _signals(table: Structure, facts: Facts, subsystem: str) -> Iterator[tuple[str, dict[str, Any]]]:
    names: dict[tuple[str, str], list[str]] = {}
    for name, wire in table.names.items():
        names.setdefault((wire.block, wire.port), []).append(name)
    readers: dict[tuple[str, str], list[str]] = {}
    for (owner, port), wire in table.wires.items():
        readers.setdefault((wire.block, wire.port), []).append(f"{owner}.{port}")
    for path, wire in table.controls.items():
        readers.setdefault((wire.block, wire.port), []).append(path)
    for key in dict.fromkeys([*readers, *names]):
        path = ".".join(key)
        near = [path, *readers.get(key, [])]
        if not any(_is_within(each, subsystem) for each in near):
            continue
        unit, shape = facts.units.get(key), facts.shapes.get(key)
        said: list[list[str]] = [["output", path]]
        if unit is not None:
            said.append(["unit", unit if isinstance(unit, str) else ", ".join(map(str, unit))])
        if shape:
            said.append(["entries", " × ".join(map(str, shape))])
        said.append(["goes to", ", ".join(readers.get(key, [])) or "nothing"])
        entry: dict[str, Any] = {
            "title": ", ".join(names.get(key, [])) or path,
            "names": names.get(key, []),
            "facts": said,
        }
        recorded = facts.recorded.get(key)
        if recorded is not None and len(recorded.t):
            said += _values(recorded, unit if isinstance(unit, str) else "")
            entry["curves"] = _curves(recorded)
        yield path, entry


def _values(recorded: RecordedSignal, unit: str) -> Iterator[list[str]]:
    flat = recorded.values.reshape(len(recorded.t), -1)[:, :CURVES]

    def text(values: np.ndarray) -> str:
        numbers = [f"{v:.6g}".replace("-", "−") for v in values.tolist()]
        return (numbers[0] if len(numbers) == 1 else f"({', '.join(numbers)})") + (
            f" {unit}" if unit not in ("", "1") else ""
        )

    yield [f"at t = {recorded.t[-1]:.6g} s", text(flat[-1])]
    with np.errstate(all="ignore"):
        yield ["smallest, largest", f"{text(flat.min(axis=0))}, {text(flat.max(axis=0))}"]


def _curves(recorded: RecordedSignal) -> list[str]:
    """Return the curves of a signal's entries as points of a picture, 400 wide and 90 high."""
    t, flat = recorded.t, recorded.values.reshape(len(recorded.t), -1)[:, :CURVES].astype(float)
    finite = flat[np.isfinite(flat)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    x = 400.0 * (t - t[0]) / ((t[-1] - t[0]) or 1.0)
    y = 90.0 - 90.0 * (flat - low) / (high - low) if high > low else np.full(flat.shape, 45.0)
    curves = []
    for column in y.T:
        kept = _keep(column)
        curves.append(" ".join(f"{x[i]:.1f},{column[i]:.1f}" for i in kept if np.isfinite(column[i])))
    return curves


def _keep(values: np.ndarray) -> list[int]:
    """Return the samples that a curve needs: all of few, else the extremes of every bin."""
    count = len(values)
    if count <= 2 * BINS:
        return list(range(count))
    edges = np.linspace(0, count, BINS + 1).astype(int)
    safe = np.where(np.isfinite(values), values, 0.0)
    found = {0, count - 1}
    for a, b in itertools.pairwise(edges.tolist()):
        found |= {a + int(np.argmin(safe[a:b])), a + int(np.argmax(safe[a:b]))}
    return sorted(found)
