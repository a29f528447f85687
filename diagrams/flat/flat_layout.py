"""The layout of a flattened diagram: the place of everything in its vectors, and when it acts. Pure data.

A flattened diagram has five vectors: ``x``, the states of all blocks and whatever else is kept from one instant to the
next; ``w``, the outputs of what is stepped between ticks (FMUs, transport delays); ``z``, its inputs; ``p``, the
parameters; and ``log``, all outputs. A `FlatLayout` says where each thing is in them, holds their start values, and
lists the clocks, the events and the order of evaluation. It knows no CasADi and can be pickled: what runs the diagram
in another process, or in compiled code, needs this and the functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from ...blocks.core import Layout, Shape, explain_calls
from ..wiring import Order, Structure, join, stepped_blocks
from .clocks import EVERY, TickPattern, in_order
from .plant_ticks import find_plant_ticks, takes_any_step


@dataclass(frozen=True, repr=False)
class StateLayout(Layout):
    """Where the states of blocks are: by the block's path, and within a block by the state's name.

    A slice and the shape (n,) are those of all states of a block together; ``of_block["pid"].slices["integral"]`` is
    one.
    """

    of_block: dict[str, Layout]

    @classmethod
    def of_blocks(cls, shapes: Mapping[str, Mapping[str, Shape]], offset: int = 0) -> StateLayout:
        """Lay out the states of blocks, whose shapes are given by path and name, one block after the other."""
        of_block, first = {}, offset
        for path, states in shapes.items():
            of_block[path] = Layout.of(states, offset)
            offset += of_block[path].total
        blocks = Layout.of({path: (own.total,) for path, own in of_block.items()}, first)
        return cls(blocks.slices, blocks.shapes, of_block)

    @property
    def each(self) -> Layout:
        """The layout of all states, by ``path.name``."""
        names = [(join(path, name), own, name) for path, own in self.of_block.items() for name in own.slices]
        return Layout({full: own.slices[n] for full, own, n in names}, {full: own.shapes[n] for full, own, n in names})

    @property
    def labels(self) -> list[str]:
        """Names of all entries: ``path.name``, with the index of an element behind it."""
        return self.each.labels


@dataclass(frozen=True)
class FlatEvent:
    """An event of the flattened diagram: of a block, or of a subsystem that is enabled or triggered between ticks."""

    path: str
    name: str
    direction: str
    hysteresis: float
    subsystem: bool


@explain_calls
@dataclass(frozen=True, eq=False, kw_only=True)
class FlatLayout:
    """Where everything of a flattened diagram is, and when it acts.

    Attributes
    ----------
    table : Structure
        The blocks and wires.
    base : Fraction
        Seconds between two ticks.
    clocks : dict
        For every subsystem that is sampled: at which ticks it acts.
    states : StateLayout
        Where the states of the blocks are in x: by block, and by state.
    held, gates, starts, loops : Layout
        Where the other parts of x are: outputs that are held, what enabled and triggered subsystems remember of
        their control, start values of states that are reset, the last solution of algebraic loops.
    plant_outputs, plant_inputs, parameters, log : Layout
        Where things are in w, z, p and log.
    continuous : ndarray of int
        The entries of x that are integrated.
    events : tuple of FlatEvent
        All events between ticks.
    x0, p : ndarray
        Start values of x (before any block computes its own), and parameter values.
    order, start_order : Order
        In which order ports are evaluated at an instant, and at the start.
    ports : dict
        Block and port behind every dotted path; an FMU's port may have its own dots.
    apart : frozenset of str
        Blocks that an evaluator evaluates, in their own stages; see `loopwright.diagrams.flat.stages`.
    asked : bool
        Whether ``base`` was asked for, as a ``step``: then something happens at every tick.
    """

    table: Structure
    base: Fraction
    clocks: dict[str, TickPattern]
    states: StateLayout
    held: Layout
    gates: Layout
    starts: Layout
    loops: Layout
    plant_outputs: Layout
    plant_inputs: Layout
    parameters: Layout
    log: Layout
    continuous: np.ndarray
    events: tuple[FlatEvent, ...]
    x0: np.ndarray
    p: np.ndarray
    order: Order
    start_order: Order
    ports: dict[str, tuple[str, str]]
    apart: frozenset[str] = frozenset()
    asked: bool = False

    def __post_init__(self) -> None:
        for values in (self.continuous, self.x0, self.p):
            values.setflags(write=False)  # a run has its own

    @cached_property
    def unread(self) -> dict[str, slice]:
        """Where outputs of FMUs that nothing reads are in the log, by dotted path: these alone may be no numbers.

        Readers are wires and what enables or triggers subsystems; a name of a wire, and the record, are none.
        """
        wires = [*self.table.wires.values(), *self.table.controls.values()]
        read = {(wire.block, wire.port) for wire in wires}
        foreign = {
            path
            for path, block in self.table.blocks.items()
            if (block.stepped and not block.transport) or block.in_model_exchange
        }
        return {
            name: where
            for name, where in self.log.slices.items()
            if self.ports[name][0] in foreign and self.ports[name] not in read
        }

    @cached_property
    def unread_entries(self) -> np.ndarray:
        """Entries of the log of `unread`, ascending."""
        return np.array([i for where in self.unread.values() for i in range(where.start, where.stop)], dtype=np.int32)

    @property
    def width(self) -> int:
        """Number of entries of x."""
        return self.x0.size

    @cached_property
    def labels(self) -> list[str]:
        """Names of all entries of x: ``path.state`` of states, ``held(path.port)``, ``gate(path)`` and so on."""
        others = ((self.held, "held"), (self.gates, "gate"), (self.starts, "start"), (self.loops, "loop"))
        return self.states.labels + [f"{kind}({label})" for layout, kind in others for label in layout.labels]

    @property
    def continuous_labels(self) -> list[str]:
        """Names of the entries of x that are integrated."""
        return [self.labels[i] for i in self.continuous]

    @cached_property
    def around(self) -> dict[str, tuple[str, ...]]:
        """Paths of the enabled and triggered subsystems around the blocks of each subsystem, from outside in."""
        return {subsystem: self.table.gates(subsystem) for subsystem in self.table.subsystems}

    @cached_property
    def distinct(self) -> tuple[TickPattern, ...]:
        """The different clocks."""
        return in_order(set(self.clocks.values()))

    @cached_property
    def hybrid(self) -> bool:
        """Whether something happens between ticks: continuous states, events, or a transport delay."""
        return bool(self.continuous.size or self.events or self.has_delays or self.in_model_exchange)

    @cached_property
    def has_delays(self) -> bool:
        """Whether there is a transport delay in continuous time."""
        return any(self.table.blocks[self.ports[name][0]].transport for name in self.plant_inputs.slices)

    @cached_property
    def in_model_exchange(self) -> tuple[str, ...]:
        """Paths of the blocks in model exchange: a run evaluates their equations, and they have their own events."""
        return tuple(path for path in sorted(self.apart) if self.table.blocks[path].in_model_exchange)

    @cached_property
    def plant_ticks(self) -> dict[str, tuple[TickPattern, ...]]:
        """The ticks at which each plant steps, by path; see `loopwright.diagrams.flat.plant_ticks`."""
        return find_plant_ticks(self.table, self.clocks, self.base, every=self.asked)

    @cached_property
    def visited(self) -> tuple[TickPattern, ...]:
        """The ticks at which a subsystem acts or a plant steps."""
        found = {*self.distinct, *(clock for clocks in self.plant_ticks.values() for clock in clocks)}
        return (EVERY,) if EVERY in found or not found else in_order(found)

    @cached_property
    def even_plants(self) -> tuple[str, ...]:
        """Paths of what is stepped between ticks in steps of one length only."""
        return tuple(path for path, plant in stepped_blocks(self.table).items() if not takes_any_step(plant))

    def steps_at(self, path: str, k: int) -> bool:
        """Whether tick ``k`` is a communication point of a plant."""
        return any(clock.acts(k) for clock in self.plant_ticks[path])

    def next_step(self, path: str, k: int) -> int:
        """Return the first communication point of a plant after tick ``k``."""
        return min(clock.after(k) for clock in self.plant_ticks[path])

    def acting(self, k: int) -> frozenset[TickPattern]:
        """Return the clocks that tick at tick ``k``."""
        return frozenset([c for c in self.distinct if c.acts(k)])

    def ticks(self, k: int, last: int, *, every: bool) -> Iterator[int]:
        """Yield the ticks to visit after tick ``k``: all, or those at which something acts, and the last one."""
        if every or EVERY in self.visited:
            yield from range(k + 1, last + 1)
            return
        while (k := min(c.after(k) for c in self.visited)) < last:
            yield k
        yield last

    def taken_at(self, acting: frozenset[TickPattern]) -> np.ndarray:
        """Return the entries of x that a tick renews at which the given clocks act: what sampled subsystems keep."""
        if acting not in self._taken:
            owners = [(where, name) for part in (self.states, self.starts) for name, where in part.slices.items()]
            owners += [(where, self.ports[name][0]) for name, where in self.held.slices.items()]
            subsystems = [(where, self.table.subsystem_of[path]) for where, path in owners]
            subsystems += [(where, subsystem) for subsystem, where in self.gates.slices.items()]
            found = [np.arange(w.start, w.stop) for w, settings in subsystems if self.clocks.get(settings) in acting]
            self._taken[acting] = np.concatenate([*found, np.zeros(0, dtype=int)])
        return self._taken[acting]

    @cached_property
    def _taken(self) -> dict[frozenset[TickPattern], np.ndarray]:
        return {}

    def active_loops(self, acting: frozenset[TickPattern]) -> list[int]:
        """Return the entries of x that hold the torn ports that act, in the order in which they come round."""
        found: list[int] = []
        for path, names in self.order.steps if self.loops.slices else ():
            clock = self.clocks.get(self.table.subsystem_of[path])
            if clock is None or clock in acting:
                found += self.loops.entries(full for name in names if (full := join(path, name)) in self.loops.slices)
        return found


def sample_time_of(table: Structure, path: str) -> float:
    """Return the sample time of a block in s; NaN in continuous time, and where a trigger says when it acts."""
    subsystem = table.subsystem_of[path]
    rate = table.rate(subsystem)
    return math.nan if rate is None or table.triggered_around(subsystem) is not None else float(rate)
