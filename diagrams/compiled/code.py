"""C code of a diagram's ticks, and the loop that goes over them."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

from ...blocks.core import CompilerError
from ..flat import EXACT_LOOP, FlatDiagram, TickPattern, share_terms
from .generated_text import write_functions
from .grouping import Tables, make_tables
from .kernels import write_kernels
from .libraries import CompiledFunction, address_of, is_kept, load_compiled, read_sources
from .reordered import put_in_order
from .staged_functions import Staged, StagedEquations

LARGEST = 6_000
"""Operations of a function up to which it is compiled as a whole: the compiler's time grows faster than they do."""
MASTER = "loopwright_run"


@dataclass(frozen=True, eq=False)
class GroupedTick:
    """A tick as runs of equal blocks.

    Attributes
    ----------
    tables : Tables
        Where the values of each block stand.
    functions : mapping
        CasADi functions of the blocks that Python evaluates, by key.
    address : int
        Address of the C function that goes over the tables.
    """

    tables: Tables
    functions: Mapping[int, Any]
    address: int


CompiledTick = CompiledFunction | GroupedTick | Staged
"""A tick that was compiled."""


@dataclass(frozen=True, eq=False)
class TickCode:
    """The C functions of a diagram's ticks, loaded.

    Attributes
    ----------
    ticks : mapping
        The ticks, by the clocks that act.
    exact : bool
        Whether all bits are those of an interpreted run. Tables and large matrix products are compiled in another form
        than they are interpreted in: there, signs of zeros may differ. Algebraic loops of more than `EXACT_LOOP`
        values are solved with another rounding.
    library : CDLL
        The library, which is loaded as long as this lives.
    loops : mapping
        Equations of the algebraic loops, by the clocks that act, where there are some.
    master : function or None
        The C function that goes over ticks; None for the one that all diagrams share.
    notes : tuple of str
        What a run tells of its code.
    """

    ticks: Mapping[frozenset[TickPattern], CompiledTick]
    exact: bool
    library: ctypes.CDLL
    loops: Mapping[frozenset[TickPattern], CompiledFunction | StagedEquations] = field(default_factory=dict)
    master: Any = None
    notes: tuple[str, ...] = ()


_COMPILED: WeakKeyDictionary[FlatDiagram, TickCode] = WeakKeyDictionary()


def find_obstacle(flat: FlatDiagram) -> str | None:
    """Return why a diagram's ticks can't be compiled; None if they can."""
    if flat.loops.slices and any(flat.table.blocks[path].opaque for path in flat.checked.traced):
        return "it has an algebraic loop beside blocks that Python evaluates, and Newton's method runs in C alone"
    return None


def compile_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickCode:
    """Compile the ticks at which these sets of clocks act.

    Small ones are one function of scalar operations, in which the values of one block are used by the next without a
    memory in between. Large ones, and those with blocks that are no scalar operations, are grouped: one function for
    each kind of block, called in a loop over all blocks of this kind. Their code knows no numbers and no wiring.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    FmuError
        If the cache can't be written.
    """
    flat = flat.origin  # other numbers change no code
    if flat in _COMPILED and tuple(_COMPILED[flat].ticks) == tuple(acting):
        return _COMPILED[flat]
    return write_ticks(flat, acting).load()


@dataclass(frozen=True, eq=False)
class TickSources:
    """The C code of a diagram's ticks, written.

    Attributes
    ----------
    texts : sequence of str
        The sources of its libraries.
    operations : int
        Operations in them.
    exact : bool
        Whether compiled ticks have the bits of interpreted ones; see `TickCode`.
    make : callable
        Makes the code of its libraries.
    """

    texts: Sequence[str]
    operations: int
    exact: bool
    make: Callable[[Sequence[ctypes.CDLL]], TickCode]

    def is_compiled(self) -> bool:
        """Whether the cache has all libraries, so that none has to be compiled.

        Raises
        ------
        CompilerError
            If there is no compiler.
        """
        return all(is_kept(text) for text in (*self.texts, master_source()))

    def load(self) -> TickCode:
        """Return the code; libraries that the cache lacks are compiled.

        Raises
        ------
        CompilerError
            If there is no compiler, or it fails.
        FmuError
            If the cache can't be written.
        """
        master()
        return self.make([load_compiled(text) for text in self.texts])


def write_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickSources:
    """Write the C code of the ticks at which these sets of clocks act; see `compile_ticks`."""
    ticks = None if flat.by_block else _write_straight(flat, acting)
    ticks = ticks or _write_grouped(flat, acting)
    loops = loop_functions(flat, acting)
    if not loops:
        return replace(ticks, make=lambda libraries: _COMPILED.setdefault(flat, ticks.make(libraries)))
    text = write_loops(loops)
    exact = ticks.exact and all(len(flat.active_loops(clocks)) <= EXACT_LOOP for clocks in loops)

    def make(libraries: Sequence[ctypes.CDLL]) -> TickCode:
        found = find_loops(loops, libraries[-1])
        return _COMPILED.setdefault(flat, replace(ticks.make(libraries), exact=exact, loops=found))

    count = sum(function.n_instructions() for function in loops.values())
    return TickSources([*ticks.texts, text], ticks.operations + count, exact, make)


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
    loops: Mapping[frozenset[TickPattern], Any], library: ctypes.CDLL
) -> dict[frozenset[TickPattern], CompiledFunction]:
    """Return the equations of algebraic loops in the library of `write_loops`."""
    return {clocks: CompiledFunction.find(f, library) for clocks, f in loops.items()}


def compile_loops(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]
) -> dict[frozenset[TickPattern], CompiledFunction]:
    """Return the equations of the algebraic loops at ticks, compiled: their mismatch, and its derivative."""
    loops = loop_functions(flat, acting)
    return find_loops(loops, load_compiled(write_loops(loops))) if loops else {}


def check_size(function: Any) -> None:
    """Refuse a function that is too large to be compiled as a whole.

    Raises
    ------
    CompilerError
        If it is.
    """
    if (count := function.n_instructions()) > LARGEST:
        raise CompilerError(
            f"a function of the diagram has {count} operations; at most {LARGEST} are compiled, as a compiler takes "
            "seconds for them. Leave out compile=True, or, if it is the derivative of the rates, take a solver without "
            "one: solver='RK45'."
        )


def _write_straight(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickSources | None:
    """Write ticks as one function each; None if they are no scalar operations."""
    found = {clocks: flat.at_tick(clocks).last.fast for clocks in acting}
    if not all(function.is_a("SXFunction") for function in found.values()):
        return None
    functions = {clocks: share_terms(f, f"tick{i}") for i, (clocks, f) in enumerate(found.items())}

    def make(libraries: Sequence[ctypes.CDLL]) -> TickCode:
        ticks = {clocks: CompiledFunction.find(f, libraries[0]) for clocks, f in functions.items()}
        return TickCode(ticks, True, libraries[0])

    count = sum(function.n_instructions() for function in functions.values())
    return TickSources([put_in_order(write_functions("ticks", functions.values()))], count, True, make)


def _write_grouped(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickSources:
    programs = {clocks: flat.program_at(clocks) for clocks in acting}
    kernels = write_kernels(flat, [tick.program for tick in programs.values()])

    def make(libraries: Sequence[ctypes.CDLL]) -> TickCode:
        address, of_python = address_of(libraries[0], "grouped"), kernels.of_python
        ticks = {clocks: GroupedTick(make_tables(p, kernels.of), of_python, address) for clocks, p in programs.items()}
        return TickCode(ticks, kernels.exact, libraries[0])

    return TickSources([kernels.source], kernels.operations, kernels.exact, make)


@lru_cache(maxsize=1)
def master() -> Any:
    """Return the C function that goes over ticks; it is compiled once on a machine.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    FmuError
        If the cache can't be written.
    """
    function = load_compiled(master_source())[MASTER]
    function.restype = None
    return function


def master_source() -> str:
    """Return the C text of the loop over ticks."""
    return read_sources("newton.c", "remote.c", "master.c")
