"""Variables of an exported diagram: inputs, outputs, signals, parameters and states, and where their values are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from ...blocks.tracing import traced_parameters
from ...fmus.export import ComputedNumbers, Placed, Variable, parameter_variable
from ..flat import FlatDiagram, TickPattern
from ..wiring import Wire, join
from .open_diagram import OpenDiagram


class ExportedVariables:
    """The variables of an exported diagram."""

    def __init__(
        self,
        opened: OpenDiagram,
        flat: FlatDiagram,
        x: np.ndarray,
        untraced: Sequence[str],
        numbers: Mapping[str, tuple[ComputedNumbers, Any]],
    ):
        self._x = x
        self.are_rates_shown = False
        self._opened, self._flat, self._untraced, self._numbers = opened, flat, untraced, numbers
        self._outputs = {self._place(wire): name for name, wire in opened.outputs.items()}

    def _place(self, wire: Wire) -> tuple[int, ...]:
        """Return the entries of the log that a wire takes."""
        full = join(wire.block, wire.port)
        layout = self._flat.plant_outputs if full in self._flat.plant_outputs.slices else self._flat.log
        return tuple(np.ravel(layout.slices[full].start + wire.entries(layout.shapes[full])).tolist())

    def _shape(self, wire: Wire) -> tuple[int, ...]:
        return wire.entries(self._flat.log.shapes[join(wire.block, wire.port)]).shape

    def inputs(self) -> tuple[Placed, ...]:
        """Return the inputs."""
        opened, flat = self._opened, self._flat
        if not opened.outside:
            return ()
        block: Any = opened.wired.blocks[opened.outside]
        found = []
        for name, port in block.outputs.items():
            where = flat.plant_outputs.slices[join(opened.outside, name)]
            start = block.start_of(name).reshape(port.shape)
            about = _unit(port.unit), port.description
            variable = Variable(name, "input", "continuous", port.shape, *about, start=start)
            found.append(Placed(variable, "w", tuple(range(where.start, where.stop)), is_sampled(flat)))
        return tuple(found)

    def _signal(self, name: str, wire: Wire, causality: Any) -> Placed:
        opened = self._opened
        unit = opened.wired.checked.units.get((wire.block, wire.port))
        if isinstance(unit, tuple):
            unit = unit[wire.index] if isinstance(wire.index, int) else None
        port = self._flat.table.blocks[wire.block].outputs[wire.port]
        sampled = self._flat.table.is_sampled(self._flat.table.subsystem_of[wire.block])
        variable = Variable(name, causality, "continuous", self._shape(wire), _unit(unit), port.description)
        vector = "w" if join(wire.block, wire.port) in self._flat.plant_outputs.slices else "log"
        return Placed(variable, vector, self._place(wire), sampled, self._clock(wire.block))

    def _clock(self, path: str) -> int | None:
        """Return the number of the clock that a block acts at."""
        clock = self._flat.clocks.get(self._flat.table.subsystem_of[path])
        return None if clock is None else self._flat.distinct.index(clock)

    def clocked(self) -> tuple[str, ...]:
        """Return the subsystems of each clock, by their paths; none for the whole."""
        flat, found = self._flat, []
        for clock in flat.distinct:
            paths = [self._opened.shown(path) for path, own in flat.clocks.items() if own == clock and path]
            found.append(", ".join(paths))
        return tuple(found)

    def outputs(self) -> tuple[Placed, ...]:
        """Return the outputs."""
        return tuple(self._signal(name, wire, "output") for name, wire in self._opened.outputs.items())

    def signals(self) -> tuple[Placed, ...]:
        """Return the named wires that are no outputs; one with the name of an input is left out."""
        opened = self._opened
        taken = {*opened.outputs, *(one.variable.name for one in self.inputs())}
        found = []
        for full, wire in sorted(opened.wired.scheduled.names.items()):
            name = opened.shown(full)
            if name not in taken and wire.block != opened.outside:
                found.append(self._signal(name, wire, "local"))
        return tuple(found)

    def parameters(self) -> tuple[Placed, ...]:
        """Return the parameters that are symbols in the functions, with all that is computed from them."""
        flat = self._flat
        found = []
        for path in flat.checked.traced:
            block = flat.table.blocks[path]
            if path in self._numbers and self._numbers[path][1] is None:
                continue
            first = flat.parameters.slices[path].start
            for key, value in traced_parameters(block):
                size = int(np.size(value))
                if np.all(np.ravel(value) != 0) or join(path, key) in self._opened.moved:  # zeros are structure
                    variable = parameter_variable(block, key, value, join(self._opened.shown(path), key))
                    found.append(Placed(variable, "p", tuple(range(first, first + size))))
                first += size
        return tuple(found)

    def states(self) -> tuple[Placed, ...]:
        """Return the states of blocks."""
        flat = self._flat
        found = []
        shown = flat.continuous.tolist() if self.are_rates_shown else []
        rate_of = {entry: i for i, entry in enumerate(shown)}
        for path, own in flat.states.of_block.items():
            block = flat.table.blocks[path]
            for name, where in own.slices.items():
                port = block.states[name]
                shape = own.shapes[name]
                computed = block.starts_from_inputs and path not in self._untraced
                start = None if computed else np.array(self._x[where]).reshape(shape)
                label, about = self._state_label(path, name), (_unit(port.unit), port.description)
                kind: Literal["continuous", "discrete"] = "continuous" if computed else "discrete"
                variable = Variable(label, "local", kind, shape, *about, start=start, state=not computed)
                places = tuple(range(where.start, where.stop))
                rates = () if computed else tuple(rate_of[i] for i in places if i in rate_of)
                found.append(Placed(variable, "x", places, not rates, self._clock(path), rates))
        if sum(len(one.rates) for one in found) < len(
            rate_of
        ):  # some are computed, and none is shown without the others
            found = [replace(one, sampled=True, rates=()) for one in found]
        return tuple(found)

    def found_at_build(self) -> tuple[str, ...]:
        """Return the names of the states whose start is not computed by the exported code."""
        own = self._flat.states.of_block
        return tuple(self._state_label(path, name) for path in self._untraced for name in own[path].slices)

    def _state_label(self, path: str, name: str) -> str:
        """Return the name of a state; of one that is an output, too, with a word more, as each is a variable."""
        label = join(self._opened.shown(path), name)
        while label in self._opened.outputs:
            label += "_state"
        return label

    def depends(self, acting: Sequence[frozenset[TickPattern]]) -> dict[str, tuple[int, ...]]:
        """Return the entries of w on which outputs and signals depend at an instant, at any kind of tick."""
        flat = self._flat
        found: dict[int, set[int]] = {}
        for clocks in acting:
            tick = flat.at_tick(clocks)
            sparsity = tick.last.fast.jac_sparsity(tick.results.index("log"), tick.arguments.index("w"))
            for row, column in zip(*sparsity.get_triplet(), strict=True):
                found.setdefault(row, set()).add(column)
        every = (*self.outputs(), *self.signals())
        return {
            one.variable.name: tuple(sorted({w for place in one.places for w in found.get(place, ())})) for one in every
        }

    def labels(self) -> tuple[tuple[str, str, int, int], ...]:
        """Return the outputs of blocks in the order of evaluation, with their places in the log."""
        flat = self._flat
        found = []
        for path, names in flat.order.steps:
            for name in names:
                where = flat.log.slices.get(join(path, name))
                if where is not None:
                    found.append((self._opened.shown(path), name, where.start, where.stop - where.start))
        return tuple(found)


def _unit(unit: object) -> str | None:
    return unit if isinstance(unit, str) else None


def is_sampled(flat: FlatDiagram) -> bool:
    """Whether all blocks act at ticks only."""
    return all(flat.table.is_sampled(flat.table.subsystem_of[path]) for path in flat.checked.traced)
