"""Plants that the loop in C does not call itself: it asks the processes of FMUs for steps, or Python."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np

from ...blocks.called_back import CalledBack
from ...blocks.core import LoopwrightError
from ...fmus.calls import ERROR, BoundCalls, QuietStep, RemoteStep, SharedValues
from ...fmus.isolation import ChildProcess, ChildRequest
from .bound_functions import at
from .compiled_libraries import load_runtime

UNDER_WAY, REFUSED, TAKEN_BY_PYTHON = 3, 4, 5
"""Stages at which such an FMU is left to Python: its step has begun; no step has, as an input doesn't fit; Python has
taken it, and the loop can't continue."""
_KINDS = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "b1")
_FEWEST = 4  # `wire.FEWEST`
_IDLE, _POSTED, _ARRIVED = range(3)

PythonStep = Callable[[float, float], bool]
"""A step of a plant from t over h, both in s; returns whether the plant asks for the end of the run."""


def compile_other_side() -> str | None:
    """Return the file of the library that makes the calls in the other process; None where it can't be compiled."""
    try:
        return load_runtime()._name
    except LoopwrightError:
        return None


class _Values(ctypes.Structure):
    _fields_ = [
        ("kind", ctypes.c_int64),
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("index", "vector", "shared", "low", "high")),
    ]


class RemoteStructure(ctypes.Structure):
    """The requests to one process, as C knows them."""

    _fields_ = [
        ("words", ctypes.c_void_p),
        ("sequence", ctypes.c_uint64),
        ("number", ctypes.c_uint64),
        *((name, ctypes.c_int32) for name in ("commands", "replies", "ordered", "state")),
        *((name, ctypes.c_int64) for name in ("most", "looks", "left", "pause", "row", "inputs", "outputs")),
        ("to", ctypes.c_void_p),
        ("from", ctypes.c_void_p),
    ]


class _Quiet(ctypes.Structure):
    _fields_ = [
        ("until", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("watched", "sloped")),
        *((name, ctypes.c_void_p) for name in ("vector", "watched_index", "sloped_index", "taken", "last", "line")),
        *((name, ctypes.c_void_p) for name in ("slopes", "event", "changed", "added")),
    ]


class _Apart(ctypes.Structure):
    _fields_ = [("until", ctypes.c_int64), ("late", ctypes.c_int64)]


class RemotePlants:
    """The FMUs of a loop that are in their own processes, or that Python steps."""

    def __init__(self) -> None:
        self.structure = _Apart()
        self._all: list[tuple[ChildProcess, RemoteStructure]] = []
        self._kept: list[Any] = []
        self.by_python: PythonSteps | None = None
        """Steps that Python takes; None if there are none."""

    @property
    def address(self) -> int | None:
        """Address of what they have in common; None if there are none."""
        return ctypes.addressof(self.structure) if self._all or self.by_python else None

    def add(self, step: RemoteStep) -> int:
        """Take an FMU, and return the address of its structure."""
        made = self.add_calls(step.request)
        made.inputs, made.outputs, made.to = len(step.inputs), len(step.outputs), self._values(step.inputs)
        setattr(made, "from", self._values(step.outputs))
        self._kept.append(step)
        return ctypes.addressof(made)

    def add_quiet(self, quiet: QuietStep) -> int:
        """Take what says when C takes a step that may be more than its calls, and return its address."""
        watched, sloped = (np.ascontiguousarray(v, dtype=np.int64) for v in (quiet.watched, quiet.sloped))
        line = None if quiet.line is None else at(quiet.line)
        behind = quiet.slopes if quiet.line is None else quiet.line[2 + sloped.size :]
        slopes = None if behind is None else at(behind)
        made = _Quiet(
            at(quiet.until),
            watched.size,
            sloped.size,
            at(quiet.vector),
            at(watched),
            at(sloped),
            at(quiet.taken),
            at(quiet.last),
            line,
            slopes,
            quiet.event or None,
            quiet.changed or None,
            None if quiet.added is None else at(quiet.added),
        )
        self._kept += [quiet, watched, sloped, made]
        return ctypes.addressof(made)

    def add_python(self, place: int, step: PythonStep, far: int | None) -> int:
        """Let Python take the steps of a plant, and return the address for C; ``far`` is its structure, or None."""
        if self.by_python is None:
            self.by_python = PythonSteps()
        found = next(((p, r) for p, r in self._all if ctypes.addressof(r) == far), None)
        self.by_python.add(place, step, found)
        return self.by_python.step

    def has_begun(self, structure: int | None) -> bool:
        """Whether C has asked a process for a step whose end Python has to see to."""
        return any(ctypes.addressof(made) == structure and made.state != _IDLE for _, made in self._all)

    def add_calls(self, asked: ChildRequest) -> RemoteStructure:
        """Take a process that is asked for calls, and return its structure, which lives as long as this."""
        if (library := compile_other_side()) is not None:
            asked.process.run_in_c(library)
        made = RemoteStructure(
            words=asked.words,
            sequence=asked.sequence,
            commands=asked.commands,
            replies=asked.replies,
            ordered=asked.ordered,
            most=asked.looks,
            left=_FEWEST,
            pause=_FEWEST,
        )
        self._all.append((asked.process, made))
        return made

    def lent(self, structure: RemoteStructure | None) -> AbstractContextManager[None]:
        """Let Python ask a process while C waits."""
        return _lend(next((both for both in self._all if both[1] is structure), None))

    def note_status(self, structure: RemoteStructure | None, status: int) -> None:
        """Note the status of a call that has failed: no other instance is made in a process after an error."""
        for process, made in self._all:
            process.used = process.used or (made is structure and not 0 <= status < ERROR)

    def take_messages(self) -> None:
        """Take the log messages of the processes."""
        for process, _ in self._all:
            if process.alive:
                process.collect()

    def _values(self, values: Sequence[SharedValues]) -> int:
        array = (_Values * max(1, len(values)))()
        for place, one in zip(array, values, strict=False):
            index, low, high = (None if v is None else np.ascontiguousarray(v) for v in (one.index, one.low, one.high))
            self._kept += [index, low, high]
            place.kind, place.count = _KINDS.index(one.shared.dtype.str[1:]), one.shared.size
            place.vector, place.shared = at(one.vector), at(one.shared)
            place.index, place.low, place.high = (None if v is None else at(v) for v in (index, low, high))
        self._kept.append(array)
        return ctypes.addressof(array)

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Let C make the requests meanwhile."""
        self.structure.until = self.structure.late = 0
        for process, structure in self._all:
            process.check_alive("its next step")
            structure.number, structure.state = process.number, _IDLE
        try:
            yield
        except BaseException:  # an interrupt: replies are still to come
            for process, structure in self._all:
                process.number = structure.number
                if structure.state != _IDLE:
                    process.give_up()
            raise
        for process, structure in self._all:
            process.number, process.arrived = structure.number, structure.state == _ARRIVED


@contextmanager
def _lend(far: tuple[ChildProcess, RemoteStructure] | None) -> Iterator[None]:
    """Let Python make the requests to a process meanwhile: it numbers them on."""
    if far is None:
        yield
        return
    process, structure = far
    process.number = structure.number
    try:
        yield
    finally:
        structure.number = process.number


_STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64, ctypes.c_double, ctypes.c_double)


class PythonSteps(CalledBack):
    """Steps of plants that Python takes at the request of C: ``step`` returns 1 if C can't continue from there."""

    def __init__(self) -> None:
        super().__init__()
        self._steps: dict[int, tuple[PythonStep, tuple[ChildProcess, RemoteStructure] | None]] = {}
        self.step = self.function(_STEP, self._take, 1)

    def add(self, place: int, step: PythonStep, far: tuple[ChildProcess, RemoteStructure] | None) -> None:
        """Take the steps of a plant, and the requests to its process that are C's in other steps."""
        self._steps[place] = step, far

    def _take(self, place: int, t: float, h: float) -> int:
        step, far = self._steps[place]
        with _lend(far):
            return int(step(t, h))


_WAIT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64)


class LateReplies(CalledBack):
    """Python's wait for replies that C has not seen in time: the process is slow, or hangs, or has ended.

    ``wait`` is the address of the function by which C asks for a reply; it returns 0 if it never comes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked: dict[int, tuple[RemoteStructure, dict[int, BoundCalls]]] = {}
        self.wait = self.function(_WAIT, self._wait, interrupted=self._give_up)

    def add(self, place: int, structure: RemoteStructure, sequence: int, calls: BoundCalls) -> None:
        """Take calls that C will ask for."""
        self._asked.setdefault(place, (structure, {}))[1][sequence] = calls

    def _wait(self, place: int) -> int:
        calls, process = self._find(place)
        process.number = self._asked[place][0].number
        calls.finish()
        return 1

    def _give_up(self, place: int) -> None:
        """End a process at an interrupt before the wait; one within the wait ends it there."""
        self._find(place)[1].give_up()

    def _find(self, place: int) -> tuple[BoundCalls, ChildProcess]:
        structure, asked = self._asked[place]
        calls = asked[structure.sequence]
        assert calls.request is not None
        return calls, calls.request.process
