"""Functions of an FMU's library for one instance, for all versions of FMI.

Differences between versions in names and in the shapes of arguments are in a table, `FmiVersion`; other steps of an
instance's life, in the class of a version.
"""

from __future__ import annotations

import ctypes
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from ...blocks.core import FmuProcessError
from ..isolation import log_and_memory
from .bound_calls import DISCARD, ERROR, FATAL, PENDING, STATUS, WARNING, BoundCalls, Call
from .event_calls import EventCalls, EventUpdate
from .library_functions import LibraryFunctions, allow_missing, exported_name

__all__ = ["DISCARD", "ERROR", "FATAL", "PENDING", "STATUS", "WARNING", "FmiCalls"]

_LONGEST_WAIT = 0.01
"""Longest time in s between two looks at a step that is pending."""
_STEP_STATUS, _LAST_SUCCESSFUL_TIME, _TERMINATED = 0, 2, 3
"""What a step is asked for: fmi2DoStepStatus, fmi2LastSuccessfulTime, fmi2Terminated, and the same of FMI 1.0."""
MOST_ROUNDS = 100
"""Rounds of an event iteration before an error."""
Log = Callable[[int, str], None]
"""Takes the status and the text of a message."""
C = TypeVar("C")


def call_error_type() -> Any:
    """Return FMPy's class of errors of functions that fail."""
    from fmpy.fmi1 import FMICallException

    return FMICallException


def make_callbacks(prefix: str, log: Log) -> tuple[Any, Any]:
    """Return the callbacks of an instance before FMI 3.0, as FMPy's structure, and what must live as long as it."""
    pointers, logger = log_and_memory(log)
    return getattr(import_module(f"fmpy.{prefix}"), f"{prefix}CallbackFunctions").from_buffer_copy(pointers), logger


@dataclass(frozen=True)
class TypeCalls:
    """Functions that get and set variables of a type, and the C type of their values."""

    suffix: str
    """End of the functions' names, such as ``Float64``."""
    ctype: type[Any]


_EXCHANGE = {
    "set_time": "SetTime",
    "set_states": "SetContinuousStates",
    "get_states": "GetContinuousStates",
    "indicators": "GetEventIndicators",
    "nominals": "GetNominalsOfContinuousStates",
}
"""Ends of the names of the functions of model exchange that each evaluation calls."""


@dataclass(frozen=True)
class FmiVersion:
    """Names of functions in a version of FMI, and shapes of their arguments."""

    number: int
    types: Mapping[str, TypeCalls]
    """Functions by type, as FMI 3.0 names types."""
    exchange: Mapping[str, str]
    """Ends of the names of functions of model exchange that are others than those of `_EXCHANGE`."""
    required: tuple[str, ...]
    """Ends of the names of functions without which an FMU can't run."""
    final: type[Any]
    """C type of the argument noSetFMUStatePriorToCurrentPoint of a step; in FMI 1.0 it says that a step is new."""
    has_sizes: bool = False
    """Whether functions of values take their number as the last argument."""
    reports_step: bool = False
    """Whether a step reports events, its end and early return; else it may be pending, and is asked for its end."""
    states: str = "FMUstate"
    """End of the names of the functions of saved states."""
    update: str = ""
    """FMPy's method that takes a round of the event iteration in Event Mode."""
    required_of_models: tuple[str, ...] | None = None
    """The required functions in model exchange, where they are others."""

    @property
    def prefix(self) -> str:
        """Prefix of the names of functions and statuses: ``fmi2``, say."""
        return f"fmi{self.number}"

    def kind(self, *, model_exchange: bool) -> Any:
        """Return FMPy's class for the functions of a library."""
        module = import_module(f"fmpy.{self.prefix}")
        return getattr(module, f"FMU{self.number}{'Model' if model_exchange else 'Slave'}")


@dataclass
class StepCall:
    """The function that takes a step, with arguments that are made once, so that no call checks their types."""

    function: Callable[..., int]
    arguments: tuple[Any, ...]
    any_flag: ctypes.c_uint32
    """Not zero if the function has set one of its flags."""
    flags: Any
    """Flags ``event``, ``terminate``, ``early``; all false in FMI 2.0, which has none."""
    reached: ctypes.c_double
    """Time at which a step has ended, in s; NaN if the FMU does not say it, as in FMI 2.0."""


class FmiCalls(ABC):
    """Functions of an FMU's library for one instance, by FMPy's object for it (``fmu``).

    Functions that fail raise an error of FMPy, with a ``status``; those that are not called at each step are methods.
    """

    table: ClassVar[FmiVersion]
    fmu: Any
    freeing = "FreeInstance"  # end of the name of the function that frees an instance
    patience: float = 60.0
    """Longest time in s for which a step may be pending."""

    def __init__(self, *, name: str, token: str, folder: Path, library: Path, model_exchange: bool):
        """Load a library, of an FMU that is unpacked into a folder; a name is given to the instance."""
        table, self.is_model = self.table, model_exchange
        self.prefix, self.types = table.prefix, table.types
        required = (table.required_of_models if model_exchange else None) or table.required
        self.fmu = self._open(
            table.kind(model_exchange=model_exchange),
            required,
            guid=token,
            modelIdentifier=library.stem,
            unzipDirectory=str(folder),
            instanceName=name,
            libraryPath=str(library),
        )

    def _open(self, kind: Any, required: tuple[str, ...], **arguments: Any) -> Any:
        """Return an object of FMPy's class, with its library loaded; see `allow_missing`."""
        return allow_missing(kind, self.prefix, required)(**arguments)

    @property
    def _functions(self) -> LibraryFunctions:
        functions: LibraryFunctions = self.fmu._functions
        return functions

    # ---- memory and calls that are bound once ----

    lose: Callable[[FmuProcessError], FmuProcessError] = staticmethod(lambda error: error)
    """Completes the error of a process that has ended, for bound calls."""
    in_process: ClassVar[bool] = True
    """Whether the library reads and writes this process's memory; else `allocate` and `variable` alone."""

    def allocate(self, n: int, ctype: type[Any]) -> np.ndarray:
        """Return an array (n,) of zeros of a C type that bound calls can read and write."""
        return np.zeros(max(1, n), dtype=ctype)[:n]

    def variable(self, ctype: type[C]) -> C:
        """Return a C value, array or structure that bound calls can read and write."""
        return ctype()

    def bind(self, calls: Sequence[Call]) -> BoundCalls:
        """Bind functions of the library to their arguments, to be called one after the other."""
        return BoundCalls(calls)

    # ---- the life of an instance ----

    initialized: EventUpdate | None = None
    """What the initialization says of events in model exchange, in FMI 1.0."""
    event_mode_used = False
    """Whether the FMU is informed that its events are handled in Event Mode; set it before `instantiate`."""
    early_return_allowed = False
    """Whether the FMU is informed that it may end a step early; set it before `instantiate`."""
    intermediate_inputs: tuple[int, ...] = ()
    """Value references of inputs that are set within a step (FMI 3.0, 4.2.2); set them before `instantiate`."""

    def version(self) -> str:
        """Return the version of FMI that the library states; empty if it states none."""
        stated = getattr(self.fmu, f"{self.prefix}GetVersion")()
        return "" if stated is None else bytes(stated).decode(errors="replace")

    @abstractmethod
    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``."""

    @abstractmethod
    def set_up(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Tell start, end and tolerance before start values are set, where the version does so."""

    @abstractmethod
    def enter_initialization_mode(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Enter Initialization Mode."""

    def exit_initialization_mode(self) -> None:
        """Leave Initialization Mode."""
        self.fmu.exitInitializationMode()

    def reset(self) -> None:
        """Return to the state before the initialization."""
        self.fmu.reset()

    def renew(self, log: Log, running: bool) -> None:
        """Free the instance, terminated if it is running, and make another one; its messages go to ``log``.

        Calls that are bound are then of the new one. An instance may be freed after an error of its termination.
        """
        if running:
            try:
                self.terminate()
            except call_error_type() as error:
                if error.status == FATAL:
                    raise
        getattr(self.fmu, f"{self.prefix}{self.freeing}")(self.fmu.component)
        self.instantiate(log)
        self.instance_argument.value = self.fmu.component

    def terminate(self) -> None:
        """End the run of the instance."""
        self.fmu.terminate()

    def free_instance(self) -> None:
        """Free the instance and unload the library."""
        self.fmu.freeInstance()

    def read_printed(self) -> list[str]:
        """Return the last lines that the FMU has written to its standard output, where nobody sees them."""
        return []

    def describe_memory(self) -> str:
        """Return a sentence if the FMU's memory is nearly used up, else an empty text."""
        return ""

    def end(self) -> None:  # noqa: B027 (in process there is nothing else)
        """Give up everything else, at the end of the instance and after an error, too."""

    def lacks(self, function: str) -> bool:
        """Whether the library does not export a function, such as "GetString", so that its calls return an error."""
        return self._functions.lack(f"{self.prefix}{function}")

    # ---- values ----

    def get(self, type_: str, references: Sequence[int], size: int) -> list[Any]:
        """Return the values of variables of one type."""
        sizes = (size,) if self.table.has_sizes else ()
        return list(getattr(self.fmu, f"get{self.types[type_].suffix}")(list(references), *sizes))

    def set(self, type_: str, references: Sequence[int], values: Sequence[Any]) -> None:
        """Set the values of variables of one type."""
        getattr(self.fmu, f"set{self.types[type_].suffix}")(list(references), list(values))

    def get_texts(self, references: Sequence[int], size: int) -> list[str]:
        """Return the elements of variables that are texts."""
        values, kept = (ctypes.c_char_p * size)(), (ctypes.c_uint * len(references))(*references)
        sizes = (size,) if self.table.has_sizes else ()
        get = getattr(self.fmu, f"{self.prefix}GetString")
        get(self.fmu.component, kept, len(references), values, *sizes)
        return [(value or b"").decode(errors="replace") for value in values]

    def set_texts(self, references: Sequence[int], values: Sequence[str]) -> None:
        """Set the elements of variables that are texts."""
        self.fmu.setString(list(references), list(values))

    def get_binaries(self, references: Sequence[int], size: int) -> list[bytes]:
        """Return the elements of variables that are binary data; only FMI 3.0 has them."""
        return [value or b"" for value in self.fmu.getBinary(list(references), size)]

    def set_binaries(self, references: Sequence[int], values: Sequence[bytes]) -> None:
        """Set the elements of variables that are binary data; only FMI 3.0 has them."""
        self.fmu.setBinary(list(references), list(values))

    def enter_configuration_mode(self) -> None:
        """Enter Configuration Mode, in which structural parameters are set (FMI 3.0, 2.3.4)."""
        self.fmu.enterConfigurationMode()

    def exit_configuration_mode(self) -> None:
        """Leave Configuration Mode."""
        self.fmu.exitConfigurationMode()

    def value_function(self, verb: str, type_: str) -> Callable[..., int]:
        """Return the C function that gets or sets values of a type; it takes `value_arguments`."""
        return self.function(f"{verb}{self.types[type_].suffix}")

    def value_arguments(self, references: Any, count: int, address: int, size: int) -> tuple[Any, ...]:
        """Return the arguments of a `value_function`: a C array of references, and the address of the values."""
        sizes = (ctypes.c_size_t(size),) if self.table.has_sizes else ()
        return self.instance_argument, references, ctypes.c_size_t(count), ctypes.c_void_p(address), *sizes

    def exported(self, name: str) -> str:
        """Return the name that the library gives to a function."""
        return exported_name(name, self.prefix, self.fmu.modelIdentifier)

    text_watch: Callable[..., int] | None = None
    """Function for bound calls that notes whether texts have changed; None in this process, where they are read."""

    def slopes_call(self, references: Sequence[int], slopes: np.ndarray) -> Call:
        """Return the call that passes the slopes of inputs within a step, which are in an array; not in FMI 3.0."""
        n, kept = slopes.size, (ctypes.c_uint * len(references))(*references)
        values = (ctypes.c_int * n)(*[1] * n), ctypes.c_void_p(slopes.ctypes.data)
        return self.function("SetRealInputDerivatives"), (self.instance_argument, kept, ctypes.c_size_t(n), *values)

    def slope_line(self, references: Sequence[int], n: int) -> np.ndarray:
        """Return start, status, values and slopes of n inputs, which FMI 3.0 sets from there within a step (4.2.2)."""
        raise NotImplementedError

    def function(self, name: str) -> Callable[..., int]:
        """Return a C function by its name without prefix, for bound calls: it takes arguments that are made for it.

        Its status is unsigned, so that a negative one, which the standard doesn't have, is no success.
        """
        name = f"{self.prefix}{name}"
        if self._functions.lack(name):
            return self._functions[name]  # type: ignore[no-any-return]
        function = self.fmu.dll[self.exported(name)]
        function.restype = ctypes.c_uint
        if self._after is not None:
            function.errcheck = self._after
        return function  # type: ignore[no-any-return]

    _after: Callable[..., Any] | None = None

    def settle_by(self, after: Callable[..., Any]) -> None:
        """Let ctypes call a function after each function of the library, with what that has returned."""

        def settle(name: str, function: Any) -> None:
            function.errcheck = after

        self._after = after
        self._functions.change_each(settle)

    # ---- steps ----

    @property
    def final(self) -> Any:
        """The flag noSetFMUStatePriorToCurrentPoint, as a C value that can be changed."""
        value = self.variable(self.table.final)
        value.value = True
        return value

    def step_call(self, now: ctypes.c_double, width: ctypes.c_double, final: Any) -> StepCall:
        """Return the function that takes a step from ``now`` over ``width``, both in s (FMI 3.0, 4.2.1)."""
        flags = self.variable(ctypes.c_bool * 4)  # event, terminate, early return, and one that is never set
        reached, at = self.variable(ctypes.c_double), ctypes.addressof(flags)
        reached.value = math.nan
        reports = (*(ctypes.c_void_p(at + i) for i in range(3)), ctypes.byref(reached))
        arguments = self.instance_argument, now, width, final, *(reports if self.table.reports_step else ())
        any_flag = ctypes.c_uint32.from_buffer(flags)
        return StepCall(self.function("DoStep"), arguments, any_flag, flags, reached)

    def end_step(self, status: int) -> tuple[int, bool]:
        """Return the status with which a step has ended, and whether the FMU asks to end the simulation.

        In FMI 3.0 flags ask for the end, and no step is ever pending. Before, one that is pending is waited for, up to
        `patience`; a discarded one is asked whether it is the end (FMI 1.0, 3.4; FMI 2.0, 4.2.2 and 4.2.3). An FMU of
        FMI 1.0.0 doesn't know that question, and others may not answer it.
        """
        if self.table.reports_step:
            return status, False
        wait, end = 1e-5, time.monotonic() + self.patience
        while status == PENDING and time.monotonic() < end:
            time.sleep(wait)
            wait = min(2 * wait, _LONGEST_WAIT)
            status = int(self._ask_step("getStatus", _STEP_STATUS))
        if status != DISCARD:
            return status, False
        try:
            return status, self._ask_step("getBooleanStatus", _TERMINATED) not in (False, b"\0")
        except call_error_type():
            return status, False

    def time_after_discard(self, t: float, h: float) -> float | None:
        """Return the time in s that the FMU has reached when a step from t over h was discarded; None if unknown.

        In FMI 3.0 it is where it was; before, it says so by lastSuccessfulTime (FMI 1.0, 3.6; FMI 2.0, 4.2.3).
        """
        if self.table.reports_step:
            return t
        try:
            found = float(self._ask_step("getRealStatus", _LAST_SUCCESSFUL_TIME))
        except call_error_type():
            return None
        return min(max(found, t), t + h) if t - 1e-9 * h <= found <= t + h * (1.0 + 1e-9) else None

    def _ask_step(self, question: str, kind: int) -> Any:
        """Return the answer to one of FMPy's questions on the last step; those of FMI 1.0 are C values."""
        found = getattr(self.fmu, question)(kind)
        return getattr(found, "value", found)

    def enter_step_mode(self) -> None:
        """Go back from Event Mode to Step Mode (FMI 3.0, 4.2.1)."""
        self.fmu.enterStepMode()

    def iterate_events(self) -> EventUpdate:
        """Take rounds of the event iteration, and return what the last one says: ``again`` if they don't settle."""
        for _ in range(MOST_ROUNDS):
            found = self.update_events()
            if found.terminate:
                return found._replace(again=False)
            if not found.again:
                break
        return found

    def activate_clocks(self, references: Sequence[int]) -> None:
        """Let input clocks tick, in Event Mode (FMI 3.0, 2.2.9)."""
        self.fmu.setClock(list(references), [True] * len(references))

    def clock_intervals(self, references: Sequence[int]) -> list[tuple[float, int]]:
        """Return the intervals of clocks in s, each with its qualifier: 0 unknown, 1 unchanged, 2 changed."""
        n = len(references)
        kept, intervals, qualifiers = (ctypes.c_uint * n)(*references), (ctypes.c_double * n)(), (ctypes.c_int * n)()
        self.fmu.getIntervalDecimal(kept, intervals, qualifiers)
        return list(zip(intervals, qualifiers, strict=True))

    # ---- saved states and derivatives ----

    def save_call(self, handle: ctypes.c_void_p) -> Call:
        """Return the call that saves the state into a handle, in the memory that the handle has from before, if any."""
        return self.function(f"Get{self.table.states}"), (self.instance_argument, ctypes.byref(handle))

    def save_state(self) -> Any:
        """Return the handle of a copy of the instance's memory."""
        return self.fmu.getFMUState()

    def set_state(self, handle: Any) -> None:
        """Restore a saved state."""
        self.fmu.setFMUState(handle)

    def free_state(self, handle: Any) -> None:
        """Free a saved state."""
        self.fmu.freeFMUState(handle)

    def serialize_state(self, handle: Any) -> bytes:
        """Return a saved state as bytes."""
        return bytes(self.fmu.serializeFMUState(handle))

    def deserialize_state(self, data: bytes) -> Any:
        """Return the handle of a state that was made from bytes."""
        return self.fmu.deserializeFMUState(data)

    def directional_derivative(
        self, unknowns: Sequence[int], knowns: Sequence[int], seed: Sequence[float], size: int
    ) -> list[float]:
        """Return the change of unknowns by one of knowns, by their references (FMI 2.0, 2.1.9; FMI 3.0, 2.2.11)."""
        sizes = (size,) if self.table.has_sizes else ()
        return list(self.fmu.getDirectionalDerivative(list(unknowns), list(knowns), list(seed), *sizes))

    # ---- model exchange ----

    def exchange_function(self, name: str) -> Callable[..., int]:
        """Return the C function "set_time", which takes the instance and a time, or one of vectors of float64.

        These take instance, address and length: "set_states", "get_states", "derivatives", "indicators", "nominals".
        """
        return self.function(self.table.exchange.get(name) or _EXCHANGE[name])

    @cached_property
    def instance_argument(self) -> ctypes.c_void_p:
        """The present instance, as an argument of C functions: the same C value in all bound calls."""
        made = self.variable(ctypes.c_void_p)
        made.value = self.fmu.component
        return made

    def update_events(self) -> EventUpdate:
        """Take a round of the event iteration, and return what it says (FMI 2.0, 3.2.2; FMI 3.0, 2.3.5)."""
        again, terminate, nominals, _, defined, t = getattr(self.fmu, self.table.update)()
        return EventUpdate(bool(again), bool(terminate), bool(nominals), t if defined else math.inf)

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange, with their own memory."""
        raise NotImplementedError

    def _mode_call(self, name: str) -> Call:
        return self.function(name), (self.instance_argument,)

    def enter_event_mode(self) -> None:
        """Enter Event Mode."""
        self.fmu.enterEventMode()

    def enter_continuous_time_mode(self) -> None:
        """Enter Continuous-Time Mode."""
        self.fmu.enterContinuousTimeMode()

    def state_derivatives(self, n: int) -> np.ndarray:
        """Return the derivatives of the n continuous states, in the FMU's order."""
        made, name = (ctypes.c_double * n)(), self.table.exchange["derivatives"]
        getattr(self.fmu, name[0].lower() + name[1:])(made, n)
        return np.array(made)

    # ---- messages ----

    def status_name(self, code: int) -> str:
        """Return the name of a status (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3), such as ``fmi3Discard``."""
        known = STATUS if self.prefix == "fmi2" else STATUS[:PENDING]
        code = ctypes.c_int(code).value
        return f"{self.prefix}{known[code].capitalize()}" if 0 <= code < len(known) else f"status {code}"
