"""An FMU as addresses, for loops in C: its step, in this process and in another one; model exchange as actions."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..host_state import HostState
from ..isolation import ChildRequest
from .bound_calls import BoundCalls, Call
from .event_calls import AnswersAt
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


# --- model exchange ---------------------------------------------------------------------------------------------------


class ActionKind(IntEnum):
    """Kinds of `NativeAction`: copy into a buffer, or back; set the time; call a function; ask a process for calls."""

    TAKE, GIVE, TIME, CALL, ASK = range(5)


class NativeAction(NamedTuple):
    """One of the actions of an evaluation, as C does it; numbers are addresses."""

    kind: ActionKind
    names: tuple[str, ...] = ()  # of the calls
    function: int = 0  # its first argument is the instance
    # as they are in registers; of `ActionKind.TIME` the instance, and where the time is
    arguments: tuple[int, ...] = ()
    bound: BoundCalls | None = None  # of `ActionKind.ASK`: calls that another process makes
    vector: int = 0  # of a copy: the vector of float64
    places: np.ndarray = np.zeros(0, dtype=np.int64)  # its entries, in the order of the buffer
    buffer: int = 0
    type: int = 0  # of the buffer's values: place in `BUFFER_TYPES`
    low: float = 0.0  # range of integers that fit
    high: float = 0.0


BUFFER_TYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
"""Types of buffers, as numpy names them."""


def copy_action(
    kind: ActionKind, vector: np.ndarray, index: np.ndarray, buffer: np.ndarray, *, type_: str = ""
) -> list[NativeAction]:
    """Return the copy of some entries of a vector into a buffer, or back; ``type_`` is that of the FMU's variables.

    Python alone knows the items of an enumeration: no other value fits than what is in the buffer.
    """
    if not index.size:
        return []
    name, low, high = "u1" if buffer.dtype == bool else buffer.dtype.str[1:], 0.0, 1.0
    if type_ == "Enumeration":
        low, high = 1.0, 0.0
    elif type_ != "Boolean" and buffer.dtype.kind in "iu":
        low, high = (float(side) for side in (np.iinfo(buffer.dtype).min, np.iinfo(buffer.dtype).max))
    return [
        NativeAction(
            kind,
            vector=vector.ctypes.data,
            places=np.ascontiguousarray(index, dtype=np.int64),
            buffer=buffer.ctypes.data,
            type=BUFFER_TYPES.index(name),
            low=max(low, -(2.0**53)),
            high=min(high, 2.0**53),
        )
    ]


def call_action(call: Call, name: str) -> NativeAction:
    """Return a call with its arguments, which are C values, as they are in registers."""
    function, arguments = call
    words = []
    for argument in arguments[1:]:
        if isinstance(argument, ctypes.c_double):
            at = (_word_of(arguments[0]), ctypes.addressof(argument))
            return NativeAction(ActionKind.TIME, (name,), address_of(function), at)
        words.append(_word_of(argument))
    return NativeAction(ActionKind.CALL, (name,), address_of(function), (_word_of(arguments[0]), *words))


def _word_of(argument: Any) -> int:
    if isinstance(argument, ctypes.Array | ctypes.Structure):
        return ctypes.addressof(argument)
    if hasattr(argument, "_obj"):  # what byref returns
        return ctypes.addressof(argument._obj)
    return int(argument.value or 0)


def transfer_actions(
    transfer: Transfer, vector: np.ndarray, index: np.ndarray, kind: ActionKind
) -> Iterable[NativeAction]:
    """Return the copies between a vector, where the ports are at ``index``, and the buffers of a transfer."""
    for group in transfer.groups:
        type_ = next((variable.type for variable in group.ports.values()), "")
        yield from copy_action(kind, vector, index[group.index], group.buffer[: group.size], type_=type_)


@dataclass(frozen=True)
class NativeLook:
    """All that C needs to look at an instant with an FMU in model exchange: a step is complete, or events act."""

    complete: list[NativeAction]  # reports that a step is complete; empty where the FMU need not know
    enter: list[NativeAction]  # go into Event Mode with all inputs for a first round of updates
    update: list[NativeAction]  # take another round
    leave: list[NativeAction]  # go back and get the states
    answers: AnswersAt
    final: Any  # whether no earlier state will be restored, as a C value that ``complete`` reads; None in this process
    least: np.ndarray  # least change of each input that is a jump, and, relative to the input,
    relative: np.ndarray
    discrete: np.ndarray  # (bool) inputs that are taken over by an event alone
    low: np.ndarray  # range of each input, infinite without a limit
    high: np.ndarray
