"""Structure of a block, which a trace depends on, and its numbers, which a trace takes as symbols."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from ..core import Block, Value, identity


def traced_parameters(block: Value, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of every parameter that is a symbol in the trace, nested blocks' included."""
    for name, spec in type(block).parameter_specs.items():
        value = block.__dict__[name]
        if isinstance(value, Block):
            yield from traced_parameters(value, f"{prefix}{name}.")
        elif isinstance(value, float | np.ndarray) and not spec.structural:
            yield prefix + name, value


def structure(block: Value) -> Any:
    """Return the key of a trace besides the shapes: class, fixed values, and which numbers are exactly zero.

    Parameters that equations see through the block's ``constants`` alone (`Block.computed_from`) don't count; those of
    a block within a block do.
    """
    return _structure(block, getattr(type(block), "computed_from", ()))


def _structure(block: Value, left_out: Collection[str] = ()) -> Any:
    items: list[Any] = [type(block)]
    for name, spec in type(block).parameter_specs.items():
        value = block.__dict__[name]
        if name in left_out:
            continue
        items.append((name, *_item(value, structural=spec.structural)))
    return tuple(items)


def _item(value: Any, *, structural: bool) -> tuple[Any, ...]:
    if isinstance(value, Block):
        return (_structure(value),)
    if isinstance(value, float | np.ndarray) and not structural:
        return np.shape(value), (np.asarray(value) == 0).tobytes()
    return (identity(value),)


def has_structure(block: Value, other: Value) -> bool:
    """Whether two blocks have equal structures; values that both share are not looked at."""
    return _has_structure(block, other, getattr(type(block), "computed_from", ()))


def _has_structure(block: Value, other: Value, left_out: Collection[str] = ()) -> bool:
    if type(block) is not type(other):
        return False
    for name, spec in type(block).parameter_specs.items():
        new, old = block.__dict__[name], other.__dict__[name]
        if new is old or name in left_out:
            continue
        if isinstance(new, Block) and isinstance(old, Block):
            if not _has_structure(new, old):
                return False
        elif isinstance(new, float) and isinstance(old, float) and not spec.structural:
            if (new == 0.0) != (old == 0.0):
                return False
        elif _item(new, structural=spec.structural) != _item(old, structural=spec.structural):
            return False
    return True


def is_traced_by(block: Value, other: Value) -> bool:
    """Whether another block's trace holds for this block: equal structure, with its exact zeros among this one's."""
    return _is_traced_by(block, other, getattr(type(block), "computed_from", ()))


def _is_traced_by(block: Value, other: Value, left_out: Collection[str] = ()) -> bool:
    if type(block) is not type(other):
        return False
    for name, spec in type(block).parameter_specs.items():
        new, old = block.__dict__[name], other.__dict__[name]
        if name in left_out:
            continue
        if isinstance(old, Block):
            if not (isinstance(new, Block) and _is_traced_by(new, old)):
                return False
        elif isinstance(old, float | np.ndarray) and not spec.structural:
            if np.shape(new) != np.shape(old) or np.any((np.asarray(old) == 0) & (np.asarray(new) != 0)):
                return False
        elif identity(new) != identity(old):
            return False
    return True
