"""Calls of FMI with the library in a child process, in the place of the one that ctypes loads into this process."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import FmuError
from ..isolation import WATCH_TEXTS, ChildProcess, ChildRequest, Isolation, describe_memory, give_back
from .bound_calls import ERROR, WARNING, BoundCalls, Call
from .fmi_calls import FmiCalls, Log, call_error_type
from .library_functions import LibraryFunctions, exported_name, list_prototypes


class RemoteBoundCalls(BoundCalls):
    """C functions in a child with their arguments in shared memory: one round trip runs them all."""

    def __init__(self, process: ChildProcess, calls: Sequence[Call], limits: Isolation):
        super().__init__(calls)
        described, blobs, names = [], [], [function.name for function, _ in calls]  # type: ignore[attr-defined]
        for name, (_, arguments) in zip(names, calls, strict=True):
            call, constants = describe_call(process, name, arguments)
            described.append(call)
            blobs += constants
        self._process = process
        self._seconds = sum(seconds_for(name, limits) for name in dict.fromkeys(names) if "DoStep" in name) or (
            max((seconds_for(name, limits) for name in names), default=limits.step_time)
        )
        self._sequence = process.bind(described, blobs, limits.step_time)

    def run(self) -> int:
        """Run them and return the status; see `BoundCalls`."""
        self._process.post(self._sequence)
        return self.finish()

    def start(self) -> None:
        """Let the child begin."""
        self._process.post(self._sequence)

    def finish(self) -> int:
        """Wait for the child, and return the status."""
        process = self._process
        status = process.collect() if process.arrived else process.finish(self._sequence, self._seconds)
        return self._note(status) if status else 0

    @property
    def request(self) -> ChildRequest | None:
        """The calls as a request to the child; None where C can't sleep for its reply."""
        return self._process.request_of(self._sequence)

    def _note(self, status: int) -> int:
        if status == WARNING:
            self.warned = self._process.failed_place
            return status
        if status >= ERROR:
            self._process.used = True
        self.failed = self._process.failed_place
        return status


class RemoteWatch:
    """The child's own function among bound calls that notes whether texts have changed; it is bound, never called."""

    name = WATCH_TEXTS

    def __call__(self, *arguments: object) -> int:
        """Refuse."""
        raise NotImplementedError("the child alone calls it, among bound calls")


class RemoteCalls(FmiCalls):
    """Part of the calls that differs where the library is in a child; the other base is a version's calls."""

    in_process = False
    text_watch = staticmethod(RemoteWatch())

    def __init__(self, *, process: ChildProcess, limits: Isolation, library: Path, **arguments: Any):
        """Load a library in a child; the others are arguments of `FmiCalls`."""
        self.process, self.limits, self.patience = process, limits, limits.step_time
        self._path, self._unloaded = library, False
        self._freed: deque[Any] = deque()
        super().__init__(library=library, **arguments)

    def _open(self, kind: Any, required: tuple[str, ...], **arguments: Any) -> Any:
        """Return an object of FMPy's class whose library is in the child."""
        process, limits, path, prefix = self.process, self.limits, self._path, self.prefix

        def initialize(fmu: Any, **given: Any) -> None:
            fmu.guid, fmu.modelIdentifier = given["guid"], given["modelIdentifier"]
            fmu.unzipDirectory, fmu.instanceName = given["unzipDirectory"], given["instanceName"]
            fmu.fmiCallLogger, fmu.requireFunctions = None, True
            names = [name for name, *_ in list_prototypes(kind, prefix)]
            shown = [exported_name(name, prefix, given["modelIdentifier"]) for name in names]
            fmu.dll = RemoteLibrary(process, path, shown, limits)
            fmu._functions = LibraryFunctions(fmu.dll, kind, prefix, given["modelIdentifier"], required)
            fmu.component = fmu.callbacks = None

        def unload(fmu: Any) -> None:
            process.used = process.used or bool(fmu.dll.unload())
            self._unloaded = True

        return type(kind.__name__, (kind,), {"__init__": initialize, "freeLibrary": unload})(**arguments)

    def function(self, name: str) -> Callable[..., int]:
        """Return a C function of the child by its name without prefix."""
        return self.fmu.dll[self.exported(f"{self.prefix}{name}")]  # type: ignore[no-any-return]

    def instantiate(self, log: Log) -> None:
        """Make the instance; its messages go to ``log``."""
        self.process.take_message, self.process.lose = log, self.lose
        super().instantiate(log)  # type: ignore[safe-super]
        if self.process.find(self.fmu.component) is not None:  # an address there that is shared memory here
            raise FmuError(
                "its instance has an address that is also one of shared memory; expected another. Run it again."
            )

    def renew(self, log: Log, running: bool) -> None:
        """Free the instance and make another one, to which C in the child is bound, too; see `FmiCalls.renew`."""
        self._free_states()
        super().renew(log, running)
        self.process.bind_in_c_again()

    def allocate(self, n: int, ctype: type[Any]) -> np.ndarray:
        """Return an array (n,) of zeros of a C type in the shared memory."""
        return self.process.array(n, ctype)

    def variable(self, ctype: type[Any]) -> Any:
        """Return a C value, array or structure in the shared memory."""
        return self.process.value(ctype)

    def bind(self, calls: Sequence[Call]) -> BoundCalls:
        """Bind functions of the library to their arguments: one round trip runs them all."""
        return RemoteBoundCalls(self.process, calls, self.limits)

    def free_instance(self) -> None:
        """Free the instance and unload the library."""
        self._free_states()
        super().free_instance()

    def free_state(self, handle: Any) -> None:
        """Free a saved state before the next one is saved; Python may ask for it at any time, in a step too."""
        self._freed.append(handle)

    def save_state(self) -> Any:
        """Return the handle of a copy of the instance's memory, in the child."""
        self._free_states()
        return super().save_state()

    def _free_states(self) -> None:
        """Free the states that wait for it, as long as their instance is there."""
        while self._freed:
            with suppress(call_error_type()):
                super().free_state(self._freed.popleft())

    def get_binaries(self, references: Sequence[int], size: int) -> list[bytes]:
        """Return binary data, which the child reads at the addresses that the FMU gives."""
        sizes, addresses = (ctypes.c_size_t * size)(), (ctypes.c_void_p * size)()
        kept = (ctypes.c_uint * len(references))(*references)
        self.fmu.fmi3GetBinary(self.fmu.component, kept, len(references), sizes, addresses, size)
        pieces = [(address or 0, n) for address, n in zip(addresses, sizes, strict=True)]
        return self.process.request("bytes", pieces, call="fmi3GetBinary", seconds=self.limits.step_time)[1]

    def set_binaries(self, references: Sequence[int], values: Sequence[bytes]) -> None:
        """Set binary data, from memory of the child."""
        arguments = [self.fmu.component, list(references), [len(v) for v in values]]
        status = self.process.request(
            "set_bytes",
            "fmi3SetBinary",
            arguments,
            blobs=list(values),
            call="fmi3SetBinary",
            seconds=self.limits.step_time,
        )[0]
        if status > WARNING:
            raise call_error_type()("fmi3SetBinary", status)

    def _follow(self, line: np.ndarray, references: Sequence[int], n: int) -> None:
        """Let the child set inputs from a line when the FMU asks for that; see `Fmi3Calls.slope_line`."""
        place, instance = (self.process.find(at) for at in (line.ctypes.data, ctypes.addressof(self.instance_argument)))
        seconds = self.limits.step_time
        self.process.request("follow", place, list(references), n, instance, call="fmi3SetFloat64", seconds=seconds)

    def read_printed(self) -> list[str]:
        """Return the last lines that the FMU has written to its standard output in this process's hold of it."""
        return self.process.read_printed()

    def describe_memory(self) -> str:
        """Return a sentence if the process has nearly as much memory as it may have, else an empty text."""
        return describe_memory(self.process.pid, self.process.memory_limit)

    def end(self) -> None:
        """Keep the process for another instance, or end it."""
        give_back(self.process, self._unloaded)


# --- the library ------------------------------------------------------------------------------------------------------


_FUNCTION: Any = ctypes._CFuncPtr  # type: ignore[attr-defined]
_CALLBACKS = {"fmi1CallbackFunctions": 1, "fmi2CallbackFunctions": 2}
_UPDATE, _UPDATE_ARGUMENTS = 4, 8
"""Callback of FMI 3.0 that sets inputs within a step, as the child counts them, and its number of arguments."""
_EARLY = ("nstantiate", "Initialize", "Initialization", "SetupExperiment", "ConfigurationMode")


def seconds_for(name: str, limits: Isolation) -> float:
    """Return the longest time of a call in s."""
    return limits.start_time if any(part in name for part in _EARLY) else limits.step_time


class RemoteLibrary:
    """Functions of a library in a child, as attributes; they take what ctypes' functions take."""

    def __init__(self, process: ChildProcess, path: Path, names: Sequence[str], limits: Isolation):
        self._process, self._limits = process, limits
        found = process.request("load", str(path), list(names), call="loading its library", seconds=limits.start_time)[
            0
        ]
        self._names = dict.fromkeys(names, False) | dict.fromkeys(found, True)

    def __getattr__(self, name: str) -> RemoteFunction:
        if name.startswith("__"):
            raise AttributeError(name)
        function = self[name]
        setattr(self, name, function)
        return function

    def __getitem__(self, name: str) -> RemoteFunction:
        if name not in self._names:
            answer = self._process.request("has", name, call=f"looking for {name}", seconds=self._limits.step_time)
            self._names[name] = answer[0]
        if not self._names[name]:
            raise AttributeError(f"the library has no function {name}")
        return RemoteFunction(self._process, name, seconds_for(name, self._limits))

    def unload(self) -> list[str]:
        """Unload the library, and return traces that the FMU has left in its process."""
        found: list[str] = self._process.request("unload", call="unloading it", seconds=self._limits.step_time)[0]
        return found


class RemoteFunction:
    """A C function in a child. Arrays and values by reference are copied there and back."""

    def __init__(self, process: ChildProcess, name: str, seconds: float):
        self.process, self.name, self.seconds = process, name, seconds
        self.restype: Any = ctypes.c_int
        self.argtypes: Sequence[Any] = ()
        self.argnames: Sequence[str] = ()

    def __call__(self, *arguments: Any) -> Any:
        """Call the function, and return its result."""
        types = [*self.argtypes, *([None] * (len(arguments) - len(self.argtypes)))]
        sent: list[Any] = []
        blobs: list[bytes] = []
        buffers: list[Any] = []
        texts: list[Any] = []
        for value, type_ in zip(arguments, types, strict=True):
            held = _held(value)
            place = _shared_place(self.process, value, held)
            if place is not None:
                sent.append(("shared", place))
            elif isinstance(held, ctypes.Array) and held._type_ is ctypes.c_char_p:
                texts.append(held)
                sent.append(("texts", [_text(v) for v in held]))
            elif isinstance(held, ctypes.Structure) and type(held).__name__ in _CALLBACKS:
                sent.append(("callbacks", _CALLBACKS[type(held).__name__]))
            elif isinstance(held, _FUNCTION):
                kind = _UPDATE if len(held._argtypes_) == _UPDATE_ARGUMENTS else 3
                sent.append(("callbacks", kind) if held else ("P", None))
            elif held is not None and (held is not value or isinstance(held, ctypes.Array | ctypes.Structure)):
                blobs.append(bytes(held))
                buffers.append(held)
                sent.append(("buffer", None))
            else:
                sent.append(_scalar(value, type_))
        result = "" if self.restype is None else self.restype._type_
        (found, left), data = self.process.request(
            "call", self.name, result, sent, blobs=blobs, call=self.name, seconds=self.seconds
        )
        for buffer, raw in zip(buffers, data, strict=True):
            ctypes.memmove(ctypes.addressof(buffer), raw, len(raw))
        for array, values in zip(texts, left, strict=True):
            for i, text in enumerate(values):
                array[i] = None if text is None else text.encode("latin-1")
        if self.restype is ctypes.c_int and found >= ERROR:
            self.process.used = True
        return found.encode("latin-1") if result == "z" and found is not None else found


def _held(value: Any) -> Any:
    """Return the C object that a pointer points to, itself if it is one with its own memory, else None."""
    if hasattr(value, "_obj"):  # byref
        return value._obj
    if isinstance(value, ctypes._Pointer):  # of a cast: it keeps the array whose size it has lost
        address = ctypes.cast(value, ctypes.c_void_p).value
        for kept in (value._objects or {}).values():
            if isinstance(kept, ctypes.Array) and ctypes.addressof(kept) == address:
                return kept
        return value.contents if value else None
    return value if isinstance(value, ctypes.Array | ctypes.Structure | _FUNCTION) else None


def _shared_place(process: ChildProcess, value: Any, held: Any) -> int | None:
    """Return the place in shared memory that an argument points to; None if it points elsewhere."""
    if held is not None and not isinstance(held, _FUNCTION):
        return process.find(ctypes.addressof(held))
    return process.find(value.value) if isinstance(value, ctypes.c_void_p) and value.value else None


def _scalar(value: Any, type_: Any) -> tuple[str, Any]:
    """Return type and value of an argument that is passed by value."""
    if isinstance(value, ctypes._SimpleCData):
        type_, value = type(value), value.value
    kind = getattr(type_, "_type_", None)
    if value is None or not isinstance(kind, str):  # no declared type: that of Python's value, as ctypes takes it
        kind = "z" if isinstance(value, bytes) else "d" if isinstance(value, float) else "P" if value is None else "i"
    if kind in "Pz" and not isinstance(value, bytes):
        kind = "P"
    return kind, _text(value) if isinstance(value, bytes) else value


def _text(value: bytes | None) -> str | None:
    return None if value is None else value.decode("latin-1")


def describe_call(process: ChildProcess, name: str, arguments: Sequence[Any]) -> tuple[list[Any], list[bytes]]:
    """Return a call of a bound sequence, as the child takes it, with the bytes of its constants."""
    sent: list[Any] = []
    blobs: list[bytes] = []
    for value in arguments:
        held = _held(value)
        place = _shared_place(process, value, held)
        if place is not None:
            sent.append(("shared", place))
        elif held is not None:
            blobs.append(bytes(held))
            sent.append(("constant", None))
        elif isinstance(value, ctypes._SimpleCData):
            kind: str = type(value)._type_  # type: ignore[attr-defined]
            live = process.find(ctypes.addressof(value))
            sent.append((kind, value.value) if live is None else ("live", [kind, live]))
        else:
            raise TypeError(f"found {value!r} as an argument of {name}; expected a C value")
    return [name, sent], blobs
