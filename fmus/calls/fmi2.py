"""Calls of FMI 2.0."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from .bound_calls import AnswersAt, EventCalls, EventUpdate
from .fmi_calls import DISCARD, PENDING, FmiCalls, Log, StepCall, TypeCalls
from .printf import Logger, format_message

_LONGEST_WAIT = 0.01  # s between two looks at a step that is pending
_REQUIRED = (
    *("GetVersion", "Instantiate", "FreeInstance", "SetupExperiment"),
    *("EnterInitializationMode", "ExitInitializationMode", "Terminate"),
)


class Fmi2Calls(FmiCalls):
    """Functions of a library of FMI 2.0; clauses are those of FMI 2.0.4."""

    prefix = "fmi2"
    types: ClassVar = {
        "Float64": TypeCalls("Real", ctypes.c_double),
        "Int32": TypeCalls("Integer", ctypes.c_int32),
        "Boolean": TypeCalls("Boolean", ctypes.c_int32),
        "Enumeration": TypeCalls("Integer", ctypes.c_int32),
    }

    exchange_names: ClassVar = {
        "set_time": "SetTime",
        "set_states": "SetContinuousStates",
        "get_states": "GetContinuousStates",
        "derivatives": "GetDerivatives",
        "indicators": "GetEventIndicators",
        "nominals": "GetNominalsOfContinuousStates",
    }

    def __init__(self, *, name: str, token: str, folder: Path, library: Path, model_exchange: bool):
        from fmpy.fmi2 import FMU2Model, FMU2Slave

        self.fmu = self._open(
            FMU2Model if model_exchange else FMU2Slave,
            _REQUIRED,
            guid=token,
            modelIdentifier=library.stem,
            unzipDirectory=str(folder),
            instanceName=name,
            libraryPath=str(library),
        )

    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``. Memory is the C library's (2.1.5)."""
        from fmpy import calloc, free
        from fmpy.fmi2 import (
            fmi2CallbackAllocateMemoryTYPE,
            fmi2CallbackFreeMemoryTYPE,
            fmi2CallbackFunctions,
            fmi2CallbackLoggerTYPE,
        )

        def message(
            environment: Any, name: Any, status: int, category: Any, text: bytes | None, *arguments: Any
        ) -> None:
            if status:  # the others are not kept
                log(status, format_message(text or b"", arguments))

        self._logger = Logger(message)  # kept as long as the library may call it
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = ctypes.cast(self._logger, fmi2CallbackLoggerTYPE)
        callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        self.fmu.instantiate(callbacks=callbacks, loggingOn=True)

    def set_up(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Tell start, end and tolerance (2.1.6)."""
        self.fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time)

    def enter_initialization_mode(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Enter Initialization Mode (2.1.6)."""
        self.fmu.enterInitializationMode()

    def _get(self, suffix: str, references: list[int], size: int) -> list[Any]:
        return list(getattr(self.fmu, f"get{suffix}")(references))

    def value_arguments(self, references: Any, count: int, address: int, size: int) -> tuple[Any, ...]:
        """Return the arguments of a `value_function` (2.1.7)."""
        component = ctypes.c_void_p(self.fmu.component)
        return component, references, ctypes.c_size_t(count), ctypes.c_void_p(address)

    @property
    def final(self) -> ctypes.c_int:
        """The flag noSetFMUStatePriorToCurrentPoint."""
        value = self.variable(ctypes.c_int)
        value.value = True
        return value

    def step_call(self, now: ctypes.c_double, width: ctypes.c_double, final: Any) -> StepCall:
        """Return fmi2DoStep with its arguments (4.2.2)."""
        flags, component = self.variable(ctypes.c_bool * 4), ctypes.c_void_p(self.fmu.component)
        any_flag = ctypes.c_uint32.from_buffer(flags)
        arguments = (component, now, width, final)
        return StepCall(self._function("fmi2DoStep"), arguments, any_flag, flags, ctypes.c_double(math.nan))

    def end_step(self, status: int) -> tuple[int, bool]:
        """Wait for a step that is pending, and look whether a discarded one asks to end the simulation (4.2.2, 4.2.3).

        The FMU gets no function stepFinished, so that it is asked for the status of its step. A step that is pending
        beyond `patience` stays so.
        """
        from fmpy.fmi1 import FMICallException
        from fmpy.fmi2 import fmi2DoStepStatus, fmi2Terminated

        wait, end = 1e-5, time.monotonic() + self.patience
        while status == PENDING and time.monotonic() < end:
            time.sleep(wait)
            wait = min(2 * wait, _LONGEST_WAIT)
            status = self.fmu.getStatus(fmi2DoStepStatus)
        if status != DISCARD:
            return status, False
        try:
            return status, bool(self.fmu.getBooleanStatus(fmi2Terminated))
        except FMICallException:  # it does not say
            return status, False

    def time_after_discard(self, t: float, h: float) -> float | None:
        """Return the FMU's lastSuccessfulTime (4.2.3); None if it does not say one within the step."""
        from fmpy.fmi1 import FMICallException
        from fmpy.fmi2 import fmi2LastSuccessfulTime

        try:
            found = float(self.fmu.getRealStatus(fmi2LastSuccessfulTime))
        except FMICallException:
            return None
        return min(max(found, t), t + h) if t - 1e-9 * h <= found <= t + h * (1.0 + 1e-9) else None

    def do_step(self, t: float, h: float, final: bool) -> bool:
        """Take a step; return whether it asks to end the simulation."""
        from fmpy.fmi1 import FMICallException

        try:
            self.fmu.doStep(t, h, int(final))
        except FMICallException as error:
            status, ends = self.end_step(error.status)
            if ends:
                return True
            if status > 1:
                raise FMICallException(function=error.function, status=status) from None
        return False

    def directional_derivative(
        self, unknowns: Sequence[int], knowns: Sequence[int], seed: Sequence[float], size: int
    ) -> list[float]:
        """Return the change of unknowns by a change of knowns (2.1.9)."""
        return list(self.fmu.getDirectionalDerivative(list(unknowns), list(knowns), list(seed)))

    def update_discrete_states(self) -> bool:
        """Take a round of the event iteration (3.2.2)."""
        return bool(self.fmu.newDiscreteStates()[0])

    def update_events(self) -> EventUpdate:
        """Take a round of the event iteration, and return what it says (3.2.2)."""
        again, terminate, nominals, states, defined, t = self.fmu.newDiscreteStates()
        return EventUpdate(bool(again), bool(terminate), bool(nominals), bool(states), t if defined else math.inf)

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange (3.2.2), with memory of their own."""
        from fmpy.fmi2 import fmi2EventInfo

        info, flags = self.variable(fmi2EventInfo), self.variable(ctypes.c_int * 2)
        final, instance, at = self.variable(ctypes.c_int), self.instance_argument, ctypes.addressof(flags)
        final.value = 1

        def updated() -> EventUpdate:
            again, terminate = info.newDiscreteStatesNeeded, info.terminateSimulation
            nominals, states = info.nominalsOfContinuousStatesChanged, info.valuesOfContinuousStatesChanged
            t = info.nextEventTime if info.nextEventTimeDefined else math.inf
            return EventUpdate(bool(again), bool(terminate), bool(nominals), bool(states), t)

        return EventCalls(
            self._mode_call("EnterEventMode"),
            (self._function("fmi2NewDiscreteStates"), (instance, ctypes.byref(info))),
            self._mode_call("EnterContinuousTimeMode"),
            (
                self._function("fmi2CompletedIntegratorStep"),
                (instance, final, ctypes.c_void_p(at), ctypes.c_void_p(at + ctypes.sizeof(ctypes.c_int))),
            ),
            final,
            updated,
            lambda: (bool(flags[0]), bool(flags[1])),
            answers=_answers_at(info, at),
        )


def _answers_at(info: Any, flags: int) -> AnswersAt:
    """Return where the answers of events stand in ``fmi2EventInfo``, and behind an address of two flags."""
    start, kind = ctypes.addressof(info), type(info)
    fields = (
        "newDiscreteStatesNeeded",
        "terminateSimulation",
        "nominalsOfContinuousStatesChanged",
        "nextEventTimeDefined",
        "nextEventTime",
    )
    again, terminate, nominals, defined, time = (start + getattr(kind, name).offset for name in fields)
    width = ctypes.sizeof(ctypes.c_int)
    return AnswersAt(width, again, terminate, nominals, defined, time, flags, flags + width)
