"""A compiled tick, bound to the vectors of a run: the addresses that the loop in C calls it with."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.interrupts import INTERRUPTS
from ..flat import bind_function
from .code import CompiledTick
from .functions import Bound, CompiledFunction, TickStructure, at, call_for_c, list_vectors
from .grouping import PythonCall, Tables
from .staged_functions import Staged

_Tick = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)
_Python = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64)


class _Group(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("runs", "rows")),
        *((name, ctypes.c_int64) for name in ("count", "states", "outside", "log", "next")),
        *((name, ctypes.c_void_p) for name in ("inputs", "guards", "made", "taken")),
        *((name, ctypes.c_int64) for name in ("n_inputs", "n_guards", "n_loops", "residual")),
        ("python", _Python),
        ("unread", ctypes.c_void_p),
        ("n_unread", ctypes.c_int64),
    ]


def bind_native(tick: CompiledTick, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> Bound:
    """Return a tick bound to the vectors (t, x, w, p) and (x_next, z, log, ok) of a run."""
    assert not isinstance(tick, Staged)
    if isinstance(tick, CompiledFunction):
        return tick.bind(arguments, results)
    given, made, v, tables = (
        list_vectors(arguments, 4),
        list_vectors(results, 4),
        tick.tables.memory.copy(),
        tick.tables,
    )
    calls = [bind_python(call, tick.functions, v, arguments[3]) for call in tables.python]

    def call(i: int) -> int:
        call_for_c(calls[i])
        return 0

    group = _group(tables, arguments, _Python(call))
    structure = TickStructure(
        tick.address, ctypes.addressof(given), ctypes.addressof(made), ctypes.addressof(group), at(v)
    )
    return Bound(structure, arguments, results, [given, made, v, tables, group, calls])


def bind_call(tick: CompiledTick, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> Callable[[], None]:
    """Return a tick bound to the vectors of a run as a call from Python."""
    bound = bind_native(tick, arguments, results)
    of = bound.structure
    function = _Tick(of.evaluate)

    def call() -> None:
        function(of.arguments, of.results, of.iw, of.w, 0)
        _ = bound  # it lives as long as this
        if INTERRUPTS.came:
            INTERRUPTS.check()

    return call


def _group(tables: Tables, arguments: Sequence[np.ndarray], python: Any) -> _Group:
    return _Group(
        runs=at(tables.runs),
        rows=at(tables.rows),
        count=len(tables.runs),
        states=arguments[1].size,
        outside=arguments[2].size,
        log=tables.log,
        next=tables.next,
        inputs=at(tables.inputs),
        guards=at(tables.guards),
        made=at(tables.made),
        taken=at(tables.taken),
        n_inputs=tables.inputs.size,
        n_guards=tables.guards.size,
        n_loops=tables.made.size,
        residual=tables.residual,
        python=python,
        unread=at(tables.unread),
        n_unread=tables.unread.size,
    )


def bind_python(call: PythonCall, functions: Mapping[int, Any], v: np.ndarray, p: np.ndarray) -> Callable[[], None]:
    """Return the call that lets Python evaluate a block from v and p into v."""
    *given, parameters = call.arguments
    columns = [v[:1], *(v[where] for where in given[1:]), p[parameters]]
    bound = bind_function(functions[call.key], columns, [v[where] for where in call.results])

    def evaluate() -> None:
        bound.call()

    return evaluate
