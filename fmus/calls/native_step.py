"""A step of an FMU as addresses, for loops in C: in this process, and in another one."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..host_state import HostState
from .bound_calls import ChildRequest
from .fmi_calls import StepCall
from .transfer import Transfer, TypeGroup


@dataclass(frozen=True)
class NativeTransfer:
    """A call that gets or sets values of type Float64: its function, and its arguments behind the instance."""

    function: int
    references: int
    count: int
    values: int
    size: int

    def read_references(self) -> tuple[int, ...]:
        """Return the value references of the ports."""
        return tuple((ctypes.c_uint32 * self.count).from_address(self.references))


@dataclass(frozen=True)
class NativeStep:
    """A step as C calls it: inputs, the step itself, outputs; numbers are addresses, but for ``version``.

    Attributes
    ----------
    version : {1, 2, 3}
        Version of FMI.
    instance, step : int
        The instance, and its function doStep.
    inputs, outputs : NativeTransfer or None
        Calls before and after it; None without such ports.
    now, width : int
        Of the time from which a step goes, and of its length, both in s; doStep takes them from there.
    final : int
        Of the flag noSetFMUStatePriorToCurrentPoint.
    flags : int
        Of the flags event, terminate, early return.
    reached : int
        Of the time that a step has reached, in s.
    kept : tuple
        Whatever must live as long as the addresses.
    host : HostState or None
        The state of this process, which a library that Loopwright has not built may change.
    """

    version: int
    instance: int
    step: int
    inputs: NativeTransfer | None
    outputs: NativeTransfer | None
    now: int
    width: int
    final: int
    flags: int
    reached: int
    kept: tuple[Any, ...]
    host: HostState | None


def native_step(
    fmi: str,
    now: ctypes.c_double,
    width: ctypes.c_double,
    final: Any,
    call: StepCall,
    ins: Transfer,
    outs: Transfer,
    *,
    host: HostState | None,
) -> NativeStep:
    """Return a step of a library in this process as addresses."""
    at = ctypes.addressof
    return NativeStep(
        version=int(fmi[0]),
        instance=call.arguments[0].value,
        step=address_of(call.function),
        inputs=_transfer(ins),
        outputs=_transfer(outs),
        now=at(now),
        width=at(width),
        final=at(final),
        flags=at(call.flags),
        reached=at(call.reached),
        kept=(now, width, final, call, ins, outs),
        host=host,
    )


@dataclass(frozen=True, eq=False)
class SharedValues:
    """Values of one type between the vector of a run and memory that is shared with another process.

    Attributes
    ----------
    vector : ndarray
        The run's vector.
    shared : ndarray
        Values in the shared memory.
    index : ndarray of int, or None
        Their places in the vector; None for all of them in order.
    low, high : ndarray or None
        Of inputs: the least and the greatest of each value; None without limits.
    """

    vector: np.ndarray
    shared: np.ndarray
    index: np.ndarray | None
    low: np.ndarray | None
    high: np.ndarray | None


@dataclass(frozen=True, eq=False)
class QuietStep:
    """When a step in another process has nothing but its calls to be done, and what is written before it.

    Attributes
    ----------
    until : ndarray, shape (1,)
        Time in s before whose neighbourhood C takes steps.
    vector : ndarray
        The run's vector of inputs.
    watched : ndarray of int64
        Places there of inputs at whose changes events are.
    taken : ndarray
        Their values as they were taken last.
    sloped : ndarray of int64
        Places of inputs whose slopes are told.
    last : ndarray
        Time in s and their values at the step before; NaN without one.
    line, slopes : ndarray or None
        Where their lines go (start, status, values, slopes), or the slopes alone.
    event : int
        Address of the flag of an event at the end of a step; 0 where it makes no difference.
    changed : int
        Address of the word that tells that texts have changed; 0 without texts.
    added : ndarray, shape (1,), or None
        Time in s that steps have added up to, at which the next one begins; NaN before the first one. None where steps
        begin at the times of the run.
    """

    until: np.ndarray
    vector: np.ndarray
    watched: np.ndarray
    taken: np.ndarray
    sloped: np.ndarray
    last: np.ndarray
    line: np.ndarray | None
    slopes: np.ndarray | None
    event: int
    changed: int
    added: np.ndarray | None


@dataclass(frozen=True, eq=False)
class RemoteStep:
    """A step in another process as C asks for it; numbers are addresses.

    Attributes
    ----------
    request : ChildRequest
        The calls.
    inputs, outputs : sequence of SharedValues
        Values to be copied before and after them.
    now, width, flags, reached : int
        As those of `NativeStep`.
    kept : tuple
        Whatever must live as long as the addresses.
    quiet : QuietStep or None
        Of steps that may be more than these calls.
    is_careful : bool
        Whether other steps are Python's.
    """

    request: ChildRequest
    inputs: Sequence[SharedValues]
    outputs: Sequence[SharedValues]
    now: int
    width: int
    flags: int
    reached: int
    kept: tuple[Any, ...]
    quiet: QuietStep | None
    is_careful: bool


def remote_step(
    request: ChildRequest,
    now: ctypes.c_double,
    width: ctypes.c_double,
    call: StepCall,
    ins: Transfer,
    outs: Transfer,
    *,
    quiet: QuietStep | None,
    is_careful: bool,
) -> RemoteStep | None:
    """Return a step of a library in another process as addresses; None where inputs are of an odd enumeration."""
    at = ctypes.addressof
    given, found = ([_share(of, group) for group in of.groups if group.size] for of in (ins, outs))
    low, high = ins.limits
    for i, values in enumerate(given):
        group = [group for group in ins.groups if group.size][i]
        limits = group.limits
        if limits is None:
            return None
        least, most = np.maximum(limits[0], low[group.index]), np.minimum(limits[1], high[group.index])
        if group.is_integer or np.isfinite(least).any() or np.isfinite(most).any():
            given[i] = SharedValues(values.vector, values.shared, values.index, least, most)
    kept = (now, width, call, ins, outs)
    numbers = at(now), at(width), at(call.flags), at(call.reached)
    return RemoteStep(request, given, found, *numbers, kept, quiet, is_careful)


def _share(of: Transfer, group: TypeGroup) -> SharedValues:
    index = None if group.is_whole else np.ascontiguousarray(group.index, dtype=np.int64)
    return SharedValues(of.vector, group.buffer[: group.size], index, None, None)


def _transfer(of: Transfer) -> NativeTransfer | None:
    if of.plain_call is None:
        return None
    function, (_, references, count, values, *size) = of.plain_call
    return NativeTransfer(
        address_of(function), ctypes.addressof(references), count.value, values.value, size[0].value if size else 0
    )


def address_of(function: Any) -> int:
    """Return the address of a C function."""
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return address
