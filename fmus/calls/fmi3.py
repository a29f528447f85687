"""FMI 3.0."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..isolation import InputLines
from .event_calls import AnswersAt, EventCalls
from .fmi_calls import FmiCalls, FmiVersion, Log, TypeCalls

_INTEGERS = {
    f"{sign}Int{bits}": getattr(ctypes, f"c_{sign.lower()}int{bits}") for sign in ("", "U") for bits in (8, 16, 32, 64)
}


class Fmi3Calls(FmiCalls):
    """Functions of a library of FMI 3.0."""

    table = FmiVersion(
        number=3,
        types={
            "Float64": TypeCalls("Float64", ctypes.c_double),
            "Float32": TypeCalls("Float32", ctypes.c_float),
            **{name: TypeCalls(name, ctype) for name, ctype in _INTEGERS.items()},
            "Boolean": TypeCalls("Boolean", ctypes.c_bool),
            "Enumeration": TypeCalls("Int64", ctypes.c_int64),
        },
        exchange={"derivatives": "GetContinuousStateDerivatives"},
        required=("GetVersion", "FreeInstance", "EnterInitializationMode", "ExitInitializationMode", "Terminate"),
        final=ctypes.c_bool,
        has_sizes=True,
        reports_step=True,
        states="FMUState",
        update="updateDiscreteStates",
    )
    _lines: InputLines | None = None

    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``."""

        def message(environment: Any, status: int, category: bytes | None, text: bytes | None) -> None:
            log(status, (text or b"").decode(errors="replace"))

        modes: dict[str, Any] = {}
        if self.event_mode_used or self.early_return_allowed:
            modes = {"eventModeUsed": self.event_mode_used, "earlyReturnAllowed": self.early_return_allowed}
        if self.intermediate_inputs:
            modes["intermediateUpdate"] = self._update_inputs
            modes["requiredIntermediateVariables"] = list(self.intermediate_inputs)
        self.fmu.instantiate(logMessage=message, loggingOn=True, **modes)

    def set_up(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Do nothing: `enter_initialization_mode` takes them."""

    def enter_initialization_mode(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Enter Initialization Mode (FMI 3.0, 2.3.2)."""
        self.fmu.enterInitializationMode(tolerance=tolerance, startTime=start_time, stopTime=stop_time)

    def slope_line(self, references: Sequence[int], n: int) -> np.ndarray:
        """Return start, status, values and slopes of n inputs, which the FMU sets from there within a step (4.2.2)."""
        line = self.allocate(2 + 2 * n, ctypes.c_double)
        self._follow(line, references, n)
        return line

    def _follow(self, line: np.ndarray, references: Sequence[int], n: int) -> None:
        """Let inputs be set from a line when the FMU asks for that; see `slope_line`."""
        numbers = (ctypes.c_double * line.size).from_address(line.ctypes.data)
        self._kept = line
        self._lines = InputLines(numbers, references, self.instance_argument, self.fmu.dll["fmi3SetFloat64"])

    def _update_inputs(self, environment: Any, t: float, can_set: bool, *others: Any) -> None:
        """Set the inputs at a time within a step; called by the FMU."""
        if can_set and self._lines is not None:
            self._lines.set_at(t)

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange (FMI 3.0, 2.3.5 and 3.2), with their own memory."""
        flags, t = self.variable(ctypes.c_bool * 8), self.variable(ctypes.c_double)
        final, instance, at = self.variable(ctypes.c_bool), self.instance_argument, ctypes.addressof(flags)
        final.value = True
        addresses = [ctypes.c_void_p(at + i) for i in range(7)]  # again, terminate, nominals, states, defined, two more
        return EventCalls(
            enter=self._mode_call("EnterEventMode"),
            update=(self.function("UpdateDiscreteStates"), (instance, *addresses[:5], ctypes.byref(t))),
            leave=self._mode_call("EnterContinuousTimeMode"),
            complete=(self.function("CompletedIntegratorStep"), (instance, final, *addresses[5:])),
            final=final,
            answers=AnswersAt(1, at, at + 1, at + 2, at + 4, ctypes.addressof(t), at + 5, at + 6),
            kept=(flags, t),
        )
