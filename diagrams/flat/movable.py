"""Diagrams of which some parameters are to be moved: exact zeros of theirs are numbers, and no structure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError
from ...blocks.tracing import is_traced_by
from ..wiring import change_parameter, index_of, split_entry
from .wired_diagram import WiredDiagram

Target = tuple[str, list[str]]
"""Path of a block, and the names that lead to a parameter in it, as `find_control` returns them."""
_OTHER = (1.0, 0.5, 2.0, 1e-3, -1.0)
"""Numbers that are tried in the place of a zero: a parameter may have limits."""


def with_movable(wired: WiredDiagram, targets: Iterable[Target]) -> WiredDiagram:
    """Return the same diagram with functions that hold for any number of some parameters.

    An exact zero is structure, and left out of the functions of a diagram: here they are made with another number, and
    the parameter is set to zero again.

    Parameters
    ----------
    wired : WiredDiagram
        The diagram; it is returned where none of these parameters is zero.
    targets : iterable of (str, list of str)
        Path of a block, and the names that lead to a parameter in it.
    """
    table, other = wired.structure, dict[str, Block]()
    for path, keys in targets:
        block = other.get(path, table.blocks[path])
        for number in _OTHER:
            try:
                moved = change_parameter(block, keys, _without_zeros(block, keys, number))
            except LoopwrightError:
                continue
            other[path] = moved
            break
    changed = {path: block for path, block in other.items() if not is_traced_by(block, table.blocks[path])}
    kept = {path: table.blocks[path] for path in changed if is_traced_by(table.blocks[path], changed[path])}
    if not kept:
        return wired
    structure = table.copy()
    structure.blocks.update({path: changed[path] for path in kept})
    return wired.with_structure(structure).renumbered(kept)


def _without_zeros(block: Block, keys: list[str], number: float) -> Any:
    """Return the value of a parameter with a number in the place of zeros."""
    value: Any = block
    for key in keys:
        name, entry = split_entry(key, type(value).parameter_specs) if isinstance(value, Block) else (key, ())
        value = value.__dict__[name] if isinstance(value, Block) else value[name]
        value = np.asarray(value)[index_of(entry, np.shape(value), name)] if entry else value
    return number if np.ndim(value) == 0 and value == 0 else np.where(np.asarray(value) == 0, number, value)
