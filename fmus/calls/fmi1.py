"""FMI 1.0, for co-simulation and for model exchange; clauses are those of its document for co-simulation."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any

from .event_calls import AnswersAt, EventCalls, EventUpdate, addresses_in
from .fmi_calls import FmiCalls, FmiVersion, Log, TypeCalls, make_callbacks

_NO_STATUS = {
    *("GetVersion", "GetTypesPlatform", "GetModelTypesPlatform", "InstantiateSlave", "FreeSlaveInstance"),
    *("InstantiateModel", "FreeModelInstance"),
}


def _return_status(name: str, function: Any) -> None:
    """Let a function return its status; FMPy takes the statuses of some for texts."""
    if name.removeprefix("fmi1") not in _NO_STATUS:
        function.restype = ctypes.c_int


class Fmi1Calls(FmiCalls):
    """Functions of a library of FMI 1.0.

    It has no modes: entering Initialization Mode initializes the FMU, and leaving it does nothing; the same functions
    set inputs at events and between them. Names of the library's functions begin with the model identifier.
    """

    table = FmiVersion(
        number=1,
        types={
            "Float64": TypeCalls("Real", ctypes.c_double),
            "Int32": TypeCalls("Integer", ctypes.c_int32),
            "Boolean": TypeCalls("Boolean", ctypes.c_bool),
            "Enumeration": TypeCalls("Integer", ctypes.c_int32),
        },
        exchange={"derivatives": "GetDerivatives", "nominals": "GetNominalContinuousStates"},
        required=("GetVersion", "InstantiateSlave", "InitializeSlave", "FreeSlaveInstance", "DoStep"),
        required_of_models=(
            *("GetVersion", "InstantiateModel", "Initialize", "FreeModelInstance", "SetTime", "EventUpdate"),
            *("GetDerivatives", "GetContinuousStates", "SetContinuousStates"),
        ),
        final=ctypes.c_bool,
    )

    def __init__(self, *, name: str, token: str, folder: Path, library: Path, model_exchange: bool):
        super().__init__(name=name, token=token, folder=folder, library=library, model_exchange=model_exchange)
        self.freeing = "FreeModelInstance" if model_exchange else "FreeSlaveInstance"
        self._functions.change_each(_return_status)

    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``. Memory is the C library's (3.2)."""
        callbacks, self._logger = make_callbacks("fmi1", log)
        self.fmu.instantiate(functions=callbacks, loggingOn=True)
        if not self.fmu.component:
            raise RuntimeError(f"fmiInstantiate{'Model' if self.is_model else 'Slave'} returned nothing")

    def set_up(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Do nothing: `enter_initialization_mode` takes the times, and tolerances are not passed."""

    def enter_initialization_mode(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Initialize the FMU (3.3); one for model exchange with the start values of its inputs."""
        if not self.is_model:
            self.fmu.initialize(start_time, stop_time)
            return
        self.fmu.setTime(start_time)
        converged, names, _, terminate, defined, t = self.fmu.initialize(
            b"\0" if tolerance is None else b"\1", tolerance or 0.0
        )
        self.initialized = EventUpdate(not converged, terminate, names, t if defined else math.inf)

    def exit_initialization_mode(self) -> None:
        """Do nothing: the FMU is ready to be stepped."""

    def update_events(self) -> EventUpdate:
        """Refuse: FMI 1.0 has no Event Mode."""
        raise NotImplementedError("FMI 1.0 has no Event Mode")

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange, with their own memory."""
        from fmpy.fmi1 import fmi1EventInfo

        info, wanted, final = self.variable(fmi1EventInfo), self.variable(ctypes.c_uint8), self.variable(ctypes.c_int)
        instance, never, at = self.instance_argument, self.variable(ctypes.c_uint8), ctypes.addressof
        names = ("iterationConverged", "terminateSimulation", "stateValueReferencesChanged", "upcomingTimeEvent")
        settled, ends, others, defined, time = addresses_in(info, *names, "nextEventTime")
        return EventCalls(
            enter=None,
            update=(self.function("EventUpdate"), (instance, ctypes.c_bool(False), ctypes.byref(info))),
            leave=None,
            complete=(self.function("CompletedIntegratorStep"), (instance, ctypes.byref(wanted))),
            final=final,
            answers=AnswersAt(1, settled, ends, others, defined, time, at(wanted), at(never), again_where=False),
            kept=(info, wanted, never),
        )
