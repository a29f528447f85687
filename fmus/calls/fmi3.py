"""Calls of FMI 3.0."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from .bound_calls import AnswersAt, EventCalls, EventUpdate
from .fmi_calls import MOST_ROUNDS, FmiCalls, Log, StepCall, TypeCalls

_INTEGERS = {f"{sign}Int{bits}": getattr(ctypes, f"c_{sign.lower()}int{bits}")
             for sign in ("", "U") for bits in (8, 16, 32, 64)}  # fmt: skip
_REQUIRED = ("GetVersion", "FreeInstance", "EnterInitializationMode", "ExitInitializationMode", "Terminate")


class Fmi3Calls(FmiCalls):
    """Functions of a library of FMI 3.0."""

    prefix = "fmi3"
    """Worst status of inputs that were set within a step."""
    _slopes: tuple[float, Any, Any, list[tuple[float, float]]] | None = None
    types: ClassVar = {
        "Float64": TypeCalls("Float64", ctypes.c_double),
        "Float32": TypeCalls("Float32", ctypes.c_float),
        **{name: TypeCalls(name, ctype) for name, ctype in _INTEGERS.items()},
        "Boolean": TypeCalls("Boolean", ctypes.c_bool),
        "Enumeration": TypeCalls("Int64", ctypes.c_int64),
    }

    exchange_names: ClassVar = {
        "set_time": "SetTime",
        "set_states": "SetContinuousStates",
        "get_states": "GetContinuousStates",
        "derivatives": "GetContinuousStateDerivatives",
        "indicators": "GetEventIndicators",
        "nominals": "GetNominalsOfContinuousStates",
    }

    def __init__(self, *, name: str, token: str, folder: Path, library: Path, model_exchange: bool):
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        self.fmu = self._open(
            FMU3Model if model_exchange else FMU3Slave,
            _REQUIRED,
            guid=token,
            modelIdentifier=library.stem,
            unzipDirectory=str(folder),
            instanceName=name,
        )

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

    def _get(self, suffix: str, references: list[int], size: int) -> list[Any]:
        return list(getattr(self.fmu, f"get{suffix}")(references, size))

    def value_arguments(self, references: Any, count: int, address: int, size: int) -> tuple[Any, ...]:
        """Return the arguments of a `value_function`."""
        component, length = ctypes.c_void_p(self.fmu.component), ctypes.c_size_t
        return component, references, length(count), ctypes.c_void_p(address), length(size)

    @property
    def final(self) -> ctypes.c_bool:
        """The flag noSetFMUStatePriorToCurrentPoint."""
        value = self.variable(ctypes.c_bool)
        value.value = True
        return value

    def step_call(self, now: ctypes.c_double, width: ctypes.c_double, final: Any) -> StepCall:
        """Return fmi3DoStep with its arguments (FMI 3.0, 4.2.1)."""
        flags = self.variable(ctypes.c_bool * 4)  # event, terminate, early return, and one that is never set
        reached, address, at = self.variable(ctypes.c_double), ctypes.c_void_p, ctypes.addressof(flags)
        reached.value = math.nan
        arguments = (
            *(ctypes.c_void_p(self.fmu.component), now, width, final),
            *(address(at), address(at + 1), address(at + 2), ctypes.byref(reached)),
        )
        any_flag = ctypes.c_uint32.from_buffer(flags)
        return StepCall(self._function("fmi3DoStep"), arguments, any_flag, flags, reached)

    def set_input_slopes(
        self, t: float, references: Sequence[int], inputs: Sequence[float], slopes: Sequence[float]
    ) -> None:
        """Keep the slopes of inputs, which are set when the FMU asks for that within a step (FMI 3.0, 4.2.2)."""
        kept, n = (ctypes.c_uint * len(references))(*references), len(inputs)
        self._slopes = t, kept, (ctypes.c_double * n)(), list(zip(inputs, slopes, strict=True))

    def _update_inputs(self, environment: Any, t: float, set_requested: bool, *others: Any) -> None:
        """Set the inputs at a time within a step; called by the FMU."""
        if not set_requested or self._slopes is None:
            return
        start, references, buffer, lines = self._slopes
        for i, (value, slope) in enumerate(lines):
            buffer[i] = value + slope * (t - start)
        status = self._set_inputs(self.fmu.component, references, len(references), buffer, len(lines))
        self.intermediate_status = max(self.intermediate_status, status)

    @cached_property
    def _set_inputs(self) -> Callable[..., int]:
        function = ctypes.CFUNCTYPE(
            ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
        )
        return function(("fmi3SetFloat64", self.fmu.dll))

    def end_step(self, status: int) -> tuple[int, bool]:
        """Return the status: in FMI 3.0 a step is never pending, and flags ask to end the simulation."""
        return status, False

    def do_step(self, t: float, h: float, final: bool) -> bool:
        """Take a step with its events; return whether it ended early or asks to end the simulation."""
        end = t + h
        for _ in range(MOST_ROUNDS):
            event, terminate, early, reached = self.fmu.doStep(t, h, final)
            if event and self.event_mode_used and not terminate:
                self.enter_event_mode()
                self.settle_events()
            if terminate or not early or not self.early_return_allowed:
                return bool(terminate or early)
            t, h = reached, end - reached
            if h <= 1e-9 * (end - t + h):
                return False
        return True

    def directional_derivative(
        self, unknowns: Sequence[int], knowns: Sequence[int], seed: Sequence[float], size: int
    ) -> list[float]:
        """Return the change of unknowns by a change of knowns (FMI 3.0, 2.2.11)."""
        return list(self.fmu.getDirectionalDerivative(list(unknowns), list(knowns), list(seed), size))

    def update_discrete_states(self) -> bool:
        """Take a round of the event iteration (FMI 3.0, 2.3.5)."""
        return bool(self.fmu.updateDiscreteStates()[0])

    def update_events(self) -> EventUpdate:
        """Take a round of the event iteration, and return what it says (FMI 3.0, 2.3.5)."""
        again, terminate, nominals, states, defined, t = self.fmu.updateDiscreteStates()
        return EventUpdate(bool(again), bool(terminate), bool(nominals), bool(states), t if defined else math.inf)

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange (FMI 3.0, 2.3.5 and 3.2), with memory of their own."""
        flags, t = self.variable(ctypes.c_bool * 8), self.variable(ctypes.c_double)
        final, instance, at = self.variable(ctypes.c_bool), self.instance_argument, ctypes.addressof(flags)
        final.value = True
        addresses = [ctypes.c_void_p(at + i) for i in range(7)]

        def updated() -> EventUpdate:
            again, terminate, nominals, states, defined = flags[:5]
            return EventUpdate(again, terminate, nominals, states, t.value if defined else math.inf)

        return EventCalls(
            self._mode_call("EnterEventMode"),
            (self._function("fmi3UpdateDiscreteStates"), (instance, *addresses[:5], ctypes.byref(t))),
            self._mode_call("EnterContinuousTimeMode"),
            (self._function("fmi3CompletedIntegratorStep"), (instance, final, *addresses[5:])),
            final,
            updated,
            lambda: (flags[5], flags[6]),
            answers=AnswersAt(1, at, at + 1, at + 2, at + 4, ctypes.addressof(t), at + 5, at + 6),
        )
