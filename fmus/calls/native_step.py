"""A step of an FMU as addresses, for loops in C: in this process, and in another one."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..host_state import HostState
from ..isolation import ChildRequest
from .transfer import Transfer


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
    """A step as C calls it: inputs, the step itself, outputs; numbers are addresses, but for ``version``."""

    version: int  # of FMI: 1, 2 or 3
    instance: int
    step: int  # function doStep
    inputs: NativeTransfer | None  # calls before and after it; None without such ports
    outputs: NativeTransfer | None
    now: int  # start and length of a step in s; doStep takes them from there
    width: int
    final: int  # flag noSetFMUStatePriorToCurrentPoint
    flags: int  # event, terminate, early return
    reached: int  # time that a step has reached, in s
    kept: tuple[Any, ...]  # whatever must live as long as the addresses
    host: HostState | None  # state of this process, which a library that Loopwright has not built may change


@dataclass(frozen=True, eq=False)
class SharedValues:
    """Values of one type between the vector of a run and memory that is shared with another process."""

    vector: np.ndarray
    shared: np.ndarray
    index: np.ndarray | None  # places of the shared values in the vector; None for all of them in order
    low: np.ndarray | None  # of inputs: the least and the greatest of each value; None without limits
    high: np.ndarray | None


@dataclass(frozen=True, eq=False)
class QuietStep:
    """When a step in another process has nothing but its calls to be done, and what is written before it."""

    until: np.ndarray  # (1,) time in s before whose neighbourhood C takes steps
    vector: np.ndarray  # the run's vector of inputs
    watched: np.ndarray  # (int64) places there of inputs at whose changes events are
    taken: np.ndarray  # their values as they were taken last
    sloped: np.ndarray  # (int64) places of inputs whose slopes are set
    last: np.ndarray  # time in s and their values at the step before; NaN without one
    line: np.ndarray | None  # where their lines go (start, status, values, slopes), or the slopes alone
    slopes: np.ndarray | None
    event: int  # address of the flag of an event at the end of a step; 0 where it makes no difference
    changed: int  # address of the word that is not 0 when texts have changed; 0 without texts
    added: np.ndarray | None  # (1,) sum in s at which the next step begins, NaN at first; None: at the times of the run


@dataclass(frozen=True, eq=False)
class RemoteStep:
    """A step in another process as C asks for it; numbers are addresses, as those of `NativeStep`."""

    request: ChildRequest
    inputs: Sequence[SharedValues]  # copied before and after the calls
    outputs: Sequence[SharedValues]
    now: int
    width: int
    flags: int
    reached: int
    kept: tuple[Any, ...]  # whatever must live as long as the addresses
    quiet: QuietStep | None  # of steps that may be more than these calls
    is_careful: bool  # whether other steps are Python's


def share(transfer: Transfer, *, checked: bool) -> list[SharedValues] | None:
    """Return the values of a transfer, with limits where they are ``checked``; None for an odd enumeration."""
    made = []
    for group in (group for group in transfer.groups if group.size):
        low = high = None
        if checked:
            if (of_type := group.limits) is None:
                return None
            low, high = (side[group.index] for side in transfer.limits)
            low, high = np.maximum(of_type[0], low), np.minimum(of_type[1], high)
            if not group.is_integer and not np.isfinite(low).any() and not np.isfinite(high).any():
                low = high = None  # C need not look at them
        index = None if group.is_whole else np.ascontiguousarray(group.index, dtype=np.int64)
        made.append(SharedValues(transfer.vector, group.buffer[: group.size], index, low, high))
    return made


def transfer_at(of: Transfer) -> NativeTransfer | None:
    """Return the one call of a plain transfer; None without ports."""
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
