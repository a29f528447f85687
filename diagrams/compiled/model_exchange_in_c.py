"""Blocks in model exchange as C evaluates them, between the traced stages of a diagram's functions."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np

from ...blocks.called_back import CalledBack
from ...blocks.core import EvaluationVectors
from ...fmus.calls import BoundCalls, ModelExchangeInstance, NativeAction, NativeLook
from ...fmus.host_state import HostState
from ..flat import JUMP, OpaqueStage
from ..model_exchange import OWN_EVENTS
from .bound_functions import CALL, MemoryForC, TickStructure, at, fields_of
from .plants_called_back import LateReplies, RemotePlants

_LOGGED = 2**20  # bytes of events in a call
_TO_STEP, _FAILED_IN_PYTHON = 0, 2
_INT, _REAL, _AT = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Action(ctypes.Structure):
    _fields_ = [
        *fields_of(_INT, "kind count"),
        ("function", _AT),
        ("arguments", ctypes.c_uint64 * 8),
        *fields_of(_AT, "vector index buffer"),
        ("type", _INT),
        *fields_of(_REAL, "low high"),
        ("warned_at", _AT),
    ]


class _ActionsInC(ctypes.Structure):
    _fields_ = [("count", _INT), ("actions", _AT)]


class _Exchanged(ctypes.Structure):
    _fields_ = [
        ("of", _AT),
        *fields_of(_INT, "place states inputs events first"),
        *fields_of(_ActionsInC, "complete enter update leave"),
        *fields_of(_AT, "again terminate nominals defined wants ends time"),
        *fields_of(_INT, "width again_where"),
        *fields_of(_AT, "u least relative low high discrete"),
        ("next_time", _REAL),
        *fields_of(_INT, "asks ended in_event"),
        ("end", _REAL),
        *fields_of(_INT, "other_nominals acted event by_python"),
        *fields_of(_AT, "changed far"),
    ]


class _ModelExchange(ctypes.Structure):
    _fields_ = [
        ("count", _INT),
        ("each", _AT),
        ("jump", TickStructure),
        *fields_of(_INT, "look lost failed plant"),
        ("action", _AT),
        *fields_of(_INT, "call status"),
        ("at", _REAL),
        ("log", _AT),
        *fields_of(_INT, "logged capacity warned"),
        ("apart", _AT),
        ("wait", ctypes.c_void_p),
    ]


class StageStructure(ctypes.Structure):
    """A stage of a schedule, as C knows it: a traced function, or a block that an evaluator evaluates."""

    _fields_ = [
        ("f", TickStructure),
        ("fmu", _AT),
        ("looks", _INT),
        ("calls", _ActionsInC),
        ("by_python", _AT),
        *fields_of(_AT, "t x u into"),
        ("made", _INT),
    ]


class OwnEvent(NamedTuple):
    """An event that a block has had by itself: its time in s, block and name, and the states before and after it."""

    t: float
    path: str
    name: str
    before: np.ndarray
    after: np.ndarray


class CallFailure(NamedTuple):
    """A call that has failed: its block, its name (empty for an event without end), its status and its time in s."""

    path: str
    action: str
    status: int
    t: float


def find_obstacle(block: Any) -> str | None:
    """Return why C can't evaluate a block by itself, so that Python does for it; None if it can."""
    return block.find_native_obstacle() if hasattr(block, "find_native_obstacle") else "is evaluated by Python"


class NativeModelExchange:
    """Blocks in model exchange, as C knows them in a run; ``first`` is where the states of each begin among all.

    ``by_python`` returns, for a stage and its vectors, the function that does for C what it can't.
    """

    def __init__(
        self,
        blocks: Mapping[str, ModelExchangeInstance],
        first: Mapping[str, int],
        width: int,
        by_python: Callable[[OpaqueStage, EvaluationVectors], Callable[[], int]],
    ):
        self._blocks, self._width, self._memory, self._by_python = blocks, width, MemoryForC(), by_python
        self.called = CalledBack()
        """Calls of Python, with the error that has ended a run."""
        self.paths = [*blocks]
        self._each = (_Exchanged * len(blocks))()
        self._names = dict[int, tuple[str, ...]]()
        """Names of calls by the address of their action."""
        self._actions = list[tuple[str, ctypes.Array[_Action], list[NativeAction]]]()
        self._warned = list[tuple[str, tuple[str, ...], np.ndarray]]()
        self.remote, self._late, self._far = RemotePlants(), LateReplies(), dict[str, Any]()
        self.watched: list[tuple[HostState, ctypes.c_bool]] = []
        """States of this process that libraries may change, and whether C has seen that."""
        self._log = np.zeros((max(4 * len(blocks), _LOGGED // (16 * (1 + width))), 2 + 2 * width))
        self.structure = _ModelExchange(
            count=len(blocks),
            each=ctypes.addressof(self._each),
            log=at(self._log),
            capacity=len(self._log),
            apart=ctypes.addressof(self.remote.structure),
            wait=self._late.wait,
        )
        for i, (path, block) in enumerate(blocks.items()):
            e = self._each[i]
            e.of, e.place, e.first, e.next_time = ctypes.addressof(self.structure), i, first[path], np.inf
            # Such a block has no functions that C could call; Python evaluates it, and its structure stays empty.
            e.by_python = find_obstacle(block) is not None
            if e.by_python:
                continue
            if (host := block.native_host) is not None:
                self.watched.append((host, ctypes.c_bool()))
                e.changed = ctypes.addressof(self.watched[-1][1])
        self._inputs = dict[str, np.ndarray]()
        self._final, self._finals = dict[str, Any](), dict[str, Any]()

    # --- binding -----------------------------------------------------------------------------------------------------

    def bind_block(self, stage: OpaqueStage, t: np.ndarray, c: np.ndarray, *, again: bool) -> StageStructure:
        """Return a stage as C knows it; valid as long as this lives. See `Evaluator.bind`."""
        place = self.paths.index(stage.path)
        block, fmu, vectors, structure = (
            self._blocks[stage.path],
            self._each[place],
            stage.vectors(t, c),
            StageStructure(),
        )
        structure.fmu = ctypes.addressof(self._each) + place * ctypes.sizeof(_Exchanged)
        structure.t, structure.x, structure.u, structure.into = map(at, vectors)
        structure.made, structure.looks = vectors.into.size, stage.names == (JUMP,)
        structure.by_python = self.called.function(CALL, self._by_python(stage, vectors), _FAILED_IN_PYTHON)
        if fmu.by_python:
            fmu.states = vectors.x.size
            self._inputs.setdefault(stage.path, np.zeros(0))
        elif structure.looks:
            self._bind_look(fmu, stage.path, block.native_look(vectors), vectors.x.size)
            fmu.events = vectors.u.size - fmu.inputs
        else:
            structure.calls = self._sequence(stage.path, block.native_evaluation(stage.wanted, vectors, again=again))
        return structure

    def _bind_look(self, fmu: _Exchanged, path: str, look: NativeLook, states: int) -> None:
        fmu.states, fmu.inputs = states, look.least.size
        for name in ("complete", "enter", "update", "leave"):
            setattr(fmu, name, self._sequence(path, getattr(look, name)))
        if look.complete and look.final is None:
            self._final[path] = self._actions[-4][1][len(look.complete) - 1]
        self._finals[path] = look.final
        answers = look.answers
        fmu.width, fmu.again, fmu.terminate, fmu.nominals = answers[:4]
        fmu.defined, fmu.time, fmu.wants, fmu.ends, fmu.again_where = answers[4:]
        self._inputs[path] = np.zeros(fmu.inputs)
        fmu.u = self._memory.own(self._inputs[path])
        fmu.least, fmu.relative, fmu.low, fmu.high = (
            self._memory.own(np.ascontiguousarray(v)) for v in (look.least, look.relative, look.low, look.high)
        )
        fmu.discrete = self._memory.own(look.discrete.astype(np.uint8))

    def _sequence(self, path: str, actions: Sequence[NativeAction]) -> _ActionsInC:
        made = (_Action * len(actions))()
        for structure, action in zip(made, actions, strict=True):
            structure.kind, structure.function, structure.type = action.kind, action.function, action.type
            structure.count = len(action.arguments) or action.places.size
            if action.bound is not None:
                structure.count = len(action.names)
                self._add_request(path, action.bound)
            if action.names:
                self._warned.append((path, action.names, np.full(len(action.names), np.nan)))
                structure.warned_at = at(self._warned[-1][2])
            structure.arguments[: len(action.arguments)] = action.arguments
            structure.vector, structure.index, structure.buffer = (
                action.vector,
                self._memory.own(action.places),
                action.buffer,
            )
            structure.low, structure.high = action.low, action.high
            self._names[ctypes.addressof(structure)] = action.names
        self._memory.kept.append(made)
        self._actions.append((path, made, [*actions]))
        return _ActionsInC(len(made), ctypes.addressof(made) if actions else None)

    def _add_request(self, path: str, calls: BoundCalls) -> None:
        """Let C ask a process for calls."""
        request, place = calls.request, self.paths.index(path)
        assert request is not None
        if path not in self._far:
            self._far[path] = self.remote.add_calls(request)
            self._each[place].far = ctypes.addressof(self._far[path])
        self._late.add(place, self._far[path], request.sequence, calls)

    # --- between Python and C ----------------------------------------------------------------------------------------

    def hand_over(self, path: str, u: np.ndarray, next_time: float, *, asks: bool, ended: bool, final: bool) -> None:
        """Let C continue with a block from an instant that Python has come to."""
        self._late.check()
        fmu = self._each[self.paths.index(path)]
        self._inputs[path][:] = u
        fmu.next_time, fmu.asks, fmu.ended, fmu.other_nominals = next_time, asks, ended, False
        self.structure.lost = self.structure.failed = 0
        if path in self._final:
            self._final[path].arguments[1] = final
        elif self._finals.get(path) is not None:
            self._finals[path].value = final

    def inputs_of(self, path: str) -> np.ndarray:
        """Return the inputs of a block at the last instant that was reached."""
        return self._inputs[path]

    @property
    def completes_step(self) -> bool:
        """Whether a look is one at the end of a step, and no event acts."""
        return bool(self.structure.look == _TO_STEP)

    def lent(self, path: str) -> AbstractContextManager[None]:
        """Let Python ask a block's process while C waits."""
        return self.remote.lent(self._far.get(path))

    def state_of(self, path: str) -> Any:
        """Return what C knows of a block: ``next_time``, ``asks``, ``ended``, ``in_event``, ``end`` and so on."""
        return self._each[self.paths.index(path)]

    def name_of_event(self, place: int) -> str:
        """Return the name of the last event that a block has had by itself, by its place."""
        return OWN_EVENTS[self._each[place].event]

    def take_warnings(self) -> list[tuple[str, str, float]]:
        """Return calls that have given a warning since the last time: block, name and time in s of the first one."""
        found = list[tuple[str, str, float]]()
        if not self.structure.warned:
            return found
        self.structure.warned = 0
        for path, names, times in self._warned:
            found += [(path, name, float(t)) for name, t in zip(names, times, strict=True) if not np.isnan(t)]
            times[:] = np.nan
        return sorted(found, key=lambda one: one[2])

    def failure(self) -> CallFailure:
        """Return the call that has failed; raises `FmuProcessError` if the process of an FMU has ended."""
        self._late.check()
        self.called.check()
        o = self.structure
        names = () if o.action is None else self._names[o.action]
        name = names[min(o.call, len(names) - 1)] if names else ""
        self.remote.note_status(self._far.get(self.paths[o.plant]), o.status)
        return CallFailure(self.paths[o.plant], name, o.status, o.at)

    def take_events(self) -> list[OwnEvent]:
        """Return the events since the last call."""
        rows, w, n = self._log[: self.structure.logged].copy(), self._width, len(self.paths)
        self.structure.logged = 0
        return [
            OwnEvent(float(r[0]), self.paths[int(r[1]) % n], OWN_EVENTS[int(r[1]) // n], r[2 : 2 + w], r[2 + w :])
            for r in rows
        ]
