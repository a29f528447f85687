"""The loop over ticks in C: a diagram's ticks and the FMUs between them, bound to the numbers of a run."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...blocks.called_back import CalledBack
from ...blocks.core import SimulationError
from ...blocks.interrupts import INTERRUPTS
from ...fmus.calls import NEAR, FmuInstance, NativeStep, RemoteStep
from ...fmus.host_state import HostState
from ..flat import TRUE, StepTable, TickPattern
from .bound_functions import CALL, TICK, MemoryForC, TickStructure, at
from .diagram_code import DiagramCode
from .model_exchange_in_c import NativeModelExchange
from .newton import NewtonOptions, NewtonStructure
from .plants_called_back import PythonStep, RemotePlants
from .rate_differences import SlopesByDifferences
from .runtime import load_runtime

_SEEN = 1e-6  # least singular value, relative to 1 + the loop's gain, that differences surely tell from 0


class ReturnReason(IntEnum):
    """Reasons for which the loop returns: the end of its ticks, or the first tick that Python must look at."""

    DONE, FMU_FAILED, FMU_FLAGS, NOT_OK, STOPPED, HALTED = range(6)
    # With continuous states also these, as `instants.c` numbers them.
    SUSPENDED, ENDED, LOOK, OUTSIDE_FAILED, PILED_UP, BROKEN_OFF = range(6, 12)


class OutcomeStructure(ctypes.Structure):
    """Where and why the loop has returned, as C knows it."""

    _fields_ = [(name, ctypes.c_int64) for name in ("ticks", "rows", "reason", "plant", "stage", "status")]

    def read(self, t: float = np.nan) -> Outcome:
        """Return it, with the time that continuous states have reached."""
        return Outcome(self.ticks, self.rows, ReturnReason(self.reason), self.plant, self.stage, self.status, t)


class _Transfer(ctypes.Structure):
    _fields_ = [
        ("function", ctypes.c_void_p),
        ("references", ctypes.c_void_p),
        ("count", ctypes.c_size_t),
        ("values", ctypes.c_void_p),
        ("size", ctypes.c_size_t),
    ]


class _Plant(ctypes.Structure):
    _fields_ = [
        ("version", ctypes.c_int32),
        ("instance", ctypes.c_void_p),
        ("step", ctypes.c_void_p),
        ("inputs", _Transfer),
        ("outputs", _Transfer),
        *(
            (name, ctypes.c_void_p)
            for name in ("now", "width", "final", "flags", "reached", "changed", "far", "by_python", "quiet")
        ),
    ]


class LoopStructure(ctypes.Structure):
    """The loop over ticks, as C knows it."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("kinds", "plants", "states", "row", "stops", "every")),
        *((name, ctypes.c_void_p) for name in ("ticks", "fmus", "t", "x", "x_next", "log", "ok", "columns", "stop")),
        ("truth", ctypes.c_double),
        ("near", ctypes.c_double),
        ("skip", ctypes.c_int64),
        ("halt", ctypes.c_int32),
        *((name, ctypes.c_void_p) for name in ("loops", "apart", "z", "held")),
        ("inputs", ctypes.c_int64),
        ("own", ctypes.c_void_p),
    ]


class _OwnSteps(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("begins", "widths", "holds", "inputs")]


class Outcome(NamedTuple):
    """Where and why the loop has returned."""

    ticks: int  # that were gone through
    rows: int  # samples that were written
    reason: ReturnReason
    plant: int  # the FMU that it is about, by its place
    stage: int  # setting inputs, the step, reading outputs; then as `plants_called_back`
    status: int  # of that call
    t: float = np.nan  # in s, that continuous states have reached


class CompiledLoop:
    """The loop over ticks, bound to the numbers of a run.

    Parameters
    ----------
    code : DiagramCode
        The functions of the diagram.
    arguments, results : sequence of ndarray
        The vectors (t, x, w, p) and (x_next, z, log, ok) of the run.
    plants : sequence of FmuInstance or PythonStep
        The FMUs, of which Python steps those that are neither native nor remote; of other plants the steps.
    columns : ndarray or None
        Entries of the log that a sample keeps; None for the first ``width``.
    width : int
        Number of entries of a sample.
    every : int
        One of so many samples is kept.
    stops : sequence of int
        Entries of the log that end the run where they are true.
    loops : mapping, optional
        How the algebraic loops of each tick are solved, where there are some.
    exchange : NativeModelExchange, optional
        Binds ticks in stages.
    held : pair of ndarray, optional
        Inputs of the plants as they are now, and as they are held between ticks; one array where that is the same.
    inputs : sequence of slice, optional
        The inputs of each plant among them, where plants step less often than the ticks.
    rest : callable, optional
        Evaluates a tick at which clocks act together for which there is no code: the kind after all `kinds`. It returns
        0, or 1 where it can't be evaluated.
    """

    def __init__(
        self,
        code: DiagramCode,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
        plants: Sequence[FmuInstance | PythonStep],
        *,
        columns: np.ndarray | None = None,
        width: int = 0,
        every: int = 1,
        stops: Sequence[int] = (),
        loops: Mapping[frozenset[TickPattern], NewtonOptions] | None = None,
        exchange: NativeModelExchange | None = None,
        held: tuple[np.ndarray, np.ndarray] | None = None,
        inputs: Sequence[slice] = (),
        rest: Callable[[], int] | None = None,
    ):
        self.called = CalledBack()
        self._remote, self._far = RemotePlants(), list[int | None]()
        self._remotes = [self._remote, *([] if exchange is None else [exchange.remote])]
        self._memory = memory = MemoryForC(code, arguments, results, plants, columns, exchange)
        self._bind_block = None if exchange is None else exchange.bind_block
        self.calls_python = code.calls_python
        self._watched: list[tuple[HostState, ctypes.c_bool]] = [] if exchange is None else [*exchange.watched]
        t, x, _, _ = arguments
        x_next, _, log, ok = results
        self.kinds = {clocks: i for i, clocks in enumerate(code.ticks)}
        ticks = [memory.bind(tick, arguments, results, self._bind_block) for tick in code.ticks.values()]
        # The tick after those with code serves all other sets of clocks; C calls Python for it.
        if rest is not None:
            ticks.append(TickStructure(self.called.function(TICK, lambda *_: rest(), 1)))
        self.structure = LoopStructure(
            kinds=len(ticks),
            plants=len(plants),
            states=x.size,
            row=width,
            stops=len(stops),
            every=every,
            ticks=memory.array(ticks),
            fmus=memory.array([self._plant(j, plant) for j, plant in enumerate(plants)]),
            t=at(t),
            x=at(x),
            x_next=at(x_next),
            log=at(log),
            ok=at(ok),
            columns=None if columns is None else memory.own(np.ascontiguousarray(columns, dtype=np.int64)),
            stop=memory.own(np.array(stops, dtype=np.int64)),
            truth=TRUE,
            near=NEAR,
        )
        self.structure.apart = self._remote.address
        # One array where plants take their inputs as they are; then C copies nothing.
        if held is not None and held[0] is not held[1]:
            self.structure.z, self.structure.held = map(memory.own, held)
            self.structure.inputs = held[0].size
        self._own = _OwnSteps()
        if inputs:
            self._own.inputs = memory.own(np.array([[s.start, s.stop] for s in inputs], dtype=np.int64))
            self.structure.own = ctypes.addressof(self._own)
        if code.loops:
            solvers = [self.bind_loops(code, clocks, arguments, (loops or {}).get(clocks)) for clocks in code.ticks]
            # C indexes solvers by the kind of the tick; the one that Python evaluates solves its loops itself.
            solvers += [NewtonStructure()] * (len(ticks) - len(solvers))
            self.structure.loops = memory.array(solvers)
        self._outcome = OutcomeStructure()
        self._run = code.run_ticks or load_runtime()["loopwright_run"]
        self._run.restype = None
        self._run.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 5]

    @property
    def kept(self) -> list[Any]:
        """All that lives as long as the loop: whatever its pointers lead to."""
        return self._memory.kept

    def bind_loops(
        self,
        code: DiagramCode,
        clocks: frozenset[TickPattern],
        arguments: Sequence[np.ndarray],
        options: NewtonOptions | None,
    ) -> NewtonStructure:
        """Return the algebraic loops at a tick, bound to the vectors (t, x, w, p); valid as long as this lives."""
        if clocks not in code.loops or options is None:
            return NewtonStructure()
        n, where, memory = len(options.where), np.array(options.where, dtype=np.int64), self._memory
        r, J, before = np.zeros(n), np.zeros(n * n), np.zeros(n)
        found = NewtonStructure(
            n=n,
            equations=memory.bind(code.loops[clocks], arguments, [r, J], self._bind_block),
            where=memory.own(where),
            r=memory.own(r),
            J=memory.own(J),
            before=memory.own(before),
            **{name: memory.zeros(n) for name in ("v", "direction", "column")},
            lu=memory.zeros(n * n),
            rows=memory.own(np.zeros(n, dtype=np.int64)),
            tolerance=options.tolerance,
            rounding=options.rounding,
            singular=max(options.singular, _SEEN if isinstance(code.loops[clocks], SlopesByDifferences) else 0.0),
            iterations=options.iterations,
            halvings=options.halvings,
        )
        evaluate = load_runtime()["loopwright_evaluate_loops"]
        solve = options.solver(arguments[0], arguments[1], lambda: evaluate(ctypes.byref(found)), r, J)

        def help_c() -> int:
            arguments[1][where] = before
            try:
                solve()
            except SimulationError:  # raised where the run can't do without
                return 0
            return 1

        found.help = self.called.function(CALL, help_c)
        memory.kept.append(found)
        return found

    def _plant(self, place: int, plant: FmuInstance | PythonStep) -> ctypes.Structure:
        self._far.append(None)
        if not isinstance(plant, FmuInstance):
            return _Plant(by_python=self._remote.add_python(place, plant, None))
        step, take = plant.native or plant.remote, partial(_take_step, plant)
        if step is None:
            return _Plant(by_python=self._remote.add_python(place, take, None))
        self._memory.kept.append(step)
        if isinstance(step, RemoteStep):
            far = self._far[-1] = self._remote.add(step)
            return _Plant(
                now=step.now,
                width=step.width,
                flags=step.flags,
                reached=step.reached,
                far=far,
                quiet=None if step.quiet is None else self._remote.add_quiet(step.quiet),
                by_python=self._remote.add_python(place, take, far) if step.is_careful else None,
            )
        return self._native(step)

    def begun(self) -> list[bool]:
        """Return for each FMU whether C has begun a step in another process whose end Python has to see to."""
        return [far is not None and self._remote.has_begun(far) for far in self._far]

    def check(self) -> None:
        """Raise the error of a function that C has called; to be asked once what a call has recorded is taken."""
        self.called.check()

    def check_steps(self) -> None:
        """Raise the error of a step that Python has taken for the loop."""
        if self._remote.by_python is not None:
            self._remote.by_python.check()

    def _native(self, step: NativeStep) -> ctypes.Structure:
        inputs, outputs = (
            _Transfer()
            if call is None
            else _Transfer(call.function, call.references, call.count, call.values, call.size)
            for call in (step.inputs, step.outputs)
        )
        changed = None
        if step.host is not None:
            self._watched.append((step.host, ctypes.c_bool()))
            changed = ctypes.addressof(self._watched[-1][1])
        return _Plant(
            step.version,
            step.instance,
            step.step,
            inputs,
            outputs,
            step.now,
            step.width,
            step.final,
            step.flags,
            step.reached,
            changed,
        )

    def set_steps(self, steps: StepTable | None) -> None:
        """Take the steps to the ticks of the next call; None where all plants step at each of them."""
        if steps is not None:
            self._table = [steps.begins, steps.widths, steps.holds]
            self._own.begins, self._own.widths, self._own.holds = map(at, self._table)

    def guard(self) -> AbstractContextManager[None]:
        """Leave this process's state as it was, whatever FMUs of others do to it meanwhile, and tell it.

        C sets rounding mode and traps back after each step; the working folder is set back at the end.
        """
        if self._watched or any(r.address for r in self._remotes):
            return self._guard()
        return INTERRUPTS.kept() if self.calls_python else nullcontext()

    @contextmanager
    def _guard(self) -> Iterator[None]:
        with ExitStack() as stack:
            for host, _ in self._watched:
                stack.enter_context(host)
            for remote in self._remotes:
                stack.enter_context(remote.guard())
            if self.calls_python or any(r.address for r in self._remotes):
                stack.enter_context(INTERRUPTS.kept())
            yield
        for host, changed in self._watched:
            if changed:
                host.note_modes()

    @property
    def skip(self) -> int:
        """Samples to leave out before the next one that is kept."""
        return int(self.structure.skip)

    @skip.setter
    def skip(self, count: int) -> None:
        self.structure.skip = count

    def run(
        self,
        times: np.ndarray,
        widths: np.ndarray,
        kinds: np.ndarray,
        rows: np.ndarray,
        steps: StepTable | None = None,
    ) -> Outcome:
        """Go through ticks, at most as many as there are rows to be written.

        Parameters
        ----------
        times : ndarray, shape (n + 1,)
            Time of the tick before them, and of each of them, in s.
        widths : ndarray, shape (n,)
            Length of each tick, in s.
        kinds : ndarray, shape (n,), of int32
            Clocks that act at each of them, as places in `kinds`.
        rows : ndarray, shape (m, 1 + width)
            Samples: their time in s, then their values.
        steps : StepTable, optional
            Steps of the plants that end at each of them, where not all plants step at all.
        """
        self.set_steps(steps)
        with self.guard():
            self._run(
                ctypes.addressof(self.structure),
                len(widths),
                at(times),
                at(widths),
                at(kinds),
                at(rows),
                ctypes.addressof(self._outcome),
            )
        return self._outcome.read()


def _take_step(plant: FmuInstance, t: float, h: float) -> bool:
    plant.step(t, h)
    return plant.ends_run
