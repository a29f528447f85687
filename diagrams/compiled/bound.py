"""Compiled functions, bound to vectors."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from .functions import CompiledFunction, TickStructure, at, call_for_c, list_vectors
from .grouped_parts import Differences, DifferencesStructure, GroupedPart, PartStructure, PythonTick
from .hybrid_code import Between
from .native_tick import bind_python


class BoundFunction:
    """A compiled function, bound to vectors.

    Parameters
    ----------
    compiled : CompiledFunction, GroupedPart or Differences
        The function.
    arguments, results : sequence of ndarray
        Its vectors.
    typical : ndarray, optional
        Of differences: the sizes of the states below which steps don't become smaller.

    Attributes
    ----------
    structure : ctypes.Structure
        It as C knows it; valid as long as this lives.
    """

    def __init__(
        self,
        compiled: Between,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
        typical: np.ndarray | None = None,
    ):
        self._kept: list[Any] = [compiled, arguments, results]
        if isinstance(compiled, CompiledFunction):
            bound = compiled.bind(arguments, results)
            self._kept.append(bound)
            self.structure = bound.structure
        elif isinstance(compiled, GroupedPart):
            self.structure = self._bind_part(compiled, arguments, results)
        else:
            assert isinstance(compiled, Differences)
            self.structure = self._bind_differences(compiled, arguments, results, typical)

    def _own(self, vector: np.ndarray) -> int | None:
        self._kept.append(vector)
        return at(vector)

    def _lists(self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], *sizes: int) -> tuple[int, int]:
        lists = [list_vectors(vectors, n) for vectors, n in zip((arguments, results), sizes, strict=True)]
        self._kept += lists
        return ctypes.addressof(lists[0]), ctypes.addressof(lists[1])

    def _bind_part(
        self, part: GroupedPart, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> TickStructure:
        tables, v = part.tables, part.tables.memory.copy()
        calls = [bind_python(call, part.functions, v, arguments[3]) for call in tables.python]

        def call(i: int) -> int:
            call_for_c(calls[i])
            return 0

        group = PartStructure(
            runs=at(tables.runs),
            rows=at(tables.rows),
            count=len(tables.runs),
            states=arguments[1].size,
            outside=arguments[2].size,
            more=arguments[4].size if len(arguments) > 4 else 0,
            where=at(tables.where),
            lengths=(ctypes.c_int64 * 2)(*tables.lengths),
            python=PythonTick(call),
        )
        self._kept += [group, calls]
        return TickStructure(
            part.address, *self._lists(arguments, results, 5, 2), ctypes.addressof(group), self._own(v)
        )

    def _bind_differences(
        self,
        made: Differences,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
        typical: np.ndarray | None,
    ) -> TickStructure:
        n = len(made.where)
        dx = np.zeros(n)
        rates = self._bind_part(made.rates, arguments, [dx])
        group = DifferencesStructure(
            rates=rates.evaluate,
            arguments=rates.arguments,
            results=rates.results,
            iw=rates.iw,
            v=rates.w,
            x=at(arguments[1]),
            dx=self._own(dx),
            before=self._own(np.zeros(n)),
            step=self._own(np.zeros(n)),
            typical=self._own(np.ones(n) if typical is None else np.ascontiguousarray(typical)),
            n=n,
            colors=len(made.first) - 1,
            where=self._own(made.where.astype(np.int64)),
            first=at(made.first),
            columns=at(made.columns),
            rows_first=at(made.rows_first),
            rows=at(made.rows),
        )
        self._kept += [rates, group]
        return TickStructure(made.address, *self._lists(arguments, results, 4, 1), ctypes.addressof(group), None)


def address(vector: np.ndarray) -> int | None:
    """Return the address of a vector; None without entries."""
    return at(vector)
