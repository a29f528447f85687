"""The functions of a diagram behind the pointers of the loop in C: which there are, and in which form they are written.

A diagram has a function for each set of clocks that act together, the equations of its algebraic loops at these ticks,
and, where something happens between ticks, rates, indicators of events and so on. Two forms make them: small diagrams
are *expanded*, large ones *grouped*. Each form is written once; C code or the virtual machine then evaluates it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from ...fmus.export import describe_processor, processor_flags
from ..flat import NONE, FlatDiagram, TickPattern
from .bound_functions import CodeOfFunctions, CompiledFunction, FunctionInC, GeneratedCode, Machine
from .compiled_libraries import is_kept, load_compiled, load_runtime, runtime_is_kept
from .expanded_functions import ExpandedFunctions, LoopEquations
from .grouped_functions import GroupedFunctions
from .rate_differences import SlopesByDifferences
from .step_outputs import may_fail_at_steps

FUSING = ("-finline-functions", "-freciprocal-math", "-fno-tree-vectorize", "-fno-tree-slp-vectorize")
"""Flags of fused code: a parameter's inverse is computed once; vectors of few values cost more than they save."""


@dataclass(frozen=True, eq=False)
class DiagramCode:
    """The functions of a diagram as the loop in C calls them, loaded.

    ``exact`` says whether all bits are those of an interpreted run. Tables and large matrix products are compiled in
    another form than they are interpreted in: there, signs of zeros may differ.
    """

    ticks: Mapping[frozenset[TickPattern], FunctionInC]  # by the clocks that act; without any it is between ticks
    between: Mapping[str, FunctionInC]  # by the names of `functions_between`
    loops: Mapping[frozenset[TickPattern], FunctionInC]  # equations of the algebraic loops at ticks that have some
    exact: bool
    library: ctypes.CDLL  # loaded as long as this lives
    steps: Mapping[str, int] = field(default_factory=dict)  # addresses of steps that were made for its rates, by method
    operations_of_rates: int = 0  # of one evaluation
    judged: bool = False  # outputs may be non-finite after a solver's step though states are finite
    run_ticks: Any = None  # goes over ticks; None for the one that all diagrams share
    notes: tuple[str, ...] = ()  # what a run reports of its code

    @property
    def calls_python(self) -> bool:
        """Whether C has Python evaluate parts of its functions."""
        every = (*self.ticks.values(), *self.between.values(), *self.loops.values())
        return any(function.calls_python for function in every)

    @property
    def slope(self) -> CompiledFunction | SlopesByDifferences | None:
        """The derivative of the rates; None where nobody asks for it."""
        found = self.between.get("slope")
        assert found is None or isinstance(found, CompiledFunction | SlopesByDifferences)
        return found

    def hand_over(self, to: DiagramCode) -> None:
        """Let generated code take the place of the virtual machine wherever these functions are bound."""
        pairs: list[tuple[Mapping[Any, FunctionInC], Mapping[Any, FunctionInC]]]
        pairs = [(self.ticks, to.ticks), (self.loops, to.loops), (self.between, to.between)]
        for own, other in pairs:
            for name, function in own.items():
                function.hand_over(other[name])


class Sources:
    """A diagram's functions, of which C code is written when it is asked for."""

    def __init__(self, functions: ExpandedFunctions | GroupedFunctions, loops: LoopEquations | None, *, judged: bool):
        self._functions, self._loops, self._judged = functions, loops, judged
        self._parts = [functions, *([] if loops is None else [loops])]
        self.operations = sum(part.operations for part in self._parts)
        self.exact = all(part.exact for part in self._parts)
        """Whether generated code has the bits of an interpreted run; see `DiagramCode`."""
        self._loaded = dict[tuple[str, ...], DiagramCode]()

    @cached_property
    def texts(self) -> list[str]:
        """The C code, a library each."""
        return [part.text() for part in self._parts]

    def is_compiled(self) -> bool:
        """Whether the cache has all libraries, so that none has to be compiled."""
        return runtime_is_kept() and all(is_kept(text) for text in self.texts)

    def load(self, *, fuse: bool = False) -> DiagramCode:
        """Return the generated code, each time the same; libraries that the cache lacks are compiled.

        With ``fuse`` it is compiled for the processor of this machine, with products and sums fused.
        """
        flags, known = ((*processor_flags(), *FUSING), describe_processor()) if fuse else ((), "")
        if flags not in self._loaded:
            load_runtime()  # if it can't be compiled, the run is interpreted
            libraries = [GeneratedCode(load_compiled(text, flags, known)) for text in self.texts]
            self._loaded[flags] = self._find(libraries)
        return self._loaded[flags]

    def on_machine(self) -> DiagramCode:
        """Return the functions for the virtual machine: nothing is compiled."""
        return self.find(Machine(load_runtime()))

    def find(self, code: CodeOfFunctions) -> DiagramCode:
        """Return the functions where C finds all of them in one place."""
        return self._find([code] * len(self._parts))

    def _find(self, libraries: Sequence[CodeOfFunctions]) -> DiagramCode:
        code = libraries[0]
        ticks, between = self._functions.find(code)
        return DiagramCode(
            ticks,
            between,
            {} if self._loops is None else self._loops.find(libraries[-1]),
            self.exact or not isinstance(code, GeneratedCode),
            code.library,
            self._functions.find_steps(code),
            self._functions.operations_of_rates,
            self._judged,
        )


def find_obstacle(flat: FlatDiagram) -> str | None:
    """Return why there can't be generated code of a diagram; None if there can."""
    blocks = flat.table.blocks
    opaque = sorted(path for path in flat.checked.traced if blocks[path].opaque and path not in flat.in_model_exchange)
    if opaque and flat.in_model_exchange:
        return (
            f"Python evaluates the block {opaque[0]!r} next to the FMU {flat.in_model_exchange[0]!r} in model exchange"
        )
    if opaque and flat.loops.slices:
        return f"it has an algebraic loop next to the block {opaque[0]!r}, which Python evaluates"
    return None


def functions_between(flat: FlatDiagram, *, stiff: bool) -> tuple[str, ...]:
    """Return the names of a diagram's functions between ticks: rates, their derivative where ``stiff``, and so on."""
    has_jumps = flat.events or flat.in_model_exchange  # FMUs in model exchange have events of their own
    return (
        "flow",
        *(("slope",) if stiff else ()),
        *(("indicators",) if flat.events else ()),
        *(("jump",) if has_jumps else ()),
        *(("driven",) if flat.has_delays else ()),
    )


def compile_code(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], between: tuple[str, ...] = (), *, fuse: bool = False
) -> DiagramCode:
    """Compile the functions of a diagram; see `write_code` and `Sources.load`."""
    return code_sources(flat, acting, between).load(fuse=fuse)


def interpret_code(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], between: tuple[str, ...] = ()
) -> DiagramCode:
    """Return the functions of a diagram for the virtual machine; see `write_code`."""
    return code_sources(flat, acting, between).on_machine()


def code_sources(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], between: tuple[str, ...] = ()) -> Sources:
    """Return the functions of a diagram, the same ones for the next run; other numbers change no code."""
    known: dict[tuple[Any, ...], Sources] = flat.made["code"]
    key = tuple(acting), between
    if key not in known:
        known[key] = write_code(flat.origin, acting, between)
    return known[key]


def write_code(
    flat: FlatDiagram,
    acting: Sequence[frozenset[TickPattern]],
    between: tuple[str, ...] = (),
    *,
    whole: bool = False,
) -> Sources:
    """Return the functions of a diagram, to be written as C code.

    Small diagrams are expanded: each function is one of scalar operations, in which the values of one block are used by
    the next without a memory in between. Large ones, by the rule of `FlatDiagram.by_block`, are grouped: one function
    for each kind of block, called in a loop over all blocks of this kind. Their code knows no numbers and no wiring,
    and the derivative of their rates is computed by differences. Diagrams with algebraic loops between ticks are
    expanded, and so are those with FMUs in model exchange.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    acting : sequence of frozenset of TickPattern
        The sets of clocks that act together.
    between : tuple of str
        The functions between ticks that are wanted, see `functions_between`; empty where nothing happens there.
    whole : bool
        Expand a large diagram, too.
    """
    kinds = (NONE, *(clocks for clocks in acting if clocks)) if between else tuple(acting)
    small = whole or not flat.by_block or (between and flat.active_loops(NONE)) or flat.in_model_exchange
    functions = (ExpandedFunctions if small else GroupedFunctions)(flat, kinds, between)
    equations = LoopEquations(flat, kinds)
    loops = equations if equations.functions else None
    judged = bool(between) and (bool(flat.in_model_exchange) or may_fail_at_steps(flat))
    return Sources(functions, loops, judged=judged)
