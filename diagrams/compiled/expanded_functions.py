"""Functions of a small diagram, each expanded to scalar operations: ticks, algebraic loops, and those between ticks."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import CompilerError
from ...fmus.runtime import read_sources
from ..flat import NONE, FlatDiagram, OpaqueStage, Schedule, TickPattern, share_terms
from .bound_functions import (
    BlockBinder,
    BoundFunction,
    CodeOfFunctions,
    CompiledFunction,
    FunctionInC,
    GeneratedCode,
    TickStructure,
    address_of,
)
from .compiled_libraries import load_runtime
from .generated_text import put_in_order, write_functions
from .method_coefficients import error_exponent, tableau
from .model_exchange_in_c import StageStructure
from .rate_differences import Columns, SlopesByDifferences

_Clocks = frozenset[TickPattern]

LARGEST = 6_000
"""Operations of a function up to which it is compiled as a whole: the compiler's time grows faster than they do."""
STEPS = {"rk4": "step_rk4", "RK23": "step_rk23", "RK45": "step_rk45"}
"""Names of generated steps in C, by method."""
_MOST_STATES, _MOST_OPERATIONS = 8, 120  # of rates that are inlined into steps
_CASADI = re.compile(r"\b(_?(?:casadi|CASADI)_)")


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


class _ScheduleInC(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), ("stages", ctypes.c_void_p)]


@dataclass(frozen=True, eq=False)
class Staged(FunctionInC):
    """A schedule whose traced stages, in their order, are functions in C."""

    schedule: Schedule
    functions: Sequence[CompiledFunction]

    @property
    def calls_python(self) -> bool:
        """Whether Python evaluates some of its functions."""
        return any(function.calls_python for function in self.functions)

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time; ``bind_block`` binds the stages between."""
        assert bind_block is not None
        schedule, functions = self.schedule, iter(self.functions)
        c = np.zeros(schedule.width)
        vectors = [*arguments, c] if schedule.width else [*arguments]
        made, seen, kept = (StageStructure * len(schedule.stages))(), set[str](), list[Any]()
        for i, stage in enumerate(schedule.stages):
            if isinstance(stage, OpaqueStage):
                made[i] = bind_block(stage, arguments[0], c, again=stage.path in seen)
                seen.add(stage.path)
                continue
            kept.append(next(functions).bind(vectors, results if stage is schedule.last else [c[stage.makes]]))
            made[i].f = kept[-1].structure
        found = _ScheduleInC(len(made), ctypes.addressof(made))
        address, last = address_of(load_runtime(), "loopwright_stages"), made[len(made) - 1].f.results
        structure = TickStructure(address, None, last, ctypes.addressof(found), None)
        return BoundFunction(structure, arguments, results, found, c, [self, *kept, made])

    def hand_over(self, to: Any) -> None:
        """Let generated code of the same stages take over."""
        for one, other in zip(self.functions, to.functions, strict=True):
            one.hand_over(other)


def write_steps(rates: Any, where: Sequence[int]) -> str:
    """Return the C code of steps for one small differential equation, with rates by (t, x, w, p).

    The rates are inlined into every stage of a method. Empty where they are too large for that.
    """
    n = len(where)
    if not (0 < n <= _MOST_STATES and rates.is_a("SXFunction") and rates.n_instructions() <= _MOST_OPERATIONS):
        return ""
    text = write_functions("rates", [share_terms(rates, "rates")]).replace(
        "static int casadi_f0(", "INLINE int casadi_f0("
    )
    numbers = f"#define N {n}\n#define WIDTH {rates.numel_in(1)}\n#define PLACES {', '.join(map(str, where))}\n"
    numbers += "#define INLINE static inline __attribute__((always_inline))\n"
    named = _CASADI.sub(r"of_\1", text) + "#define RATES(a, r) of_casadi_f0(a, r, NULL, NULL, 0)\n"
    return "\n".join([read_sources("newton.c", "problem.c"), numbers, named, read_sources("small.c"), _embedded()])


@lru_cache(maxsize=1)
def _embedded() -> str:
    """Return the steps of embedded methods, with the coefficients of SciPy's methods."""
    return "".join(map(_write_embedded, ("RK23", "RK45")))


def _write_embedded(name: str) -> str:
    found = tableau(name)
    texts = [
        f"    static const double {letter}[] = {{{', '.join(map(float.hex, found[letter].ravel().tolist()))}}};\n"
        for letter in "ABCE"
    ]
    numbers = f"{len(found['B'])}, A, B, C, E, NULL, {float(error_exponent(name))}"
    call = f"    return step_small(m, &(lw_tableau){{{numbers}}});\n"
    return f"\nVISIBLE int {STEPS[name]}(method *m) {{\n" + "".join(texts) + call + "}\n"
