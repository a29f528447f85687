"""Wires of a diagram that lie on loops, and those of them at which one and the same loop is cut.

The numbers of such wires agree, so that the loop's figures are drawn once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any

from ..flat import FlatDiagram, WiredDiagram
from ..frequency import Number
from ..linearization import SignalPaths, find_signal
from ..wiring import find_cyclic_parts

MOST = 4
"""Wires at which loops are looked at where none has a name."""
SAME = 1e-6
"""Relative difference of two numbers up to which they are those of one loop: far above rounding, far below what a
figure shows."""


def wires_on_loops(diagram: WiredDiagram, wires: Sequence[str] | None = None) -> dict[str, str]:
    """Return the wires at which loops are looked at, by their keys in a report.

    Without a choice these are all that have names and lie on loops; where none has a name, the inputs of FMUs on loops,
    or else outputs of blocks on loops.
    """
    if wires is not None:
        return {_key(name): name for name in wires}
    inside = blocks_on_loops(diagram)
    paths = SignalPaths(diagram.flatten(None if diagram.has_base else Fraction(1)))  # any step: wires are the same
    seen: set[tuple[str, str, Any]] = set()
    names: dict[str, str] = {}
    for name, wire in sorted(diagram.names.items(), key=lambda item: (item[0].count("."), item[0])):
        where = (wire.block, wire.port, str(wire.index))
        if wire.block in inside and where not in seen and paths.is_on_loop((wire.block, wire.port)):
            seen.add(where)
            names[name] = name
    if not names:
        table = diagram.structure
        on_loops = [(to, wire) for (to, _), wire in table.wires.items() if wire.block in inside]
        driving = {f"{wire.block}.{wire.port}" for to, wire in on_loops if table.blocks[to].stepped}
        sources = {f"{wire.block}.{wire.port}" for _, wire in on_loops}
        names = {path: path for path in sorted(driving or sources)[:MOST]}
    ends = [name.rpartition(".")[2] for name in names]
    return {(e if ends.count(e) == 1 else _key(n)): n for e, n in zip(ends, names, strict=True)}


def blocks_on_loops(diagram: WiredDiagram) -> set[str]:
    """Return the blocks that lie on a cycle of wires."""
    table = diagram.structure
    pairs = [(w.block, block) for (block, _), w in table.wires.items()]
    return set().union(*find_cyclic_parts(sorted(table.blocks), pairs))


def ways_through(flat: FlatDiagram, wire: str, others: Iterable[str]) -> tuple[str, ...]:
    """Return those of other wires that every loop through a wire goes through; empty where a loop misses them all.

    They are wires that each loop goes through, where there are any; else all that share a loop with the wire.
    """
    port = find_signal(flat, wire).port
    whole, ports = SignalPaths(flat), dict[str, tuple[str, str]]()
    for other in others:
        tap = find_signal(flat, other)
        is_whole = len(tap.entries) == math.prod(flat.checked.shapes[tap.port])
        if is_whole and tap.port != port and whole.is_on_loop(port, tap.port):
            ports[other] = tap.port
    alone = [other for other, cut in ports.items() if not SignalPaths(flat, [cut]).is_on_loop(port)]
    together = not SignalPaths(flat, ports.values()).is_on_loop(port)
    return tuple(alone or ports) if together else ()


def _key(name: str) -> str:
    return name.replace(".", "_")


def find_same(loops: Mapping[str, Mapping[str, Number]]) -> dict[str, str]:
    """Return the keys of loops that another one shows, with that one's key.

    ``loops`` has the numbers of each loop by its key, by paths that name the variant: a loop is shown by one that has
    the same numbers, and may have those of further variants.
    """
    ranked = sorted((key for key in loops if loops[key]), key=lambda key: -len(loops[key]))  # ties in their order
    shown: dict[str, str] = {}
    for i, key in enumerate(ranked):
        others = (other for other in ranked[:i] if other not in shown)
        found = next((other for other in others if _contains(loops[other], loops[key])), None)
        if found is not None:
            shown[key] = found
    return shown


def _contains(whole: Mapping[str, Number], part: Mapping[str, Number]) -> bool:
    return all(path in whole and is_same(whole[path].value, number.value) for path, number in part.items())


def is_same(a: float, b: float) -> bool:
    """Whether two numbers are those of one loop."""
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=SAME)
