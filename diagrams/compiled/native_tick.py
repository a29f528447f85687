"""A compiled tick, bound to the vectors of a run: the addresses that the loop in C calls it with."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.interrupts import INTERRUPTS
from ..flat import bind_function
from .code import CompiledTick
from .grouping import PythonCall, Tables
from .libraries import CompiledFunction
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


def call_for_c(call: Callable[[], None]) -> None:
    """Call Python for C; an interrupt waits until C has returned."""
    try:
        INTERRUPTS.heard = True
        call()
    except KeyboardInterrupt:
        INTERRUPTS.came = True
    finally:
        INTERRUPTS.heard = False


@dataclass(frozen=True)
class NativeTick:
    """Addresses of a tick's C function and of all that it takes.

    Attributes
    ----------
    address : int
        Its address.
    arguments, results : int
        Addresses of the lists of vectors.
    iw, w : int or None
        Addresses of its memory.
    kept : object
        Whatever must live as long as this.
    """

    address: int
    arguments: int
    results: int
    iw: int | None
    w: int | None
    kept: Any


def bind_native(tick: CompiledTick, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> NativeTick:
    """Return a tick bound to the vectors (t, x, w, p) and (x_next, z, log, ok) of a run."""
    assert not isinstance(tick, Staged)
    if isinstance(tick, CompiledFunction):
        f = tick.function
        given, made = list_vectors(arguments, f.sz_arg()), list_vectors(results, f.sz_res())
        iw, w = np.zeros(f.sz_iw() + 1, dtype=np.int64), np.zeros(f.sz_w() + 1)
        kept: list[Any] = [given, made, iw, w]
        return NativeTick(tick.address, ctypes.addressof(given), ctypes.addressof(made), at(iw), at(w), kept)
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
    kept = [given, made, v, tables, group, calls]
    return NativeTick(
        tick.address, ctypes.addressof(given), ctypes.addressof(made), ctypes.addressof(group), at(v), kept
    )


def bind_call(tick: CompiledTick, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> Callable[[], None]:
    """Return a tick bound to the vectors of a run as a call from Python."""
    bound = bind_native(tick, arguments, results)
    function = _Tick(bound.address)

    def call() -> None:
        function(bound.arguments, bound.results, bound.iw, bound.w, 0)
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


def list_vectors(vectors: Sequence[np.ndarray], length: int) -> Any:
    """Return the addresses of vectors as C's array of at least this length."""
    found = (ctypes.c_void_p * length)()
    for i, vector in enumerate(vectors):
        found[i] = at(vector)
    return found


def at(vector: np.ndarray) -> int | None:
    """Return the address of a vector; None without entries."""
    return vector.ctypes.data if vector.size else None
