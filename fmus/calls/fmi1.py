"""Calls of FMI 1.0, for co-simulation and for model exchange."""

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
_STEP_STATUS, _LAST_SUCCESSFUL_TIME, _TERMINATED = 0, 2, 3  # fmiStatusKind
_REQUIRED = ("GetVersion", "InstantiateSlave", "InitializeSlave", "FreeSlaveInstance", "DoStep")
_REQUIRED_OF_MODELS = (
    *("GetVersion", "InstantiateModel", "Initialize", "FreeModelInstance", "SetTime", "EventUpdate"),
    *("GetDerivatives", "GetContinuousStates", "SetContinuousStates"),
)
_NO_STATUS = {
    *("GetVersion", "GetTypesPlatform", "GetModelTypesPlatform", "InstantiateSlave", "FreeSlaveInstance"),
    *("InstantiateModel", "FreeModelInstance"),
}


class Fmi1Calls(FmiCalls):
    """Functions of a library of FMI 1.0; clauses are those of its document for co-simulation.

    It has no modes: entering Initialization Mode initializes the FMU, and leaving it does nothing; the same functions
    set inputs at events and between them. Names of the library's functions begin with the model identifier.
    """

    prefix = "fmi1"
    types: ClassVar = {
        "Float64": TypeCalls("Real", ctypes.c_double),
        "Int32": TypeCalls("Integer", ctypes.c_int32),
        "Boolean": TypeCalls("Boolean", ctypes.c_bool),
        "Enumeration": TypeCalls("Integer", ctypes.c_int32),
    }
    exchange_names: ClassVar = {
        "set_time": "SetTime",
        "set_states": "SetContinuousStates",
        "get_states": "GetContinuousStates",
        "derivatives": "GetDerivatives",
        "indicators": "GetEventIndicators",
        "nominals": "GetNominalContinuousStates",
    }
    _initialized: EventUpdate | None = None

    def __init__(self, *, name: str, token: str, folder: Path, library: Path, model_exchange: bool):
        from fmpy.fmi1 import FMU1Model, FMU1Slave

        self._is_model = model_exchange
        self.freeing = "FreeModelInstance" if model_exchange else "FreeSlaveInstance"
        self.fmu = self._open(
            FMU1Model if model_exchange else FMU1Slave,
            _REQUIRED_OF_MODELS if model_exchange else _REQUIRED,
            guid=token,
            modelIdentifier=library.stem,
            unzipDirectory=str(folder),
            instanceName=name,
            libraryPath=str(library),
        )
        for kind, function in self.fmu._functions.items():  # FMPy takes the statuses of some for texts
            if kind.removeprefix("fmi1") not in _NO_STATUS:
                function.restype = ctypes.c_int

    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``. Memory is the C library's (3.2)."""
        from fmpy import calloc, free
        from fmpy.fmi1 import (
            fmi1CallbackAllocateMemoryTYPE,
            fmi1CallbackFreeMemoryTYPE,
            fmi1CallbackFunctions,
            fmi1CallbackLoggerTYPE,
        )

        def message(component: Any, name: Any, status: int, category: Any, text: bytes | None, *arguments: Any) -> None:
            if status:  # the others are not kept
                log(status, format_message(text or b"", arguments))

        self._logger = Logger(message)  # kept as long as the library may call it
        callbacks = fmi1CallbackFunctions()
        callbacks.logger = ctypes.cast(self._logger, fmi1CallbackLoggerTYPE)
        callbacks.allocateMemory = fmi1CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi1CallbackFreeMemoryTYPE(free)
        callbacks.stepFinished = None
        self.fmu.instantiate(functions=callbacks, loggingOn=True)
        if not self.fmu.component:
            raise RuntimeError(f"fmiInstantiate{'Model' if self._is_model else 'Slave'} returned nothing")

    def set_up(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Do nothing: `enter_initialization_mode` takes the times, and tolerances are not told."""

    def enter_initialization_mode(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Initialize the FMU (3.3); one for model exchange with the start values of its inputs."""
        if not self._is_model:
            self.fmu.initialize(start_time, stop_time)
            return
        self.fmu.setTime(start_time)
        converged, names, _, terminate, defined, t = self.fmu.initialize(
            b"\0" if tolerance is None else b"\1", tolerance or 0.0
        )
        self._initialized = EventUpdate(not converged, terminate, names, True, t if defined else math.inf)

    def exit_initialization_mode(self) -> None:
        """Do nothing: the FMU is ready to be stepped."""

    def _get(self, suffix: str, references: list[int], size: int) -> list[Any]:
        return list(getattr(self.fmu, f"get{suffix}")(references))

    def value_arguments(self, references: Any, count: int, address: int, size: int) -> tuple[Any, ...]:
        """Return the arguments of a `value_function` (3.5)."""
        component = ctypes.c_void_p(self.fmu.component)
        return component, references, ctypes.c_size_t(count), ctypes.c_void_p(address)

    @property
    def final(self) -> Any:
        """A flag that FMI 1.0 does not have."""
        return self.variable(ctypes.c_bool)

    def step_call(self, now: ctypes.c_double, width: ctypes.c_double, final: Any) -> StepCall:
        """Return fmiDoStep with its arguments (3.4); each step is a new one."""
        flags, component = self.variable(ctypes.c_bool * 4), ctypes.c_void_p(self.fmu.component)
        reached = self.variable(ctypes.c_double)
        reached.value = math.nan
        arguments = (component, now, width, ctypes.c_bool(True))
        any_flag = ctypes.c_uint32.from_buffer(flags)
        return StepCall(self._function("fmi1DoStep"), arguments, any_flag, flags, reached)

    def end_step(self, status: int) -> tuple[int, bool]:
        """Wait for a step that is pending (3.4), and look whether a discarded one asks to end the simulation.

        That request, fmiTerminated, came with FMI 1.0.1; an FMU that does not know it discards the question.
        """
        from fmpy.fmi1 import FMICallException

        wait = 1e-5
        while status == PENDING:
            time.sleep(wait)
            wait = min(2 * wait, _LONGEST_WAIT)
            status = self.fmu.getStatus(_STEP_STATUS).value
        if status != DISCARD:
            return status, False
        try:
            return status, self.fmu.getBooleanStatus(_TERMINATED).value != b"\x00"
        except (FMICallException, KeyError):
            return status, False

    def time_after_discard(self, t: float, h: float) -> float | None:
        """Return the FMU's lastSuccessfulTime (3.6); None if it does not say one within the step."""
        from fmpy.fmi1 import FMICallException

        try:
            found = float(self.fmu.getRealStatus(_LAST_SUCCESSFUL_TIME).value)
        except FMICallException:
            return None
        return min(max(found, t), t + h) if t - 1e-9 * h <= found <= t + h * (1.0 + 1e-9) else None

    def do_step(self, t: float, h: float, final: bool) -> bool:
        """Take a step; return whether it asks to end the simulation."""
        from fmpy.fmi1 import FMICallException

        try:
            self.fmu.doStep(t, h)
        except FMICallException as error:
            status, ends = self.end_step(error.status)
            if ends:
                return True
            if status > 1:
                raise FMICallException(function=error.function, status=status) from None
        return False

    def set_input_slopes(
        self, t: float, references: Sequence[int], inputs: Sequence[float], slopes: Sequence[float]
    ) -> None:
        """Tell the first time derivatives of real inputs (3.5)."""
        from fmpy.fmi1 import FMICallException

        n = len(references)
        kept, orders = (ctypes.c_uint * n)(*references), (ctypes.c_int * n)(*[1] * n)
        function = self.fmu._functions["fmi1SetRealInputDerivatives"]
        if (status := function(self.fmu.component, kept, n, orders, (ctypes.c_double * n)(*slopes))) > 1:
            raise FMICallException(function="fmiSetRealInputDerivatives", status=status)

    def directional_derivative(
        self, unknowns: Sequence[int], knowns: Sequence[int], seed: Sequence[float], size: int
    ) -> list[float]:
        """Refuse: FMI 1.0 has none."""
        raise NotImplementedError("FMI 1.0 has no directional derivatives")

    def update_discrete_states(self) -> bool:
        """Refuse: FMI 1.0 has no Event Mode in co-simulation."""
        raise NotImplementedError("FMI 1.0 has no Event Mode in co-simulation")

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange, with memory of their own."""
        from fmpy.fmi1 import fmi1EventInfo

        info, wanted, final = self.variable(fmi1EventInfo), self.variable(ctypes.c_uint8), self.variable(ctypes.c_int)
        instance, never = self.instance_argument, self.variable(ctypes.c_uint8)
        at, kind = ctypes.addressof, type(info)
        names = ("iterationConverged", "terminateSimulation", "stateValueReferencesChanged", "upcomingTimeEvent")
        settled, ends, others, defined = (at(info) + getattr(kind, name).offset for name in names)
        time_at = at(info) + kind.nextEventTime.offset

        def updated() -> EventUpdate:
            def flag(name: str) -> bool:
                return bool(getattr(info, name) != b"\0")

            t = info.nextEventTime if flag("upcomingTimeEvent") else math.inf
            names, states = flag("stateValueReferencesChanged"), flag("stateValuesChanged")
            return EventUpdate(not flag("iterationConverged"), flag("terminateSimulation"), names, states, t)

        return EventCalls(
            None,
            (self._function("fmi1EventUpdate"), (instance, ctypes.c_bool(False), ctypes.byref(info))),
            None,
            (self._function("fmi1CompletedIntegratorStep"), (instance, ctypes.byref(wanted))),
            final,
            updated,
            lambda: (bool(wanted.value), bool(never.value)),
            lambda: self._initialized,
            AnswersAt(1, settled, ends, others, defined, time_at, at(wanted), at(never), again_where=False),
        )

    def update_events(self) -> EventUpdate:
        """Refuse: FMI 1.0 has no Event Mode in co-simulation."""
        raise NotImplementedError("FMI 1.0 has no Event Mode in co-simulation")
