"""A flattened diagram: its layout with its functions, each traced once, when it is first asked for.

From the bottom up: `flat_layout` says where everything is, `evaluate` evaluates all blocks at an instant,
`flat_functions` makes schedules of it (`stages`), and the `FlatDiagram` keeps them. They are what is run,
differentiated and compiled. Nothing in it changes but these caches: a run has its own vectors, of parameters too.
"""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self, TypeVar, cast, overload
from weakref import WeakValueDictionary

import numpy as np

from ...blocks.core import Block, brief, count_of, explain_calls
from ..wiring import Checked, Structure
from . import flat_functions
from .block_functions import BlockFunctions
from .clocks import NONE, TickPattern
from .flat_layout import FlatLayout, sample_time_of
from .program import Cells, PartProgram, TickProgram
from .stages import Schedule
from .total_derivative import Derivative
from .trace_stages import trace_schedule

T = TypeVar("T")

LARGEST = 2_000
"""Operations of a tick up to which it is simplified as a whole: a C compiler's time grows faster than they do."""
_EACH = 3
"""Operations of a tick for each output value of an FMU: its size, the sum of sizes, the entry of the log."""
MOST_KEPT = 24
"""Functions of others that are kept with a diagram's own."""


class _shared(cached_property[T]):  # noqa: N801 (a decorator)
    """A property that is computed once for a diagram and for all that have other numbers alone."""

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> T: ...
    def __get__(self, instance: object, owner: type[Any] | None = None) -> Self | T:
        return super().__get__(instance.origin if isinstance(instance, FlatDiagram) else instance, owner)


@explain_calls
@dataclass(frozen=True, eq=False, kw_only=True)
class FlatDiagram(FlatLayout):
    """A diagram flattened into functions of an instant.

    It is a `FlatLayout` with functions. They take ``(t, x, w, p)``: the time, the vector of states, the outputs of FMUs
    and transport delays, and the parameters.

    Attributes
    ----------
    checked : Checked
        The traced equations of the blocks, and shapes and units of their outputs.
    """

    checked: Checked

    def __repr__(self) -> str:
        facts = (
            count_of(len(self.table.blocks), "block"),
            count_of(self.states.total, "state"),
            f"base {float(self.base):g} s",
        )
        return brief("flat diagram", *facts, then=".states, .log, .function")

    @property
    def layout(self) -> FlatLayout:
        """The layout alone: pure data, which can be pickled."""
        return FlatLayout(**{f.name: getattr(self, f.name) for f in fields(FlatLayout)})

    def with_apart(self, *paths: str) -> FlatDiagram:
        """Return the same diagram with some blocks evaluated by an `Evaluator`, in their own stages."""
        return replace(self, apart=frozenset(paths) | frozenset(self.in_model_exchange))

    def with_numbers(self, table: Structure, p: np.ndarray, x0: np.ndarray) -> FlatDiagram:
        """Return a diagram with other blocks, parameters and start values, which shares the functions of this one."""
        found = copy.copy(self)
        for values in (p, x0):
            values.setflags(write=False)
        found.__dict__.update(table=table, p=p, x0=x0, _origin=self.origin)
        return found

    @property
    def origin(self) -> FlatDiagram:
        """The diagram whose functions these are: it itself, or the one from which it has other numbers alone."""
        found: FlatDiagram = self.__dict__.get("_origin", self)
        return found

    # --- functions ---------------------------------------------------------------------------------------------------

    @_shared
    def blocks(self) -> BlockFunctions:
        """Return the functions of the blocks."""
        return BlockFunctions(self.checked.traced)

    @property
    def function(self) -> Any:
        """The CasADi function ``(t, x, w, p) -> (x_next, z, log, ok)`` of a tick at which all clocks act."""
        return self.at_tick(frozenset(self.clocks.values())).function

    def at_tick(self, acting: frozenset[TickPattern]) -> Schedule:
        """Return what happens at a tick at which the given clocks act, with the blocks of continuous subsystems.

        See `loopwright.diagrams.flat.flat_functions.trace_tick`. Without any clock it is an instant between ticks, and
        gives all outputs there.
        """
        if acting not in self._ticks:
            large = acting == NONE and self.by_block and not self.apart and self.continuous.size
            keep = self._rates.append if large and "flow" not in vars(self.origin) else None
            self._ticks[acting] = flat_functions.trace_tick(
                self, self.blocks, acting, by_block=self.by_block, keep=keep
            )
        return self._ticks[acting]

    def program_at(self, acting: frozenset[TickPattern]) -> TickProgram:
        """Return a tick at which the given clocks act as calls of block functions, for grouped code.

        It is large, and kept only as long as somebody holds it.
        """
        found = self._programs.get(acting)
        if found is None:
            found = self._programs[acting] = flat_functions.trace_tick_program(self, self.blocks, acting)
        return found

    @_shared
    def _programs(self) -> WeakValueDictionary[frozenset[TickPattern], TickProgram]:
        return WeakValueDictionary()

    def part_program(self, name: str) -> PartProgram:
        """Return "flow", "indicators", "jump" or "driven" as calls of block functions, for grouped code."""
        if name == "flow":  # the blocks are gone through once for the tick at which no clock acts, and for this
            tick = self.program_at(NONE)
            assert tick.rates is not None
            return PartProgram.of(tick.program, Cells(tick.program, tick.rates))
        return flat_functions.trace_part_program(self, self.blocks, name)

    @_shared
    def by_block(self) -> bool:
        """Whether a tick is evaluated block by block: it is large, or has blocks that Python evaluates.

        It is large by the operations of its blocks, and by the outputs of its FMUs: code for the whole has a statement
        for each value, code by block goes over tables.

        This holds for interpreted and compiled runs. In another one, operations of several blocks are simplified
        together.
        """
        if any(self.table.blocks[path].opaque for path in self.checked.traced):
            return True
        return self.operations + _EACH * self.plant_outputs.total > LARGEST

    @cached_property
    def operations(self) -> int:
        """Number of operations of all blocks together."""
        functions = (self.blocks.of(path, names) for path, names in self.order.steps)
        return sum(int(function.n_instructions()) for function in functions)

    @_shared
    def _ticks(self) -> dict[frozenset[TickPattern], Schedule]:
        return {}

    @_shared
    def _rates(self) -> list[flat_functions.TracedRates]:
        """Rates of a large diagram that a tick has made by the way, until `flow` takes them."""
        return []

    @_shared
    def flow(self) -> Schedule:
        """Return the rates of the continuous states between ticks, ``(t, x, w, p) -> dx``."""
        if self._rates:
            symbols, dx = self._rates.pop()
            return trace_schedule("flow", symbols, lambda apart: {"dx": dx})
        return flat_functions.trace_between(self, self.blocks, "flow")

    @_shared
    def jacobian(self) -> Derivative:
        """Return the derivative of `flow` by the continuous states, ``(t, x, w, p) -> (n, n)``."""
        return Derivative(self.flow, [("x", self.continuous.tolist())], values=False)

    @_shared
    def jacobian_with_loops(self) -> Derivative:
        """Return the derivatives of `flow` and of algebraic loops' mismatch, by continuous states and loops."""
        return flat_functions.differentiate_flow_with_loops(self, self.blocks)

    @_shared
    def indicators(self) -> Schedule:
        """``(t, x, w, p) -> (g, open)``: indicators of `events`, and whether the subsystems around them are enabled."""
        return flat_functions.trace_between(self, self.blocks, "indicators")

    @_shared
    def jump(self) -> Schedule:
        """``(t, x, w, p, fired) -> x_next``: x after events."""
        return flat_functions.trace_between(self, self.blocks, "jump")

    @_shared
    def driven(self) -> Schedule:
        """``(t, x, w, p) -> z`` between ticks: the inputs of transport delays, and of FMUs."""
        return flat_functions.trace_between(self, self.blocks, "driven")

    @_shared
    def exchange(self) -> Schedule:
        """``(t, x, w, p, log) -> z`` between ticks: the inputs of plants, with outputs of sampled blocks from log."""
        return flat_functions.trace_model_exchange(self, self.blocks)

    def output(self, port: tuple[str, str]) -> Schedule:
        """Return ``(t, x, w, p) -> y``: an output between ticks, without entries where nothing evaluates it then."""
        return flat_functions.trace_output(self, self.blocks, port)

    def loop_equations(self, acting: frozenset[TickPattern]) -> Derivative | None:
        """Return ``(t, x, w, p) -> (r, J)``: the mismatch of the algebraic loops at the values in x, and ∂r/∂values.

        None where no torn port acts.
        """
        if acting not in self._loops:
            self._loops[acting] = flat_functions.trace_loops(self, self.blocks, acting)
        return self._loops[acting]

    @_shared
    def _loops(self) -> dict[frozenset[TickPattern], Derivative | None]:
        return {}

    def keep(self, key: Any, make: Callable[[], T]) -> T:
        """Return what others have made of these functions, by a key of theirs: it is made once, also for other numbers.

        The last ones are kept. What is made must depend on the functions and the key alone, never on numbers.
        """
        kept = self._kept
        if key not in kept:
            made = make()
            while len(kept) >= MOST_KEPT:
                kept.pop(next(iter(kept)))
            kept[key] = made
        kept[key] = kept.pop(key)  # the last one asked for
        return cast("T", kept[key])

    @_shared
    def _kept(self) -> dict[Any, Any]:
        return {}

    @_shared
    def made(self) -> defaultdict[str, dict[Any, Any]]:
        """Return what others have made of its functions to run them, by kind and by their own keys.

        It is here, and not in tables of theirs with weak keys: what is made often refers to the diagram, which such
        a table would then keep for ever.
        """
        return defaultdict(dict)

    def pack(self, path: str, block: Block) -> np.ndarray:
        """Return the entries of p of a block if it had the parameters of another one, of equal structure."""
        times = self._sample_times
        if path not in times:
            times[path] = sample_time_of(self.table, path)
        return self.checked.traced[path].pack(block, times[path])

    @_shared
    def _sample_times(self) -> dict[str, float]:
        return {}

    def symbols(self) -> dict[str, Any]:
        """Return fresh symbols of t, x, w and p, by these names: arguments of `evaluate`."""
        return flat_functions.make_symbols(self)
