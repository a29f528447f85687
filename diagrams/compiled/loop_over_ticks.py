"""The loop over ticks in C: a diagram's ticks and the FMUs between them, bound to the numbers of a run."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ...blocks.called_back import CalledBack
from ...blocks.core import SimulationError
from ...fmus.calls import NEAR, FmuInstance
from ..flat import TRUE, StepTable, TickPattern
from .bound_functions import CALL, TICK, MemoryForC, TickStructure, at
from .compiled_libraries import load_runtime
from .diagram_code import DiagramCode
from .model_exchange_in_c import NativeModelExchange
from .newton import NewtonOptions, NewtonStructure
from .plants_called_back import PythonStep
from .plants_of_loop import LoopPlants
from .rate_differences import SlopesByDifferences

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


class LoopStructure(ctypes.Structure):
    """The loop over ticks, as C knows it."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("kinds", "plants", "states", "row", "stops", "every")),
        *((name, ctypes.c_void_p) for name in ("ticks", "fmus", "t", "x", "x_next", "log", "ok", "columns", "stop")),
        ("truth", ctypes.c_double),
        ("near", ctypes.c_double),
        ("skip", ctypes.c_int64),
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
        self.plants = LoopPlants(plants, exchange)
        """The plants, as C steps them."""
        self._memory = memory = MemoryForC(code, arguments, results, plants, columns, exchange)
        self._bind_block = None if exchange is None else exchange.bind_block
        self.calls_python = code.calls_python
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
            fmus=self.plants.address,
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
        self.structure.apart = self.plants.remote.address
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
        return [*self._memory.kept, *self.plants.kept]

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

    def check(self) -> None:
        """Raise the error of a function that C has called; to be asked once what a call has recorded is taken."""
        self.called.check()

    def set_steps(self, steps: StepTable | None) -> None:
        """Take the steps to the ticks of the next call; None where all plants step at each of them."""
        if steps is not None:
            self._table = [steps.begins, steps.widths, steps.holds]
            self._own.begins, self._own.widths, self._own.holds = map(at, self._table)

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
        with self.plants.guard():
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
