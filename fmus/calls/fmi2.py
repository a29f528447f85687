"""FMI 2.0; clauses are those of FMI 2.0.4."""

from __future__ import annotations

import ctypes

from .event_calls import AnswersAt, EventCalls, addresses_in
from .fmi_calls import FmiCalls, FmiVersion, Log, TypeCalls, make_callbacks


class Fmi2Calls(FmiCalls):
    """Functions of a library of FMI 2.0."""

    table = FmiVersion(
        number=2,
        types={
            "Float64": TypeCalls("Real", ctypes.c_double),
            "Int32": TypeCalls("Integer", ctypes.c_int32),
            "Boolean": TypeCalls("Boolean", ctypes.c_int32),
            "Enumeration": TypeCalls("Integer", ctypes.c_int32),
        },
        exchange={"derivatives": "GetDerivatives"},
        required=(
            *("GetVersion", "Instantiate", "FreeInstance", "SetupExperiment"),
            *("EnterInitializationMode", "ExitInitializationMode", "Terminate"),
        ),
        final=ctypes.c_int,
        update="newDiscreteStates",
    )

    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``. Memory is the C library's (2.1.5)."""
        callbacks, self._logger = make_callbacks("fmi2", log)
        self.fmu.instantiate(callbacks=callbacks, loggingOn=True)

    def set_up(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Tell start, end and tolerance (2.1.6)."""
        self.fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time)

    def enter_initialization_mode(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Enter Initialization Mode (2.1.6)."""
        self.fmu.enterInitializationMode()

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange (3.2.2), with their own memory."""
        from fmpy.fmi2 import fmi2EventInfo

        info, flags, width = self.variable(fmi2EventInfo), self.variable(ctypes.c_int * 2), ctypes.sizeof(ctypes.c_int)
        final, instance, at = self.variable(ctypes.c_int), self.instance_argument, ctypes.addressof(flags)
        final.value = 1
        names = ("newDiscreteStatesNeeded", "terminateSimulation", "nominalsOfContinuousStatesChanged")
        again, ends, nominals, defined, time = addresses_in(info, *names, "nextEventTimeDefined", "nextEventTime")
        return EventCalls(
            enter=self._mode_call("EnterEventMode"),
            update=(self.function("NewDiscreteStates"), (instance, ctypes.byref(info))),
            leave=self._mode_call("EnterContinuousTimeMode"),
            complete=(
                self.function("CompletedIntegratorStep"),
                (instance, final, ctypes.c_void_p(at), ctypes.c_void_p(at + width)),
            ),
            final=final,
            answers=AnswersAt(width, again, ends, nominals, defined, time, at, at + width),
            kept=(info, flags),
        )
