"""Parts of a diagram that become separate FMUs in an SSP: subsystems without FMUs, and blocks between FMUs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...blocks.core import Constant, SspFileError, near
from ...fmus import build
from ..exporting import open_part
from ..flat import WiredDiagram
from ..wiring import Structure, SubsystemSettings, Wire, join
from .terms import Terms

GROUP = "blocks"
"""Subsystem, and component, of the blocks that are in none and between FMUs."""


@dataclass(frozen=True)
class Export:
    """Subsystem that becomes an FMU.

    ``outputs``: its outputs by the block, the port and the entry that makes them: name, and entry; None for a scalar.
    """

    path: str
    inputs: dict[str, Wire]
    outputs: dict[tuple[str, str, int | None], tuple[str, int | None]]

    def find(self, source: tuple[str, str, int | None]) -> tuple[str, int | None]:
        """Return the output that makes a signal.

        Raises `SspFileError` if it has none.
        """
        if source not in self.outputs:
            name = f"{source[0]}.{source[1]}"
            known = {f"{block}.{port}" for block, port, _ in self.outputs}
            raise SspFileError(
                f"found the signal {name}, which is read outside of the subsystem and is none of its outputs; expected "
                f"one that its function returns. Return it. {near(name, known)}",
                block=self.path,
            )
        return self.outputs[source]


def split_diagram(wired: WiredDiagram, fmus: set[str], inputs: set[str]) -> tuple[WiredDiagram, list[str]]:
    """Return a diagram in which what becomes an FMU is in separate subsystems, and their paths.

    ``fmus``, ``inputs``: paths of its FMUs, and of the constants that are inputs of the SSP.
    """
    table = wired.scheduled
    free = _free_subsystems(table, fmus)
    chosen: set[str] = set()
    loose: set[str] = set()
    while True:
        inside = {p for p in table.blocks if any(p.startswith(f"{path}.") for path in chosen)}
        terms = Terms(wired, fmus | inputs | inside | loose)
        ends = [wire for (path, _), wire in table.wires.items() if path in fmus | inside | loose]
        found = {t.stopped for wire in (*ends, *table.names.values()) for t in terms.entries(wire)} - {""}
        known = terms.sources | terms.through
        found |= {p for p, block in table.blocks.items() if p not in known and not isinstance(block, Constant)}
        if not found:
            break
        for path in found:
            owner = next((f for f in free if path.startswith(f"{f}.")), "")
            if owner:
                chosen.add(owner)
            else:
                loose.add(path)
    if not loose:
        return wired, sorted(chosen)
    return _group(wired, _close(table, loose, fmus | inputs | inside)), sorted({*chosen, GROUP})


def _free_subsystems(table: Structure, fmus: set[str]) -> list[str]:
    """Return the outermost subsystems without FMUs in them."""
    found: list[str] = []
    for path in sorted(table.subsystems, key=lambda p: p.count(".")):
        holds = any(p.startswith(f"{path}.") for p in fmus)
        if path and not holds and not any(path.startswith(f"{outer}.") for outer in found):
            found.append(path)
    return found


def _close(table: Structure, loose: set[str], others: set[str]) -> set[str]:
    """Return blocks with all those between them: none of their wires to one another leaves the group."""
    after: dict[str, set[str]] = {}
    for (path, _), wire in table.wires.items():
        if path not in others and wire.block not in others:
            after.setdefault(wire.block, set()).add(path)

    def reach(start: Iterable[str], arrows: dict[str, set[str]]) -> set[str]:
        seen, waiting = set(start), list(start)
        while waiting:
            for following in arrows.get(waiting.pop(), ()):
                if following not in seen:
                    seen.add(following)
                    waiting.append(following)
        return seen

    before: dict[str, set[str]] = {}
    for path, following in after.items():
        for other in following:
            before.setdefault(other, set()).add(path)
    return reach(loose, after) & reach(loose, before)


def _group(wired: WiredDiagram, members: set[str]) -> WiredDiagram:
    """Return the diagram with some blocks in a separate subsystem, whose outputs are what others read."""
    table = wired.structure.copy()
    if GROUP in table.subsystems or GROUP in table.blocks:
        raise SspFileError(
            f"found a block or subsystem {GROUP!r}, the name of the component that {', '.join(sorted(members))} come "
            "into; expected none of that name. Rename it, or put these into a subsystem.",
            block=wired.name,
        )
    moved = {path: join(GROUP, path.replace(".", "_")) for path in members if path in table.blocks}

    def move(wire: Wire) -> Wire:
        return replace(wire, block=moved.get(wire.block, wire.block))

    table.subsystems[GROUP] = SubsystemSettings(GROUP, None, None)
    table.blocks = {moved.get(p, p): b for p, b in table.blocks.items()}
    table.subsystem_of = {moved.get(p, p): GROUP if p in moved else s for p, s in table.subsystem_of.items()}
    table.wires = {(moved.get(p, p), q): move(w) for (p, q), w in table.wires.items()}
    table.names = {n: move(w) for n, w in table.names.items()}
    table.controls = {p: move(w) for p, w in table.controls.items()}
    table.results = {key: move(w) for key, w in table.results.items()}
    table.arguments = {key: move(w) for key, w in table.arguments.items()}
    table.handed = {(moved.get(p, p), q): h for (p, q), h in table.handed.items()}
    read = [w for (p, _), w in table.wires.items() if not p.startswith(f"{GROUP}.")] + list(table.names.values())
    for wire in read:
        if wire.block.startswith(f"{GROUP}."):
            block = table.blocks[wire.block]
            label = wire.block.rpartition(".")[2]
            label = label if len(block.outputs) == 1 else f"{label}_{wire.port}"
            table.results[GROUP, label] = Wire(wire.block, wire.port)
    return WiredDiagram(wired.name, table, wired.loops, wired.facade_class)


def order_sampled(table: Structure, paths: list[str]) -> list[str]:
    """Return the sampled ones of some subsystems in the order in which signals go through them at one instant.

    They are ahead of the plants in an SSP, and parts in continuous time behind: a tool that steps components in this
    order and hands new values on has them when the diagram has.
    """
    left = [p for p in paths if any(table.is_sampled(s) for s in table.subsystems if f"{s}.".startswith(f"{p}."))]
    before: dict[str, set[str]] = {path: set() for path in left}
    for (reader, _), wire in table.wires.items():
        ends = [next((p for p in left if at.startswith(f"{p}.")), "") for at in (reader, wire.block)]
        if all(ends) and ends[0] != ends[1]:
            before[ends[0]].add(ends[1])
    found: list[str] = []
    while left:
        free = next((path for path in left if before[path] <= {*found}), left[0])
        left.remove(free)
        found.append(free)
    return found


def find_export(wired: WiredDiagram, path: str) -> Export:
    """Return a subsystem that becomes an FMU, with its inputs and outputs."""
    opened = open_part(wired, path, path.rpartition(".")[2])
    inputs: dict[str, Wire] = {}
    pairs = [(wired.structure.wires[key], wire) for key, wire in opened.wired.structure.wires.items()]
    pairs += [(wired.structure.controls[key], wire) for key, wire in opened.wired.structure.controls.items()]
    pairs += [(wired.structure.results[key], wire) for key, wire in opened.wired.structure.results.items()]
    for outer, inner in pairs:
        if inner.block == opened.outside:
            whole = inner.index == outer.index
            inputs[inner.port] = replace(outer, index=None) if whole else outer
    outputs: dict[tuple[str, str, int | None], tuple[str, int | None]] = {}
    for name, wire in opened.outputs.items():
        if wire.block == opened.outside:  # a signal that only passes through: its readers have its source
            continue
        full = wired.checked.shapes[wire.block, wire.port]
        picked = wire.entries(full)
        if wire.index is None:
            outputs[wire.block, wire.port, None] = name, None
        for i, entry in enumerate(np.ravel(picked)):
            outputs[wire.block, wire.port, int(entry) if full else None] = name, i if np.shape(picked) else None
    return Export(path, inputs, outputs)


def build_export(wired: WiredDiagram, path: str, *, arrays: bool) -> Path:
    """Return the FMU of a subsystem: of FMI 2.0, which most readers of SSPs take; of FMI 3.0 next to its arrays."""
    return build(wired.facade, name=path.replace(".", "_"), subsystem=path, fmi=3 if arrays else 2, arrays=arrays)
