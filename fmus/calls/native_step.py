"""An FMU as addresses, for loops in C: its step, its calls."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..host_state import HostState
from .bound_calls import AnswersAt, BoundCalls, Call, ChildRequest
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
        step=_address_of(call.function),
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
    added: np.ndarray | None = None


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
    quiet: QuietStep | None = None
    is_careful: bool = False


def remote_step(
    request: ChildRequest, now: ctypes.c_double, width: ctypes.c_double, call: StepCall, ins: Transfer, outs: Transfer
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
    return RemoteStep(request, given, found, at(now), at(width), at(call.flags), at(call.reached), kept)


def _share(of: Transfer, group: TypeGroup) -> SharedValues:
    index = None if group.is_whole else np.ascontiguousarray(group.index, dtype=np.int64)
    return SharedValues(of.vector, group.buffer[: group.size], index, None, None)


def _transfer(of: Transfer) -> NativeTransfer | None:
    if of.plain_call is None:
        return None
    function, (_, references, count, values, *size) = of.plain_call
    return NativeTransfer(
        _address_of(function), ctypes.addressof(references), count.value, values.value, size[0].value if size else 0
    )


def _address_of(function: Any) -> int:
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return address


class ActionKind(IntEnum):
    """Kinds of `NativeAction`: copy into a buffer, or back; set the time; call a function; ask a process for calls."""

    TAKE, GIVE, TIME, CALL, ASK = range(5)


class NativeAction(NamedTuple):
    """One of the actions that an evaluation consists of, as C does it; numbers are addresses, but for ``type``.

    Attributes
    ----------
    kind : ActionKind
        Its kind.
    names : tuple of str
        Names of the calls.
    function : int
        The function that is called; its first argument is the instance.
    arguments : tuple of int
        Its arguments, as they stand in registers; of `ActionKind.TIME` the instance, and where the time stands.
    bound : BoundCalls or None
        Of `ActionKind.ASK`: calls that another process makes.
    vector : int
        Of a copy: the vector of float64.
    places : ndarray of int64
        Its entries, in the order of the buffer.
    buffer : int
        The buffer.
    type : int
        Type of the buffer's values: its place in `BUFFER_TYPES`.
    low, high : float
        Range of integers that fit.
    """

    kind: ActionKind
    names: tuple[str, ...] = ()
    function: int = 0
    arguments: tuple[int, ...] = ()
    bound: BoundCalls | None = None
    vector: int = 0
    places: np.ndarray = np.zeros(0, dtype=np.int64)
    buffer: int = 0
    type: int = 0
    low: float = 0.0
    high: float = 0.0


BUFFER_TYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
"""Types of buffers, as numpy names them."""


def copy_action(
    kind: ActionKind, vector: np.ndarray, index: np.ndarray, buffer: np.ndarray, *, type_: str = ""
) -> list[NativeAction]:
    """Return the copy of some entries of a vector into a buffer, or back; ``type_`` is that of the FMU's variables.

    Python alone knows the items of an enumeration: no other value fits than what stands in the buffer.
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
    """Return a call with its arguments, which are C values, as they stand in registers."""
    function, arguments = call
    words = []
    for argument in arguments[1:]:
        if isinstance(argument, ctypes.c_double):
            at = (_word_of(arguments[0]), ctypes.addressof(argument))
            return NativeAction(ActionKind.TIME, (name,), _address_of(function), at)
        words.append(_word_of(argument))
    return NativeAction(ActionKind.CALL, (name,), _address_of(function), (_word_of(arguments[0]), *words))


def _word_of(argument: Any) -> int:
    if isinstance(argument, ctypes.Array | ctypes.Structure):
        return ctypes.addressof(argument)
    if hasattr(argument, "_obj"):  # what byref returns
        return ctypes.addressof(argument._obj)
    return int(argument.value or 0)


def transfer_actions(
    transfer: Transfer, vector: np.ndarray, index: np.ndarray, kind: ActionKind
) -> Iterable[NativeAction]:
    """Return the copies between a vector, where the ports stand at ``index``, and the buffers of a transfer."""
    for group in transfer.groups:
        type_ = next((variable.type for variable in group.ports.values()), "")
        yield from copy_action(kind, vector, index[group.index], group.buffer[: group.size], type_=type_)


@dataclass(frozen=True)
class NativeLook:
    """All that C needs to look at an instant with an FMU in model exchange: a step is complete, or events act.

    Attributes
    ----------
    complete : list of NativeAction
        Tells that a step is complete; empty where the FMU need not be told.
    enter, update, leave : list of NativeAction
        Go into Event Mode with all inputs for a first round of updates, take another round, go back and get the states.
    answers : AnswersAt
        Where the answers stand.
    final : object
        C value that `complete` reads in another process: whether no earlier state will be restored; in this process
        None, where it is its second argument, and a value that nobody reads in FMI 1.0.
    least, relative : ndarray
        Least change of each input that is a jump, by itself and relative to the input.
    discrete : ndarray of bool
        Inputs that are taken over by an event alone.
    low, high : ndarray
        Range of each input, infinite without a limit.
    """

    complete: list[NativeAction]
    enter: list[NativeAction]
    update: list[NativeAction]
    leave: list[NativeAction]
    answers: AnswersAt
    final: Any
    least: np.ndarray
    relative: np.ndarray
    discrete: np.ndarray
    low: np.ndarray
    high: np.ndarray
