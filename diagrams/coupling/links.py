"""Links between plants within a communication step: what an input follows, and what passes it straight on.

Loops of direct feedthrough across FMUs are reported where a coupling does not solve them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import OptionError, near
from ..flat import FlatDiagram
from ..wiring import Structure, join, stepped_blocks
from .coupling_options import Coupling, Scheme
from .plants import part_of

_KNOWN: WeakKeyDictionary[FlatDiagram, bool] = WeakKeyDictionary()
"""Whether wires close a loop across FMUs, by diagrams that have run: a tenth of the set-up of a run."""


@dataclass(frozen=True, eq=False)
class Links:
    """Links between the plants of a diagram: entries of their inputs z and of their outputs w."""

    flat: FlatDiagram  # signals that its sampled subsystems make are held between ticks, and make no link

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """Paths of the plants, in alphabetical order."""
        return tuple(stepped_blocks(self.flat.table))

    @cached_property
    def inputs(self) -> dict[str, slice]:
        """Where the inputs of each plant are in z."""
        return {path: part_of(self.flat, self.flat.plant_inputs, path) for path in self.paths}

    @cached_property
    def outputs(self) -> dict[str, slice]:
        """Where the outputs of each plant are in w."""
        return {path: part_of(self.flat, self.flat.plant_outputs, path) for path in self.paths}

    @cached_property
    def by_outputs(self) -> np.ndarray:
        """Which inputs follow which outputs between ticks, shape (inputs, outputs)."""
        found: np.ndarray = self.flat.exchange.depends("z", "w") & self._is_plant_input[:, None]
        return found

    @cached_property
    def by_states(self) -> np.ndarray:
        """Which inputs follow states that change between ticks, continuous ones or by events, shape (inputs,)."""
        flat = self.flat
        between = np.setdiff1d(np.arange(flat.width), flat.taken_at(frozenset(flat.distinct)))
        found = flat.exchange.depends("z", "x")[:, between].any(axis=1)
        return np.asarray(found & self._is_plant_input, dtype=bool)

    @cached_property
    def moving(self) -> np.ndarray:
        """Which inputs change between ticks: they follow outputs, states or the time, shape (inputs,)."""
        by_time = self.flat.exchange.depends("z", "t").any(axis=1) & self._is_plant_input
        return np.asarray(self.by_outputs.any(axis=1) | self.by_states | by_time)

    @cached_property
    def felt(self) -> np.ndarray:
        """Which outputs act on an input or on a block in continuous time between ticks, shape (outputs,)."""
        return np.asarray(self.by_outputs.any(axis=0) | self.felt_by_blocks)

    @property
    def exist(self) -> bool:
        """Whether anything is exchanged between ticks: else all schemes are the same."""
        return bool(self.moving.any() or self.felt.any())

    @cached_property
    def felt_by_blocks(self) -> np.ndarray:
        """Which outputs act on continuous states, events or delays of blocks between ticks, shape (outputs,)."""
        flat = self.flat
        found = flat.exchange.depends("z", "w")[~self._is_plant_input].any(axis=0)
        if flat.continuous.size:
            found = found | flat.flow.depends("dx", "w").any(axis=0)
        if flat.events:
            found = found | flat.indicators.depends("g", "w").any(axis=0)
        return np.asarray(found & self._is_plant_output)

    @cached_property
    def direct(self) -> np.ndarray:
        """Which outputs a plant computes straight from which inputs, shape (outputs, inputs); unknown: all."""
        ins, outs = self.flat.plant_inputs, self.flat.plant_outputs
        found = np.zeros((outs.total, ins.total), dtype=bool)
        for path, port, output in direct_ports(self.flat):
            found[outs.slices[join(path, output)], ins.slices[join(path, port)]] = True
        return found

    @cached_property
    def smooth_inputs(self) -> np.ndarray:
        """Which inputs take any real number, not integers or truth values alone, shape (inputs,)."""
        return self._smooth("input_variables", self.flat.plant_inputs.total, self.flat.plant_inputs.slices)

    @cached_property
    def smooth_outputs(self) -> np.ndarray:
        """Which outputs are real numbers, shape (outputs,)."""
        return self._smooth("output_variables", self.flat.plant_outputs.total, self.flat.plant_outputs.slices)

    def _smooth(self, variables: str, size: int, slices: dict[str, slice]) -> np.ndarray:
        found = np.ones(size, dtype=bool)
        for path in self.paths:
            for port, variable in getattr(self.flat.table.blocks[path], variables, {}).items():
                where = slices.get(join(path, port))
                if where is not None:
                    found[where] = not variable.is_integer
        return found

    @cached_property
    def nominals(self) -> np.ndarray:
        """Nominal values of the outputs, 1 where none is declared, shape (outputs,)."""
        found = np.ones(self.flat.plant_outputs.total)
        for path in self.paths:
            for port, variable in getattr(self.flat.table.blocks[path], "output_variables", {}).items():
                where = self.flat.plant_outputs.slices[join(path, port)]
                found[where] = np.abs(np.ravel(np.broadcast_to(variable.nominals, variable.shape)))
        return found

    @cached_property
    def _is_plant_input(self) -> np.ndarray:
        found = np.zeros(self.flat.plant_inputs.total, dtype=bool)
        for where in self.inputs.values():
            found[where] = True
        return found

    @cached_property
    def _is_plant_output(self) -> np.ndarray:
        found = np.zeros(self.flat.plant_outputs.total, dtype=bool)
        for where in self.outputs.values():
            found[where] = True
        return found

    def name_of_output(self, entry: int) -> tuple[str, str]:
        """Return the path of a plant and its port, with the index of an element, of an entry of w."""
        for name, where in self.flat.plant_outputs.slices.items():
            if where.start <= entry < where.stop:
                path, port = self.flat.ports[name]
                return path, port if where.stop - where.start == 1 else f"{port}[{entry - where.start + 1}]"
        raise IndexError(entry)

    # --- order and loops ----------------------------------------------------------------------------------------------

    def order(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """Return the order in which the plants step one after the other: the one wanted, or by feedthrough."""
        if wanted:
            for path in wanted:
                if path not in self.paths:
                    raise OptionError(f"found order={tuple(wanted)!r}. {near(path, self.paths)}", port="coupling")
            if sorted(wanted) != sorted(self.paths):
                raise OptionError(
                    f"found order={tuple(wanted)!r}; expected each of {', '.join(self.paths)} once.", port="coupling"
                )
            return tuple(wanted)
        straight = np.atleast_1d(self.direct.any(axis=0))
        # Next is the plant that waits for the fewest others: by inputs that it passes straight on, by all, by path.
        rest, found = [*self.paths], list[str]()

        def waits(path: str) -> tuple[int, int, str]:
            others = [p for p in rest if p != path]
            mine = self.by_outputs[self.inputs[path]]
            passed = mine[straight[self.inputs[path]]]
            counts = [sum(bool(m[:, self.outputs[p]].any()) for p in others) for m in (passed, mine)]
            return counts[0], counts[1], path

        while rest:
            found.append(min(rest, key=waits))
            rest.remove(found[-1])
        return tuple(found)

    def renewed_inputs(self, order: Sequence[str]) -> dict[str, np.ndarray]:
        """Return for each plant the inputs that are renewed before it steps, where one steps after the other."""
        # These follow outputs of the plants before it, or states of blocks, which have continued already.
        before = np.zeros(self.flat.plant_outputs.total, dtype=bool)
        found = {}
        for path in order:
            mine = self.inputs[path]
            fresh = self.by_outputs[mine][:, before].any(axis=1) | self.by_states[mine]
            found[path] = np.arange(mine.start, mine.stop)[fresh & self.smooth_inputs[mine]]
            before[self.outputs[path]] = True
        return found

    @cached_property
    def loops(self) -> tuple[tuple[str, ...], ...]:
        """Loops of direct feedthrough across plants: the ports that each goes through, from an output to an input."""
        step: np.ndarray = np.asarray(self.direct @ self.by_outputs, dtype=bool)  # from output to output
        found, seen = list[tuple[str, ...]](), set[int]()
        for first in range(len(step)):
            if first in seen:
                continue
            way = self._way_round(step, first)
            if way:
                seen.update(way)
                found.append(tuple(".".join(self.name_of_output(entry)) for entry in way))
        return tuple(found)

    @staticmethod
    def _way_round(step: np.ndarray, first: int) -> list[int]:
        """Return the shortest way from an entry back to itself; empty without one."""
        came: dict[int, int] = {}
        todo = [first]
        while todo:
            at = todo.pop(0)
            for after in np.flatnonzero(step[:, at]).tolist():
                if after == first:
                    way = [at]
                    while way[-1] != first:
                        way.append(came[way[-1]])
                    return way[::-1]
                if after not in came:
                    came[after] = at
                    todo.append(after)
        return []


def direct_ports(flat: FlatDiagram, *, wired: bool = False) -> set[tuple[str, str, str]]:
    """Return the plants with an input and an output that may follow it at once; a plant that doesn't say so may."""
    # ``wired``: only outputs that something is wired to.
    found, used = set(), {(wire.block, wire.port) for wire in flat.table.wires.values()}
    for path, block in stepped_blocks(flat.table).items():
        plant: Any = block
        ins, outs = (getattr(plant, f"{kind}_variables", None) for kind in ("input", "output"))
        for port in block.inputs:
            if join(path, port) in flat.plant_inputs.slices:
                for output in block.outputs:
                    if wired and (path, output) not in used:
                        continue
                    if ins is None or outs is None or plant.description.feeds_through(ins[port], outs[output]):
                        found.add((path, port, output))
    return found


def note_loops(flat: FlatDiagram, coupling: Coupling) -> tuple[str, ...]:
    """Return a message for each loop of direct feedthrough that the coupling leaves with values of the last step."""
    if coupling.scheme == Scheme.ITERATED:
        return ()
    if flat not in _KNOWN:
        _KNOWN[flat] = _may_loop(flat)
    if not _KNOWN[flat]:
        return ()
    return tuple(
        f"{', '.join(ports)}: by their model structures these outputs follow one another at once, in a loop across "
        "FMUs (an output without stated dependencies counts as one that follows all inputs). With coupling "
        f"{str(coupling)!r} each follows the others one communication step later. Take coupling='iterated', which "
        "solves the loop."
        for ports in Links(flat).loops
    )


def _may_loop(flat: FlatDiagram) -> bool:
    """Whether wires in continuous time close a loop through inputs that FMUs pass straight on; without any trace."""
    table, straight = flat.table, direct_ports(flat, wired=True)
    outputs = {(path, output) for path, _, output in straight}
    inputs = {(path, port) for path, port, _ in straight}
    after = {output: _inputs_behind(flat, table, *output) & inputs for output in outputs}
    follows = {
        output: {(path, other) for path, port, other in straight if (path, port) in reached}
        for output, reached in after.items()
    }
    for first in outputs:
        seen, todo = set[tuple[str, str]](), [*follows[first]]
        while todo:
            at = todo.pop()
            if at == first:
                return True
            if at not in seen:
                seen.add(at)
                todo += follows[at]
    return False


def _inputs_behind(flat: FlatDiagram, table: Structure, path: str, port: str) -> set[tuple[str, str]]:
    """Return the inputs of plants that a port reaches through blocks in continuous time."""
    found, seen = set[tuple[str, str]](), set[str]()
    todo = [(block, q) for (block, q), wire in table.wires.items() if (wire.block, wire.port) == (path, port)]
    while todo:
        block, q = todo.pop()
        if block in flat.plant_ticks:
            found.add((block, q))
        elif block not in seen and table.subsystem_of[block] not in flat.clocks:
            seen.add(block)
            todo += [(b, r) for (b, r), wire in table.wires.items() if wire.block == block]
    return found
