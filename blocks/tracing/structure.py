"""Structure of a block, which a trace depends on, and its numbers, which a trace takes as symbols."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np

from ..core import Block, Value, identity

_NUMBERS = (float, np.ndarray)


def traced_parameters(block: Value, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of every parameter that is a symbol in the trace, nested blocks' included."""
    for name, spec in type(block).parameter_specs.items():
        value = block.__dict__[name]
        if isinstance(value, Block):
            yield from traced_parameters(value, f"{prefix}{name}.")
        elif isinstance(value, _NUMBERS) and not spec.structural:
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
    if isinstance(value, _NUMBERS) and not structural:
        return np.shape(value), (np.asarray(value) == 0).tobytes()
    return (identity(value),)


def has_structure(block: Value, other: Value) -> bool:
    """Whether two blocks have equal structures."""
    return _agree(block, other, _have_same_zeros)


def is_traced_by(block: Value, other: Value) -> bool:
    """Whether another block's trace holds for this block: equal structure, with its exact zeros among this one's."""
    return _agree(block, other, lambda new, old: not np.any((np.asarray(old) == 0) & (np.asarray(new) != 0)))


def _have_same_zeros(new: float | np.ndarray, old: float | np.ndarray) -> bool:
    if isinstance(new, float):
        return bool((new == 0.0) == (old == 0.0))
    return bool(np.array_equal(new == 0.0, old == 0.0))


def _agree(block: Value, other: Value, fits: Callable[[Any, Any], bool], *, nested: bool = False) -> bool:
    """Whether two blocks have equal fixed values, and numbers of equal shapes that fit; shared ones are passed over."""
    if type(block) is not type(other):
        return False
    left_out = _left_out(block, nested)
    for name, spec in type(block).parameter_specs.items():
        new, old = block.__dict__[name], other.__dict__[name]
        if new is old or name in left_out:
            continue
        if isinstance(new, Block) and isinstance(old, Block):
            alike = _agree(new, old, fits, nested=True)
        elif isinstance(new, _NUMBERS) and isinstance(old, _NUMBERS) and not spec.structural:
            alike = getattr(new, "shape", ()) == getattr(old, "shape", ()) and fits(new, old)
        else:
            alike = identity(new) == identity(old)
        if not alike:
            return False
    return True
