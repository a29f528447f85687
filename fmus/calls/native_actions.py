"""An FMU in model exchange as actions of a loop in C: its evaluation, and a look at an instant."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from .bound_calls import BoundCalls, Call
from .event_calls import AnswersAt
from .native_step import address_of
from .transfer import Transfer


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
