"""Functions of a small diagram, each expanded to scalar operations: ticks, algebraic loops, and those between ticks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import CompilerError
from ..flat import NONE, FlatDiagram, OpaqueStage, Schedule, TickPattern, share_terms
from .bound_functions import CodeOfFunctions, CompiledFunction, FunctionInC, GeneratedCode
from .generated_text import write_functions
from .rate_differences import Columns, SlopesByDifferences
from .reordered import put_in_order
from .small_steps import STEPS, write_steps
from .staged import Staged

_Clocks = frozenset[TickPattern]

LARGEST = 6_000
"""Operations of a function up to which it is compiled as a whole: the compiler's time grows faster than they do."""


class _TracedFunctions:
    """CasADi functions that become C functions of one library."""

    def __init__(self, functions: Sequence[Any]):
        self.functions = functions
        self.operations = sum(function.n_instructions() for function in functions)
        self.exact = all(function.is_a("SXFunction") for function in functions)
        """Whether generated code has the bits of interpreted functions: all are operations on scalars."""

    def write(self, name: str) -> str:
        """Return their C code; raises `CompilerError` for a function that is too large to be compiled as a whole."""
        for function in self.functions:
            if (count := function.n_instructions()) > LARGEST:
                raise CompilerError(
                    f"a function of the diagram has {count} operations; at most {LARGEST} are compiled, as a compiler "
                    "takes seconds for them. Leave out compile=True, or, if it is the derivative of the rates, take a "
                    "solver without one: solver='RK45'."
                )
        return write_functions(name, self.functions)


class _InStages:
    """A schedule as C goes through it: one function, or one for each stage around FMUs in model exchange."""

    def __init__(self, name: str, schedule: Schedule):
        self._schedule = schedule
        traced = [stage.fast for stage in schedule.stages if not isinstance(stage, OpaqueStage)]
        names = [f"{name}_{j}" for j in range(len(traced))] if schedule.opaque else [name]
        self.functions = [share_terms(function, own) for own, function in zip(names, traced, strict=True)]

    def find(self, code: CodeOfFunctions) -> CompiledFunction | Staged:
        """Return it where C finds the functions of its stages."""
        found = [code.find(function) for function in self.functions]
        return Staged(self._schedule, found) if self._schedule.opaque else found[0]


class ExpandedFunctions(_TracedFunctions):
    """Ticks, and functions between them, as one function of scalar operations each."""

    def __init__(self, flat: FlatDiagram, kinds: Sequence[frozenset[TickPattern]], between: Sequence[str] = ()):
        self._flat, self._stiff = flat, "slope" in between
        self._ticks = {clocks: _InStages(f"tick{i}", flat.at_tick(clocks)) for i, clocks in enumerate(kinds)}
        self._between = {name: _InStages(name, getattr(flat, name)) for name in between if name != "slope"}
        # Around FMUs in model exchange the derivative of the rates is computed by differences.
        self._slope = _trace_slope(flat) if self._stiff and not flat.in_model_exchange else None
        parts = [*self._ticks.values(), *self._between.values()]
        functions = [function for part in parts for function in part.functions]
        super().__init__([*functions, *([] if self._slope is None else [self._slope])])

    def text(self) -> str:
        """Return the C code, with steps of small differential equations."""
        text = self.write("diagram")
        # A tick is evaluated once, and gains by the order; rates are evaluated again and again, and lose some percent.
        return text + self._steps if self._between else put_in_order(text)

    @cached_property
    def _steps(self) -> str:
        flat = self._flat
        if not self._between or flat.in_model_exchange or flat.active_loops(NONE) or flat.has_delays:
            return ""  # there are no rates, or more to a trial than these
        return write_steps(flat.flow.last.fast, flat.continuous.tolist())

    def find(
        self, code: CodeOfFunctions
    ) -> tuple[Mapping[frozenset[TickPattern], FunctionInC], Mapping[str, FunctionInC]]:
        """Return ticks, and functions between them, where C finds them."""
        ticks = {clocks: tick.find(code) for clocks, tick in self._ticks.items()}
        between: dict[str, FunctionInC] = {name: part.find(code) for name, part in self._between.items()}
        if self._slope is not None:
            between["slope"] = code.find(self._slope)
        elif self._stiff:
            between["slope"] = SlopesByDifferences(between["flow"], self._columns)
        return ticks, between

    def find_steps(self, code: CodeOfFunctions) -> Mapping[str, int]:
        """Return the addresses of generated steps, by method."""
        if not isinstance(code, GeneratedCode) or not self._steps:
            return {}
        return {method: code.address(step) for method, step in STEPS.items()}

    @cached_property
    def operations_of_rates(self) -> int:
        """Operations of one evaluation of the rates, without those of FMUs."""
        functions = self._between["flow"].functions if self._between else ()
        return sum(function.n_instructions() for function in functions)

    @cached_property
    def _columns(self) -> Columns:
        flat = self._flat
        if flat.active_loops(NONE):  # they may lead from each state to each rate
            return Columns.dense(flat.continuous)
        depends = flat.flow.depends("dx", "x")[:, flat.continuous]
        return Columns.of(flat.continuous, [np.flatnonzero(column) for column in depends.T])


def _trace_slope(flat: FlatDiagram) -> Any:
    """Return the derivative of the rates by the integrated states, and by the values of algebraic loops if it has some.

    Without loops only entries that may not be 0 are made.
    """
    if flat.active_loops(NONE):
        return share_terms(flat.jacobian_with_loops.fast, "slope")
    rates = flat.flow.last.fast
    symbols = rates.sx_in() if rates.is_a("SXFunction") else rates.mx_in()
    slopes = ca.jacobian(rates.call(symbols)[0], symbols[1])[:, flat.continuous.tolist()]
    return share_terms(ca.Function("slope", symbols, [slopes]), "slope")


class LoopEquations(_TracedFunctions):
    """The equations of the algebraic loops at ticks that have some: their mismatch, and its derivative."""

    def __init__(self, flat: FlatDiagram, kinds: Sequence[frozenset[TickPattern]]):
        self._straight, self._staged = dict[_Clocks, Any](), dict[_Clocks, tuple[_InStages, Columns]]()
        for i, clocks in enumerate(kinds):
            made, name = flat.loop_equations(clocks), f"loops{i}"
            if made is None:
                continue
            if made.schedule.opaque:  # through FMUs in model exchange; the derivative is computed by differences
                self._staged[clocks] = _InStages(name, made.schedule), Columns.dense(flat.active_loops(clocks))
            else:
                self._straight[clocks] = share_terms(made.fast, name)
        staged = [function for part, _ in self._staged.values() for function in part.functions]
        super().__init__([*self._straight.values(), *staged])

    def text(self) -> str:
        """Return the C code."""
        return self.write("loops")

    def find(self, code: CodeOfFunctions) -> Mapping[frozenset[TickPattern], FunctionInC]:
        """Return them where C finds them, by the clocks that act."""
        staged = {
            clocks: SlopesByDifferences(part.find(code), columns, values=True)
            for clocks, (part, columns) in self._staged.items()
        }
        return {**staged, **{clocks: code.find(function) for clocks, function in self._straight.items()}}
