"""Library of an FMU in a child process, in the place of the one that ctypes loads into this process."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..isolation import ChildProcess, Isolation
from .bound_calls import ERROR

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
