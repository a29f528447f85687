"""The face that both versions of FMI show to an instance: what differs between them is behind it."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from ...blocks.core import FmuProcessError
from .bound_calls import (
    DISCARD,
    ERROR,
    FATAL,
    PENDING,
    STATUS,
    WARNING,
    BoundCalls,
    Call,
    EventCalls,
    EventUpdate,
    allow_missing,
    exported_name,
)

__all__ = ["DISCARD", "ERROR", "FATAL", "PENDING", "STATUS", "WARNING", "FmiCalls"]

MOST_ROUNDS = 100
"""Rounds of an event iteration before an error."""
Log = Callable[[int, str], None]
"""Takes the status and the text of a message."""
C = TypeVar("C")


@dataclass(frozen=True)
class TypeCalls:
    """Functions that get and set variables of a type, and the C type of their values."""

    suffix: str
    """End of the functions' names, such as ``Float64``."""
    ctype: type[Any]


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
    """Functions of an FMU's library for one instance.

    Functions that fail raise an error of FMPy, with a ``status``; those that are not called at each step are methods.

    Attributes
    ----------
    fmu : object
        FMPy's object for the library.
    """

    prefix: ClassVar[str]  # of the names of functions and statuses: ``fmi2``, say
    types: ClassVar[dict[str, TypeCalls]]
    """Functions by type, as FMI 3.0 names types."""
    fmu: Any
    freeing = "FreeInstance"  # end of the name of the function that frees an instance
    patience: float = 60.0
    """Longest time in s for which a step may be pending."""

    @abstractmethod
    def __init__(self, *, name: str, token: str, folder: Path, library: Path, model_exchange: bool):
        """Load a library, of an FMU that is unpacked into a folder; a name is given to the instance."""

    def _open(self, kind: Any, required: tuple[str, ...], **arguments: Any) -> Any:
        """Return an object of FMPy's class, with its library loaded; see `allow_missing`."""
        return allow_missing(kind, self.prefix, required)(**arguments)

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

    event_mode_used = False
    """Whether the FMU is told that its events are handled in Event Mode; set it before `instantiate`."""
    early_return_allowed = False
    """Whether the FMU is told that it may end a step early; set it before `instantiate`."""
    intermediate_inputs: tuple[int, ...] = ()
    """Value references of inputs that are set within a step (FMI 3.0, 4.2.2); set them before `instantiate`."""
    intermediate_status: int = 0
    """Worst status of setting them."""

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

        Calls that are bound to the old one can't be used any more.
        """
        if running:
            self.terminate()
        getattr(self.fmu, f"{self.prefix}{self.freeing}")(self.fmu.component)
        self.instantiate(log)

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
        return f"{self.prefix}{function}" in self.fmu.missing_functions

    # ---- values ----

    def get(self, type_: str, references: Sequence[int], size: int) -> list[Any]:
        """Return the values of variables of one type."""
        return self._get(self.types[type_].suffix, list(references), size)

    def set(self, type_: str, references: Sequence[int], values: Sequence[Any]) -> None:
        """Set the values of variables of one type."""
        getattr(self.fmu, f"set{self.types[type_].suffix}")(list(references), list(values))

    def get_texts(self, references: Sequence[int], size: int) -> list[str]:
        """Return the elements of variables that are texts."""
        values = (ctypes.c_char_p * size)()
        self._call_with_values("GetString", references, size, values)
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

    def _call_with_values(self, name: str, references: Sequence[int], size: int, values: Any) -> None:
        """Call a function of FMPy's object that takes references and values."""
        kept = (ctypes.c_uint * len(references))(*references)
        length = (size,) if self.prefix == "fmi3" else ()
        getattr(self.fmu, f"{self.prefix}{name}")(self.fmu.component, kept, len(references), values, *length)

    def enter_configuration_mode(self) -> None:
        """Enter Configuration Mode, in which structural parameters are set (FMI 3.0, 2.3.4)."""
        self.fmu.enterConfigurationMode()

    def exit_configuration_mode(self) -> None:
        """Leave Configuration Mode."""
        self.fmu.exitConfigurationMode()

    @abstractmethod
    def _get(self, suffix: str, references: list[int], size: int) -> list[Any]:
        """Return values by the function with this suffix."""

    def value_function(self, verb: str, type_: str) -> Callable[..., int]:
        """Return the C function that gets or sets values of a type; it takes `value_arguments`."""
        return self._function(f"{self.prefix}{verb}{self.types[type_].suffix}")

    @abstractmethod
    def value_arguments(self, references: Any, count: int, address: int, size: int) -> tuple[Any, ...]:
        """Return the arguments of a `value_function`: a C array of references, and the address of the values."""

    def exported(self, name: str) -> str:
        """Return the name that the library gives to a function."""
        return exported_name(name, self.prefix, self.fmu.modelIdentifier)

    text_watch: Callable[..., int] | None = None
    """Function for bound calls that notes whether texts have changed; None in this process, where they are read."""

    def slope_line(self, references: Sequence[int], n: int) -> np.ndarray | None:
        """Return where inputs' lines within a step stand in memory; None where `set_input_slopes` calls a function."""
        return None

    def function(self, name: str) -> Callable[..., int]:
        """Return a C function by its name without prefix, for bound calls."""
        return self._function(f"{self.prefix}{name}")

    def _function(self, name: str) -> Callable[..., int]:
        """Return a C function without declared arguments, which takes those that are made for it.

        Its status is unsigned, so that a negative one, which the standard doesn't have, is no success.
        """
        function = self.fmu.dll[self.exported(name)]
        function.restype = ctypes.c_uint
        if self._after is not None:
            function.errcheck = self._after
        return function  # type: ignore[no-any-return]

    _after: Callable[..., Any] | None = None

    def settle_by(self, after: Callable[..., Any]) -> None:
        """Let ctypes call a function after each function of the library, with what that has returned."""
        self._after = after
        for function in self.fmu._functions.values():
            function.errcheck = after

    # ---- steps ----

    @property
    @abstractmethod
    def final(self) -> Any:
        """The flag noSetFMUStatePriorToCurrentPoint, as a C value that can be changed."""

    @abstractmethod
    def step_call(self, now: ctypes.c_double, width: ctypes.c_double, final: Any) -> StepCall:
        """Return the function that takes a step from ``now`` over ``width``, both in s."""

    @abstractmethod
    def end_step(self, status: int) -> tuple[int, bool]:
        """Return the status with which a step has ended, and whether the FMU asks to end the simulation.

        It waits for a step that is pending.
        """

    @abstractmethod
    def do_step(self, t: float, h: float, final: bool) -> bool:
        """Take a step from t over h, both in s; return whether it ended early or asks to end the simulation."""

    def time_after_discard(self, t: float, h: float) -> float | None:
        """Return the time in s at which the FMU stands after a step from t over h was discarded; None if unknown."""
        return t

    def set_input_slopes(
        self, t: float, references: Sequence[int], inputs: Sequence[float], slopes: Sequence[float]
    ) -> None:
        """Let real inputs go on from their elements' values at t, in s, with slopes within the step from there."""
        self.fmu.setRealInputDerivatives(list(references), [1] * len(references), list(slopes))

    def enter_step_mode(self) -> None:
        """Go back from Event Mode to Step Mode (FMI 3.0, 4.2.1)."""
        self.fmu.enterStepMode()

    def settle_events(self) -> None:
        """Go through the event iteration of an FMU in Event Mode, and back to Step Mode.

        Raises
        ------
        RuntimeError
            If it does not end.
        """
        for _ in range(MOST_ROUNDS):
            if not self.update_discrete_states():
                self.enter_step_mode()
                return
        raise RuntimeError(f"the events don't settle in {MOST_ROUNDS} rounds")

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

    @abstractmethod
    def directional_derivative(
        self, unknowns: Sequence[int], knowns: Sequence[int], seed: Sequence[float], size: int
    ) -> list[float]:
        """Return the change of unknowns by a change of knowns, by their references."""

    # ---- model exchange ----

    exchange_names: ClassVar[dict[str, str]]
    """Ends of the names of the functions of model exchange that each evaluation calls."""

    def exchange_function(self, name: str) -> Callable[..., int]:
        """Return the C function "set_time", which takes the instance and a time, or one of vectors of float64.

        These take instance, address and length: "set_states", "get_states", "derivatives", "indicators", "nominals".
        """
        return self._function(f"{self.prefix}{self.exchange_names[name]}")

    @property
    def instance_argument(self) -> ctypes.c_void_p:
        """The instance, as an argument of C functions."""
        return ctypes.c_void_p(self.fmu.component)

    @abstractmethod
    def update_discrete_states(self) -> bool:
        """Take a round of the event iteration; return whether another one is needed."""

    @abstractmethod
    def update_events(self) -> EventUpdate:
        """Take a round of the event iteration, and return what it says."""

    def event_calls(self) -> EventCalls:
        """Return the functions of events in model exchange, with memory of their own."""
        raise NotImplementedError

    def _mode_call(self, name: str) -> Call:
        return self._function(f"{self.prefix}{name}"), (self.instance_argument,)

    def enter_event_mode(self) -> None:
        """Enter Event Mode."""
        self.fmu.enterEventMode()

    def enter_continuous_time_mode(self) -> None:
        """Enter Continuous-Time Mode."""
        self.fmu.enterContinuousTimeMode()

    def set_continuous_states(self, x: np.ndarray) -> None:
        """Set all continuous states, in the FMU's order."""
        self.fmu.setContinuousStates((ctypes.c_double * x.size)(*x), x.size)

    def state_derivatives(self, n: int) -> np.ndarray:
        """Return the derivatives of the n continuous states, in the FMU's order."""
        made, name = (ctypes.c_double * n)(), self.exchange_names["derivatives"]
        getattr(self.fmu, name[0].lower() + name[1:])(made, n)
        return np.array(made)

    # ---- messages ----

    def status_name(self, code: int) -> str:
        """Return the name of a status (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3), such as ``fmi3Discard``."""
        known = STATUS if self.prefix == "fmi2" else STATUS[:PENDING]
        code = ctypes.c_int(code).value
        return f"{self.prefix}{known[code].capitalize()}" if 0 <= code < len(known) else f"status {code}"
