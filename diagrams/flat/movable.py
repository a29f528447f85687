"""Diagrams of which some parameters are to be moved: exact zeros of theirs are numbers, and no structure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError
from ...blocks.tracing import Traced, is_traced_by, trace, traced_parameters
from ..wiring import change_parameter, index_of, split_entry
from .flat_layout import sample_time_of
from .wired_diagram import WiredDiagram

Target = tuple[str, list[str]]
"""Path of a block, and the names that lead to a parameter in it, as `find_control` returns them."""
_OTHER = (1.0, 0.5, 2.0, 1e-3, -1.0)
"""Numbers that are tried in the place of a zero: a parameter may have limits."""

_ROUNDING = 1e-12
"""Relative difference of results that are summed in another order."""


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
        other[path] = _move(block, keys) or block
    changed = {path: block for path, block in other.items() if not is_traced_by(block, table.blocks[path])}
    kept = {path: table.blocks[path] for path in changed if is_traced_by(table.blocks[path], changed[path])}
    if not kept:
        return wired
    structure = table.copy()
    structure.blocks.update({path: changed[path] for path in kept})
    return wired.with_structure(structure).renumbered(kept)


def find_movable(wired: WiredDiagram) -> list[Target]:
    """Return the parameters with zeros that can be numbers: what depends on what in their blocks stays as it is.

    A zero that keeps an input from an output, such as the D of a state space, stays structure.
    """
    found: list[Target] = []
    table = wired.scheduled
    for path, traced in wired.checked.traced.items():
        block = wired.structure.blocks.get(path)
        if block is None or block is not table.blocks.get(path):
            continue
        for key, value in traced_parameters(block):
            keys = key.split(".")
            moved = None if np.all(np.asarray(value) != 0) else _move(block, keys)
            if moved is None:
                continue
            sampled = table.is_sampled(table.subsystem_of[path])
            try:
                other = trace(moved, traced.inputs, sampled=sampled, method=traced.method)
            except LoopwrightError:
                continue
            alike = (other.depends, other.advance, other.guards) == (traced.depends, traced.advance, traced.guards)
            if alike and _agree(traced, other, table.blocks[path], sample_time_of(table, path)):
                found.append((path, keys))
                block = moved
    return found


def _agree(traced: Traced, other: Traced, block: Block, T: float) -> bool:
    """Whether equations that were traced with other numbers in the place of zeros hold for the zeros, too.

    Quotients by a zero, and cases that are made for it, are no number there, or another one.
    """
    found = []
    for one in (traced, other):
        f = one.function
        given = [np.linspace(0.3, 1.7, f.numel_in(i)).reshape(f.size_in(i)) for i in range(f.n_in() - 1)]
        with np.errstate(all="ignore"):
            numbers = one.pack(block, T)
        found.append(np.concatenate([np.ravel(part.full()) for part in f.call([*given, numbers])]))
    first, second = found
    return first.shape == second.shape and np.allclose(first, second, rtol=_ROUNDING, atol=0.0, equal_nan=False)


def _move(block: Block, keys: list[str]) -> Block | None:
    """Return a block with another number in the place of the zeros of a parameter; None where it allows none."""
    for number in _OTHER:
        try:
            return change_parameter(block, keys, _without_zeros(block, keys, number))
        except LoopwrightError:
            continue
    return None


def _without_zeros(block: Block, keys: list[str], number: float) -> Any:
    """Return the value of a parameter with a number in the place of zeros."""
    value: Any = block
    for key in keys:
        name, entry = split_entry(key, type(value).parameter_specs) if isinstance(value, Block) else (key, ())
        value = value.__dict__[name] if isinstance(value, Block) else value[name]
        value = np.asarray(value)[index_of(entry, np.shape(value), name)] if entry else value
    return number if np.ndim(value) == 0 and value == 0 else np.where(np.asarray(value) == 0, number, value)
