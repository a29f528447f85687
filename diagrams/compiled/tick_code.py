"""C code of a diagram's ticks, and the loop that goes over them."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

from ...blocks.core import CompilerError
from ...fmus.runtime import read_sources
from ..flat import EXACT_LOOP, FlatDiagram, TickPattern, TickProgram, share_terms
from .bound_functions import CodeOfFunctions, CompiledFunction, FunctionInC, GeneratedCode, address_of
from .compiled_libraries import load_compiled
from .function_code import Sources
from .generated_text import write_functions
from .grouped_functions import GroupedTick
from .grouping import TickTables, make_tables
from .kernels import BlockKinds, Kernels
from .reordered import put_in_order
from .runtime import load_runtime

LARGEST = 6_000
"""Operations of a function up to which it is compiled as a whole: the compiler's time grows faster than they do."""
LOOP_OVER_TICKS = "loopwright_run"


@dataclass(frozen=True, eq=False)
class TickCode:
    """The C functions of a diagram's ticks, by the clocks that act, loaded.

    ``exact`` says whether all bits are those of an interpreted run. Tables and large matrix products are compiled in
    another form than they are interpreted in: there, signs of zeros may differ. Algebraic loops of more than
    `EXACT_LOOP` values are solved with another rounding.
    """

    ticks: Mapping[frozenset[TickPattern], FunctionInC]
    exact: bool
    library: ctypes.CDLL  # loaded as long as this lives
    # equations of algebraic loops, where there are some
    loops: Mapping[frozenset[TickPattern], FunctionInC] = field(default_factory=dict)
    run_ticks: Any = None  # goes over ticks; None for the one that all diagrams share
    notes: tuple[str, ...] = ()  # what a run reports of its code


def find_obstacle(flat: FlatDiagram) -> str | None:
    """Return why there can't be generated code of a diagram's ticks; None if there can."""
    if flat.loops.slices and any(flat.table.blocks[path].opaque for path in flat.checked.traced):
        return "it has an algebraic loop next to blocks that Python evaluates, and Newton's method runs in C alone"
    return None


def compile_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickCode:
    """Compile the ticks at which these sets of clocks act.

    Small ones are one function of scalar operations, in which the values of one block are used by the next without a
    memory in between. Large ones, and those with blocks that are no scalar operations, are grouped: one function for
    each kind of block, called in a loop over all blocks of this kind. Their code knows no numbers and no wiring.
    """
    flat = flat.origin  # other numbers change no code
    code: TickCode | None = flat.made["ticks"].get("generated")
    return code if code is not None and tuple(code.ticks) == tuple(acting) else write_ticks(flat, acting).load()


def interpret_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickCode:
    """Return the ticks at which these sets of clocks act for the virtual machine; see `compile_ticks`."""
    flat = flat.origin
    known, sources = flat.made["ticks"].get("interpreted", ((), None))
    if sources is None or [*known] != [*acting]:
        sources = write_ticks(flat, acting, straight=True)
        flat.made["ticks"]["interpreted"] = [*acting], sources
    code: TickCode = sources.on_machine()
    return code


def write_ticks(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, straight: bool = False, whole: bool = False
) -> Sources[TickCode]:
    """Return the ticks at which these sets of clocks act, to be written as C code; see `compile_ticks`.

    ``straight`` leaves functions that are no scalar operations as they are; ``whole`` makes one function of each tick
    of a large diagram, too, which calls those of its blocks.
    """
    ticks = _write_straight(flat, acting, always=straight) if whole or not flat.by_block else None
    ticks = ticks or _write_grouped(flat, acting)
    loops = loop_functions(flat, acting)
    if not loops:
        return replace(ticks, keep=partial(_keep, flat))
    exact = ticks.exact and all(len(flat.active_loops(clocks)) <= EXACT_LOOP for clocks in loops)
    exact = exact and all(function.is_a("SXFunction") for function in loops.values())

    def make(libraries: Sequence[CodeOfFunctions]) -> TickCode:
        return replace(ticks.make(libraries[:-1]), exact=exact, loops=find_loops(loops, libraries[-1]))

    count = sum(function.n_instructions() for function in loops.values())
    writers: list[Callable[[], str]] = [*ticks.writers, partial(write_loops, loops)]
    return Sources(writers, make, ticks.operations + count, exact, partial(_keep, flat))


def _keep(flat: FlatDiagram, code: TickCode) -> None:
    flat.made["ticks"].setdefault("generated", code)


def loop_functions(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> dict[frozenset[TickPattern], Any]:
    """Return the equations of the algebraic loops at ticks, mismatch and derivative, but for those in stages."""
    found = {clocks: flat.loop_equations(clocks) for clocks in acting} if flat.loops.slices else {}
    return {
        c: share_terms(made.fast, f"loops{i}")
        for i, (c, made) in enumerate(found.items())
        if made is not None and not made.schedule.opaque
    }


def write_loops(loops: Mapping[frozenset[TickPattern], Any]) -> str:
    """Return the C code of the equations of algebraic loops."""
    for function in loops.values():
        check_size(function)
    return write_functions("loops", loops.values())


def find_loops(
    loops: Mapping[frozenset[TickPattern], Any], code: CodeOfFunctions
) -> dict[frozenset[TickPattern], CompiledFunction]:
    """Return the equations of algebraic loops in the library of `write_loops`."""
    return {clocks: code.find(f) for clocks, f in loops.items()}


def compile_loops(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]
) -> dict[frozenset[TickPattern], CompiledFunction]:
    """Return the equations of the algebraic loops at ticks, compiled: their mismatch, and its derivative."""
    loops = loop_functions(flat, acting)
    return find_loops(loops, GeneratedCode(load_compiled(write_loops(loops)))) if loops else {}


def check_size(function: Any) -> None:
    """Refuse a function that is too large to be compiled as a whole."""
    if (count := function.n_instructions()) > LARGEST:
        raise CompilerError(
            f"a function of the diagram has {count} operations; at most {LARGEST} are compiled, as a compiler takes "
            "seconds for them. Leave out compile=True, or, if it is the derivative of the rates, take a solver without "
            "one: solver='RK45'."
        )


def _write_straight(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, always: bool
) -> Sources[TickCode] | None:
    """Return ticks as one function each; None if they are no scalar operations, unless they are ``always`` wanted."""
    found = {clocks: flat.at_tick(clocks).last.fast for clocks in acting}
    if not always and not all(function.is_a("SXFunction") for function in found.values()):
        return None
    functions = {clocks: share_terms(f, f"tick{i}") for i, (clocks, f) in enumerate(found.items())}

    def make(libraries: Sequence[CodeOfFunctions]) -> TickCode:
        ticks = {clocks: libraries[0].find(f) for clocks, f in functions.items()}
        return TickCode(ticks, True, libraries[0].library)

    count = sum(function.n_instructions() for function in functions.values())
    return Sources([lambda: put_in_order(write_functions("ticks", functions.values()))], make, count, exact=True)


def _write_grouped(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> Sources[TickCode]:
    programs = {clocks: flat.program_at(clocks) for clocks in acting}
    kinds = BlockKinds(flat, [tick.program for tick in programs.values()])
    ticks = GroupedTicks(programs)

    def make(libraries: Sequence[CodeOfFunctions]) -> TickCode:
        kernels = kinds.find(libraries[0])
        return TickCode(ticks.find(kernels), kinds.exact or kernels.generated is None, libraries[0].library)

    return Sources([lambda: kinds.source], make, kinds.operations, kinds.exact)


class GroupedTicks:
    """Ticks as runs of equal blocks, with tables that are made once for kernels."""

    def __init__(self, programs: Mapping[frozenset[TickPattern], TickProgram]):
        self._programs = programs
        self._tables: WeakKeyDictionary[Kernels, dict[frozenset[TickPattern], TickTables]] = WeakKeyDictionary()

    def find(self, kernels: Kernels) -> dict[frozenset[TickPattern], GroupedTick]:
        """Return the ticks with these kernels."""
        if kernels not in self._tables:
            self._tables[kernels] = {clocks: make_tables(p, kernels.of) for clocks, p in self._programs.items()}
        address = address_of(load_runtime(), "loopwright_grouped_tick")
        return {clocks: GroupedTick(tables, kernels, address) for clocks, tables in self._tables[kernels].items()}


def loop_source() -> str:
    """Return the C text of the loop over ticks, for code that is in one unit with it."""
    return read_sources("newton.c", "remote.c", "loop_over_ticks.c")
