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


def _left_out(block: Value, nested: bool) -> Collection[str]:
    """Return the parameters that the equations see through ``constants`` alone (`Block.computed_from`)."""
    # The constants are the outer block's, so every parameter of a block within a block counts.
    return () if nested else getattr(type(block), "computed_from", ())


def structure(block: Value, *, nested: bool = False) -> Any:
    """Return the key of a trace, apart from the shapes: class, fixed values, and which numbers are exactly zero."""
    left_out = _left_out(block, nested)
    items: list[Any] = [type(block)]
    for name, spec in type(block).parameter_specs.items():
        if name not in left_out:
            items.append((name, *_item(block.__dict__[name], structural=spec.structural)))
    return tuple(items)


def _item(value: Any, *, structural: bool) -> tuple[Any, ...]:
    if isinstance(value, Block):
        return (structure(value, nested=True),)
    if isinstance(value, float | np.ndarray) and not structural:
        return np.shape(value), (np.asarray(value) == 0).tobytes()
    return (identity(value),)


def has_structure(block: Value, other: Value, *, nested: bool = False) -> bool:
    """Whether two blocks have equal structures; values that both share are not looked at."""
    if type(block) is not type(other):
        return False
    left_out = _left_out(block, nested)
    for name, spec in type(block).parameter_specs.items():
        new, old = block.__dict__[name], other.__dict__[name]
        if new is old or name in left_out:
            continue
        if isinstance(new, Block) and isinstance(old, Block):
            if not has_structure(new, old, nested=True):
                return False
        elif isinstance(new, float) and isinstance(old, float) and not spec.structural:
            if (new == 0.0) != (old == 0.0):
                return False
        elif _item(new, structural=spec.structural) != _item(old, structural=spec.structural):
            return False
    return True


def is_traced_by(block: Value, other: Value, *, nested: bool = False) -> bool:
    """Whether another block's trace holds for this block: equal structure, with its exact zeros among this one's."""
    if type(block) is not type(other):
        return False
    left_out = _left_out(block, nested)
    for name, spec in type(block).parameter_specs.items():
        new, old = block.__dict__[name], other.__dict__[name]
        if name in left_out:
            continue
        if isinstance(old, Block):
            if not (isinstance(new, Block) and is_traced_by(new, old, nested=True)):
                return False
        elif isinstance(old, float | np.ndarray) and not spec.structural:
            if np.shape(new) != np.shape(old) or np.any((np.asarray(old) == 0) & (np.asarray(new) != 0)):
                return False
        elif identity(new) != identity(old):
            return False
    return True
