"""A step of an FMU as addresses in this process, for a loop in C."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

from .fmi_calls import StepCall
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
    """A step as C calls it: inputs, the step itself, outputs; numbers are addresses, but for ``version``.

    Attributes
    ----------
    version : {2, 3}
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


def native_step(
    fmi: str, now: ctypes.c_double, width: ctypes.c_double, final: Any, call: StepCall, ins: Transfer, outs: Transfer
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
    )


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
