"""Lists of variables that are read again and again from a library in another process: one round trip each."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from ..archive import FmuVariable
from .bound_calls import WARNING, BoundCalls
from .fmi_calls import FmiCalls

_MOST = 50
"""Lists whose calls are kept; others are read type by type."""


class SharedReading:
    """Calls that read lists of variables, bound when a list is read for the second time."""

    def __init__(self, fmi: FmiCalls):
        self.fmi = fmi
        self._seen: set[tuple[str, ...]] = set()
        self._lists: dict[tuple[str, ...], tuple[BoundCalls, list[np.ndarray]]] = {}

    def read(self, groups: Sequence[Sequence[FmuVariable]]) -> list[np.ndarray]:
        """Return the values of each group of variables of one type; nothing in process, or where a call fails."""
        key = tuple(v.name for group in groups for v in group)
        if self.fmi.in_process or not key:
            return []
        if key not in self._lists:
            if key not in self._seen or len(self._lists) >= _MOST:
                self._seen.add(key)
                return []
            self._lists[key] = self._bind(groups)
        bound, values = self._lists[key]
        return [np.array(v) for v in values] if 0 <= bound.run() <= WARNING else []

    def _bind(self, groups: Sequence[Sequence[FmuVariable]]) -> tuple[BoundCalls, list[np.ndarray]]:
        calls, values = [], []
        for group in groups:
            type_, size = group[0].type, sum(v.size for v in group)
            references = [r for v in group for r in v.references]
            kept = (ctypes.c_uint * len(references))(*references)
            buffer = self.fmi.allocate(size, self.fmi.types[type_].ctype)
            arguments = self.fmi.value_arguments(kept, len(references), buffer.ctypes.data, size)
            calls.append((self.fmi.value_function("Get", type_), arguments))
            values.append(buffer)
        return self.fmi.bind(calls), values
