"""Blocks in model exchange as C evaluates them, between the traced stages of a diagram's functions.

They are handed over to the loop in C, and taken back; evaluators in Python do what C can't.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np

from ...blocks.called_back import CalledBack
from ...blocks.core import EvaluationVectors, FmuRuntimeError, SimulationError
from ...fmus.calls import WARNING, BoundCalls, ModelExchangeInstance, NativeAction, NativeLook
from ...fmus.host_state import HostState
from ..flat import JUMP, FlatDiagram, OpaqueStage
from ..model_exchange import OWN_EVENTS, ModelExchangeEvaluator
from .bound_functions import CALL, MemoryForC, TickStructure, at, fields_of
from .plants_called_back import LateReplies, RemotePlants

_LOGGED = 2**20  # bytes of events in a call
_TO_STEP, _FAILED_IN_PYTHON = 0, 2
_INT, _REAL, _AT = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
_DONE, _NOT_COMPUTED = range(2)  # of an evaluation by Python
_FIRED = -1  # an event of the diagram's, in the place of one of the block's own


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


class ModelExchangeHandOver:
    """Blocks in model exchange, in a run that continues in C.

    Evaluators do what C can't. ``report`` is called with events of the blocks' own; ``count(t, path, name)`` notes one,
    and refuses those that pile up.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        blocks: Mapping[str, Any],
        evaluators: Mapping[str, ModelExchangeEvaluator],
        report: Callable[[OwnEvent], None],
        count: Callable[[float, str, str], None],
    ):
        self._evaluators, self._report, self._count = evaluators, report, count
        self._blocks: dict[str, ModelExchangeInstance] = {path: blocks[path] for path in flat.in_model_exchange}
        first = {path: flat.states.slices[path].start for path in flat.in_model_exchange}
        self.native = NativeModelExchange(self._blocks, first, flat.width, self._by_python)
        """The blocks as C knows them."""
        self._with_c = False

    # --- Python for C ------------------------------------------------------------------------------------------------

    def _by_python(self, stage: OpaqueStage, vectors: EvaluationVectors) -> Callable[[], int]:
        """Return the function that evaluates a stage, or looks at an instant, by Python while C waits."""
        path, evaluator, (t, x, u, into) = stage.path, self._evaluators[stage.path], vectors

        def call() -> None:
            into[:] = evaluator.evaluate(stage.names, float(t[0]), x, u)

        def evaluate() -> int:
            try:
                with self.native.lent(path):
                    call()
            except FmuRuntimeError:
                raise
            except SimulationError:  # a step that is shorter may have values
                return _NOT_COMPUTED
            return _DONE

        def look() -> int:
            with self.native.lent(path):
                self._look(path, float(t[0]), call)
            return _DONE

        return look if stage.names == (JUMP,) else evaluate

    def _look(self, path: str, t: float, call: Callable[[], None]) -> None:
        evaluator, block, state = self._evaluators[path], self._blocks[path], self.native.state_of(path)
        changed = self._take_block(path)
        nominals = np.array(block.nominals)
        event = evaluator.look_at(call, completes_step=self.native.completes_step)
        self._give_block(path)
        state.other_nominals = changed or not np.array_equal(nominals, block.nominals)
        if event is None:
            return
        state.acted, state.event = True, OWN_EVENTS.index(event) if event else _FIRED
        if state.event > 0:
            self._count(t, path, event)

    # --- from one to the other ---------------------------------------------------------------------------------------

    def hand_over(self) -> None:
        """Let C continue from an instant that Python has come to."""
        self._with_c = True
        for path in self._blocks:
            self._give_block(path)

    def _give_block(self, path: str) -> None:
        block, state = self._blocks[path], self.native.state_of(path)
        self.native.hand_over(
            path,
            self.native.inputs_of(path) if state.by_python else block.u,
            block.next_time,
            asks=self._evaluators[path].wants_event,
            ended=block.ends_run,
            final=not state.by_python and block.is_final,
        )

    def take_back(self) -> bool:
        """Let Python continue from where C has come to; return whether nominal values have changed."""
        if not self._with_c:  # Python has continued, and has been interrupted
            return False
        self._with_c = False
        changed = [self._take_block(path) for path in self._blocks]
        return any(changed)

    def _take_block(self, path: str) -> bool:
        block, state = self._blocks[path], self.native.state_of(path)
        changed, state.other_nominals = bool(state.other_nominals), 0
        if state.by_python:
            return changed
        self._evaluators[path].wants_event = bool(state.asks)
        if state.ended and not block.ends_run:
            block.note_end(state.end, in_event=bool(state.in_event))
        block.take_back(self.native.inputs_of(path), state.next_time, read_nominals=changed)
        return changed

    def report(self) -> None:
        """Report what has happened in C: warnings, and events of the blocks' own."""
        self.native.remote.take_messages()
        for path, action, t in self.native.take_warnings():
            self._blocks[path].judge(action, WARNING, t)
        for event in self.native.take_events():
            self._report(event)

    def has_news(self) -> bool:
        """Whether a block asks for the end of the run, or has other nominal values."""
        states = [(self.native.state_of(path), block) for path, block in self._blocks.items()]
        return any(state.other_nominals or (state.ended and not block.ends_run) for state, block in states)

    def judge(self) -> None:
        """Raise the error of the call that has failed."""
        failed = self.native.failure()
        self._blocks[failed.path].judge_native(failed.action, failed.status, failed.t)
