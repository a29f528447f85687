"""Inputs of FMUs that are not wired, as the user gives them values in ``start``."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from ...blocks.core import enumerate_some
from ...fmus import Fmu
from ..flat import FlatDiagram


def note_held_inputs(flat: FlatDiagram) -> tuple[str, ...]:
    """Return the message on each FMU with inputs that nothing is wired to, and that keep their values of ``start``."""
    if flat not in _KNOWN:
        _KNOWN[flat] = _find(flat)
    return _KNOWN[flat]


_KNOWN: WeakKeyDictionary[FlatDiagram, tuple[str, ...]] = WeakKeyDictionary()
"""The messages on diagrams that have run: each run of one has the same."""


def _find(flat: FlatDiagram) -> tuple[str, ...]:
    found = []
    for path, block in sorted(flat.table.blocks.items()):
        held = [q for q in block.held_inputs if (path, q) not in flat.table.wires] if isinstance(block, Fmu) else []
        if held:
            inputs, keep = ("its input", "keeps its value") if len(held) == 1 else ("its inputs", "keep their values")
            found.append(f"{path}: nothing is wired to {inputs} {enumerate_some(held)}, which {keep} of start=")
    return tuple(found)
