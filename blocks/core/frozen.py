"""Read-only copies of mappings, lists, sets and arrays, as parameters hold them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

import numpy as np

from .errors import ParameterError


class FrozenMapping(Mapping[Any, Any]):
    """A read-only mapping of read-only values that can be compared, hashed and pickled."""

    # the standard library's `types.MappingProxyType` can't be pickled, and shows changes of the mapping behind it
    __slots__ = ("_items",)
    _items: dict[Any, Any]

    def __init__(self, items: Mapping[Any, Any]):
        object.__setattr__(self, "_items", {key: freeze(value) for key, value in items.items()})

    def __getitem__(self, key: Any) -> Any:
        return self._items[key]

    def __iter__(self) -> Iterator[Any]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Mapping):
            return NotImplemented
        return self.keys() == other.keys() and all(_are_equal(value, other[key]) for key, value in self.items())

    def __hash__(self) -> int:
        return hash(frozenset(self._items))  # equal mappings have equal keys; arrays among the values have no hash

    def __repr__(self) -> str:
        return repr(self._items)

    def __reduce__(self) -> Any:
        return FrozenMapping, (self._items,)

    def _refuse(self, *_: Any) -> NoReturn:
        raise ParameterError(
            "a mapping that is a parameter can't be changed; give replace(…) a new one, such as {**old, name: value}, "
            "and keep the result."
        )

    __setitem__ = __delitem__ = __setattr__ = _refuse


def _are_equal(a: Any, b: Any) -> bool:
    arrays = isinstance(a, np.ndarray) or isinstance(b, np.ndarray)
    return bool(np.array_equal(a, b) if arrays else a == b)


def freeze(value: Any) -> Any:
    """Return a read-only copy of an array, mapping, list, tuple or set; other objects are returned as they are."""
    if isinstance(value, np.ndarray):
        if value.flags.writeable or value.base is not None:  # the array behind a read-only view may still change
            value = value.copy()
            value.flags.writeable = False
        return value
    if isinstance(value, FrozenMapping):
        return value
    if isinstance(value, Mapping):
        return FrozenMapping(value)
    if type(value) in (list, tuple):
        return tuple(freeze(v) for v in value)
    return frozenset(value) if isinstance(value, set) else value
