"""The differential equation between ticks, bound for the loop in C: rates, their derivative, loops and delays."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..flat import NONE, FlatDiagram
from .bound_functions import CompiledFunction, MemoryForC, at
from .diagram_code import DiagramCode
from .hybrid_structures import ProblemStructure
from .loop_over_ticks import CompiledLoop
from .model_exchange_in_c import NativeModelExchange
from .newton import NewtonOptions, NewtonStructure
from .rate_differences import SlopesByDifferences
from .transport_delays import Delays, NativeDelays


class DifferentialEquation:
    """The rates of a diagram's continuous states, bound to the numbers of a run.

    Parameters
    ----------
    code : DiagramCode
        The functions.
    flat : FlatDiagram
        The diagram.
    loop : CompiledLoop
        Its ticks, bound to the run.
    arguments : sequence of ndarray
        The vectors (t, x, w, p) of the run.
    typical : ndarray, shape (n,)
        Sizes of the integrated states below which differences don't take smaller steps.
    loops : NewtonOptions, optional
        Newton's method for the algebraic loops between ticks, where there are some.
    exchange : NativeModelExchange, optional
        FMUs in model exchange, where there are some.
    delays : Delays, optional
        The memory of transport delays, where there are some; their inputs are kept within ``tolerances``, relative and
        absolute.

    Attributes
    ----------
    structure : ProblemStructure
        It as C knows it, to be copied into the struct of the loop; what it leads to lives as long as this.
    trial : list of ndarray
        The vectors (t, x, w, p) of a trial.
    """

    def __init__(
        self,
        code: DiagramCode,
        flat: FlatDiagram,
        loop: CompiledLoop,
        arguments: Sequence[np.ndarray],
        *,
        typical: np.ndarray,
        loops: NewtonOptions | None,
        exchange: NativeModelExchange | None,
        delays: Delays | None,
        tolerances: tuple[float, float],
    ):
        # Trials have their own t and x; w is the run's, unless delays write their outputs of the trial's time into it.
        n, (_, x, w, p) = flat.continuous.size, arguments
        self.trial = [np.zeros(1), x.copy(), w if delays is None else w.copy(), p]
        self._memory = memory = MemoryForC()
        self._bind_block = None if exchange is None else exchange.bind_block
        self.where = flat.continuous
        """Entries of x that are integrated."""
        self.beyond = np.zeros(n)
        """States of the last trial with a rate that was not finite."""
        self.structure = ProblemStructure(
            n=n,
            width=flat.width,
            where=memory.own(flat.continuous.astype(np.int64)),
            flow=memory.bind(code.between["flow"], self.trial, [np.zeros(n)], self._bind_block),
            t=memory.own(self.trial[0]),
            x=memory.own(self.trial[1]),
            beyond=memory.own(self.beyond),
        )
        # Delays put out what went in τ before: C evaluates their inputs at a trial by another function.
        self.delays: NativeDelays | None = None
        if delays is not None:
            driven = np.zeros(flat.plant_inputs.total)
            evaluate = memory.bind(code.between["driven"], self.trial, [driven], self._bind_block)
            self.delays = NativeDelays(delays, evaluate, driven, w, self.trial[2], tolerances)
            self.structure.delays = self.delays.address
        # Algebraic loops are solved at each trial.
        self.solver: NewtonStructure | None = None
        if loops is not None:
            self.solver = loop.bind_loops(code, NONE, self.trial, loops)
            self.structure.loops, self.structure.here = ctypes.addressof(self.solver), at(x)
        if (slope := code.slope) is not None:
            self._bind_slope(slope, n, 0 if loops is None else len(loops.where), typical)

    @property
    def kept(self) -> list[object]:
        """All that lives as long as it: whatever the pointers of its structure lead to."""
        return [*self._memory.kept, *([] if self.solver is None else [self.solver])]

    def _bind_slope(self, slope: CompiledFunction | SlopesByDifferences, n: int, m: int, typical: np.ndarray) -> None:
        """Bind the derivative of the rates of n states with m values of algebraic loops."""
        of, memory = self.structure, self._memory
        if m and not isinstance(slope, SlopesByDifferences):  # its parts by the loops' values, from which C joins it
            slopes, through = np.zeros(n * n), np.zeros(2 * n * m)
            of.by_loops = memory.own(through)
            results = [slopes, through[: n * m], through[n * m :], np.zeros(m * m)]
            of.slope = memory.bind(slope, self.trial, results)
        else:
            rows, columns = slope.pattern
            slopes = np.zeros(len(rows))
            of.entries = len(rows)
            of.row, of.column = (memory.own(np.array([*v, 0], dtype=np.int64)) for v in (rows, columns))
            if isinstance(slope, SlopesByDifferences):
                slope = replace(slope, typical=typical, loops=self.solver)
            of.slope = memory.bind(slope, self.trial, [slopes], self._bind_block)
        of.slopes = memory.own(slopes)
