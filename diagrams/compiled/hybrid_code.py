"""C code of a diagram with continuous states: its ticks, its rates, its events; and the loop that goes over them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import chain
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from ...fmus.export import describe_processor, processor_flags
from ..flat import NONE, FlatDiagram, OpaqueStage, PartProgram, Schedule, TickPattern, share_terms
from .bound_functions import CodeOfFunctions, FunctionInC, GeneratedCode, address_of
from .function_code import Sources
from .generated_text import write_functions
from .grouped_functions import GroupedPart
from .grouping import PartTables, make_part_tables
from .kernels import BlockKinds, Kernels
from .rate_differences import Columns, SlopesByDifferences, find_columns
from .runtime import load_runtime
from .small_steps import STEPS, write_steps
from .staged_functions import Staged
from .step_outputs import may_fail_at_steps
from .tick_code import (
    GroupedTicks,
    TickCode,
    check_size,
    find_loops,
    loop_functions,
    write_loops,
)

FUSING = ("-finline-functions", "-freciprocal-math", "-fno-tree-vectorize", "-fno-tree-slp-vectorize")
"""Flags of fused code: a parameter's inverse is computed once; vectors of few values cost more than they save."""


@dataclass(frozen=True, eq=False)
class HybridCode:
    """The C functions of a diagram with continuous states, loaded."""

    ticks: TickCode  # that at which no clock acts is an instant between ticks
    between: Mapping[str, FunctionInC]  # by name: flow, slope, indicators, jump, driven
    steps: Mapping[str, int] = field(default_factory=dict)  # addresses of steps that were made for its rates, by method
    judged: bool = False  # outputs may be non-finite after a step though states are finite

    def hand_over(self, to: HybridCode) -> None:
        """Let generated code take the place of the virtual machine wherever these functions are bound."""
        for clocks, tick in self.ticks.ticks.items():
            tick.hand_over(to.ticks.ticks[clocks])
        for clocks, equations in self.ticks.loops.items():
            equations.hand_over(to.ticks.loops[clocks])
        for name, function in self.between.items():
            if not isinstance(function, SlopesByDifferences):  # their rates are handed over as "flow"
                function.hand_over(to.between[name])


def find_code_obstacle(flat: FlatDiagram) -> str | None:
    """Return why there can't be generated code of a diagram with continuous states; None if there can."""
    blocks = flat.table.blocks
    opaque = sorted(path for path in flat.checked.traced if blocks[path].opaque and path not in flat.in_model_exchange)
    if opaque and flat.in_model_exchange:
        return (
            f"Python evaluates the block {opaque[0]!r} next to the FMU {flat.in_model_exchange[0]!r} in model exchange"
        )
    if opaque and flat.loops.slices:
        return f"it has an algebraic loop next to the block {opaque[0]!r}, which Python evaluates"
    return None


def has_delays(flat: FlatDiagram) -> bool:
    """Whether there is a transport delay in continuous time."""
    return any(block.transport and path not in flat.checked.traced for path, block in flat.table.blocks.items())


def compile_hybrid(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, stiff: bool, fuse: bool = False
) -> HybridCode:
    """Compile the functions of a diagram with continuous states, with the derivative of its rates where ``stiff``.

    With ``fuse`` it is compiled for the processor of this machine, with products and sums fused.
    """
    kinds = (NONE, *(clocks for clocks in acting if clocks))
    known: dict[tuple[Any, ...], HybridCode] = flat.made["generated code between ticks"]
    if (kinds, stiff, fuse) not in known:
        more = ((*processor_flags(), *FUSING), describe_processor()) if fuse else ()
        known[kinds, stiff, fuse] = hybrid_sources(flat, acting, stiff=stiff).load(*more)
    return known[kinds, stiff, fuse]


def interpret_hybrid(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, stiff: bool) -> HybridCode:
    """Return the functions of a diagram with continuous states for the virtual machine; see `compile_hybrid`."""
    return hybrid_sources(flat, acting, stiff=stiff).on_machine()


def hybrid_sources(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, stiff: bool) -> Sources[HybridCode]:
    """Return the functions of a diagram with continuous states; the same ones for the next run. See `write_hybrid`."""
    key = (NONE, *(clocks for clocks in acting if clocks)), stiff
    known: dict[tuple[Any, ...], Sources[HybridCode]] = flat.made["functions between ticks"]
    if key not in known:
        known[key] = write_hybrid(flat.origin, acting, stiff=stiff)
    return known[key]


def write_hybrid(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, stiff: bool, straight: bool = False
) -> Sources[HybridCode]:
    """Return the functions of a diagram with continuous states, to be written as C code; see `compile_hybrid`.

    Small diagrams are expanded: each function is one of scalar operations. Large ones, by the rule of
    `FlatDiagram.by_block`, are grouped, so that the compiler sees each kind of block once. The derivative of the rates
    is computed by differences then. Diagrams with algebraic loops between ticks are expanded, and so are all with
    ``straight``.
    """
    kinds = (NONE, *(clocks for clocks in acting if clocks))
    grouped = flat.by_block and not flat.active_loops(NONE) and not straight
    write = _write_staged if flat.in_model_exchange else _write_grouped if grouped else _write_straight
    written = write(flat, kinds, stiff=stiff)
    loops, judged = loop_functions(flat, kinds), bool(flat.in_model_exchange) or may_fail_at_steps(flat)

    def make(libraries: Sequence[CodeOfFunctions]) -> HybridCode:
        code = replace(written.make(libraries), judged=judged)
        found = {**code.ticks.loops, **find_loops(loops, libraries[-1])} if loops else code.ticks.loops
        return replace(code, ticks=replace(code.ticks, loops=found))

    writers: list[Callable[[], str]] = [*written.writers, *([partial(write_loops, loops)] if loops else [])]
    exact = written.exact and all(function.is_a("SXFunction") for function in loops.values())
    return replace(written, writers=writers, make=make, exact=exact)


def _write_straight(flat: FlatDiagram, kinds: Sequence[frozenset[TickPattern]], *, stiff: bool) -> Sources[HybridCode]:
    ticks = {clocks: share_terms(flat.at_tick(clocks).last.fast, f"tick{i}") for i, clocks in enumerate(kinds)}
    others = {"flow": flat.flow.last.fast}
    if stiff:
        looped = bool(flat.active_loops(NONE))
        others["slope"] = flat.jacobian_with_loops.fast if looped else _sparse_slope(flat)
    if flat.events:
        others |= {"indicators": flat.indicators.last.fast, "jump": flat.jump.last.fast}
    if has_delays(flat):
        others["driven"] = flat.driven.last.fast
    others = {name: share_terms(function, name) for name, function in others.items()}
    functions = [*ticks.values(), *others.values()]

    @cache
    def steps() -> str:
        if flat.active_loops(NONE) or has_delays(flat):  # there is more to a trial than the rates
            return ""
        return write_steps(flat.flow.last.fast, flat.continuous.tolist())

    def write() -> str:
        for function in functions:
            check_size(function)
        return write_functions("hybrid", functions) + steps()

    def make(libraries: Sequence[CodeOfFunctions]) -> HybridCode:
        code = libraries[0]
        straight = {clocks: code.find(function) for clocks, function in ticks.items()}
        between: dict[str, FunctionInC] = {name: code.find(function) for name, function in others.items()}
        generated = isinstance(code, GeneratedCode) and steps()
        made = {method: code.address(step) for method, step in STEPS.items()} if generated else {}
        return HybridCode(TickCode(straight, exact=False, library=code.library), between, made)

    exact = all(function.is_a("SXFunction") for function in functions)
    return Sources([write], make, sum(function.n_instructions() for function in functions), exact)


def _write_staged(flat: FlatDiagram, kinds: Sequence[frozenset[TickPattern]], *, stiff: bool) -> Sources[HybridCode]:
    """Write functions that go around FMUs in model exchange: one of C for each of their stages."""
    schedules: dict[str, Schedule] = {f"tick{i}": flat.at_tick(clocks) for i, clocks in enumerate(kinds)}
    schedules |= {"flow": flat.flow, "jump": flat.jump}
    if flat.events:
        schedules["indicators"] = flat.indicators
    if has_delays(flat):
        schedules["driven"] = flat.driven
    equations = {f"loops_at{i}": (c, flat.loop_equations(c)) for i, c in enumerate(kinds if flat.loops.slices else ())}
    looped = {name: (c, made.schedule) for name, (c, made) in equations.items() if made and made.schedule.opaque}
    schedules |= {name: schedule for name, (_, schedule) in looped.items()}

    def dense(where: Sequence[int] | np.ndarray) -> Columns:
        return Columns.of(where, [np.arange(len(where))] * len(where))

    @cache
    def columns() -> Columns:
        if flat.active_loops(NONE):  # they may lead from each state to each rate
            return dense(flat.continuous)
        depends = flat.flow.depends("dx", "x")[:, flat.continuous]
        return Columns.of(flat.continuous, [np.flatnonzero(column) for column in depends.T])

    functions: dict[str, list[Any]] = {}
    for name, schedule in schedules.items():
        traced = [stage.fast for stage in schedule.stages if not isinstance(stage, OpaqueStage)]
        functions[name] = [share_terms(function, f"{name}_{j}") for j, function in enumerate(traced)]

    def make(libraries: Sequence[CodeOfFunctions]) -> HybridCode:
        code = libraries[0]
        staged = {name: Staged(schedule, [*map(code.find, functions[name])]) for name, schedule in schedules.items()}
        ticks = {clocks: staged.pop(f"tick{i}") for i, clocks in enumerate(kinds)}
        loops = {
            c: SlopesByDifferences(staged.pop(name), dense(flat.active_loops(c)), values=True)
            for name, (c, _) in looped.items()
        }
        between: dict[str, FunctionInC] = {**staged}
        if stiff:
            between["slope"] = SlopesByDifferences(staged["flow"], columns())
        return HybridCode(TickCode(ticks, exact=False, library=code.library, loops=loops), between)

    def write() -> str:
        for function in chain(*functions.values()):
            check_size(function)
        return write_functions("hybrid", chain(*functions.values()))

    every = [*chain(*functions.values())]
    exact = all(function.is_a("SXFunction") for function in every)
    return Sources([write], make, sum(function.n_instructions() for function in every), exact)


def _write_grouped(flat: FlatDiagram, kinds: Sequence[frozenset[TickPattern]], *, stiff: bool) -> Sources[HybridCode]:
    programs = {clocks: flat.program_at(clocks) for clocks in kinds}
    names = ["flow", *(("indicators", "jump") if flat.events else ()), *(("driven",) if has_delays(flat) else ())]
    parts = {name: flat.part_program(name) for name in names}
    every = [tick.program for tick in programs.values()] + [part.program for part in parts.values()]
    blocks, ticks = BlockKinds(flat, every), GroupedTicks(programs)
    tables: WeakKeyDictionary[Kernels, dict[str, PartTables]] = WeakKeyDictionary()
    counts = {name: _count_operations(part) for name, part in parts.items()}

    @cache
    def columns() -> Columns:
        return find_columns(parts["flow"], flat.continuous)

    def make(libraries: Sequence[CodeOfFunctions]) -> HybridCode:
        kernels = blocks.find(libraries[0])
        if kernels not in tables:
            tables[kernels] = {name: make_part_tables(part, kernels.of) for name, part in parts.items()}
        address = address_of(load_runtime(), "loopwright_grouped_part")
        found = {name: GroupedPart(of, kernels, address, counts[name]) for name, of in tables[kernels].items()}
        between: dict[str, FunctionInC] = {**found}
        if stiff:
            between["slope"] = SlopesByDifferences(found["flow"], columns())
        exact = blocks.exact or kernels.generated is None
        return HybridCode(TickCode(ticks.find(kernels), exact, libraries[0].library), between)

    return Sources([lambda: blocks.source], make, blocks.operations, blocks.exact)


def _count_operations(part: PartProgram) -> int:
    """Return the operations of one evaluation."""
    of = part.program.functions
    return sum(of[op.kernel].n_instructions() for op in part.operations if op.kernel in of)


def _sparse_slope(flat: FlatDiagram) -> Any:
    """Return the derivative of the rates by the integrated states, of which only entries that may not be 0 are made."""
    function = flat.flow.last.fast
    symbols = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    rates = function.call(symbols)[0]
    return ca.Function("slope", symbols, [ca.jacobian(rates, symbols[1])[:, flat.continuous.tolist()]])
