"""The plants of a run: loaded, and bound to the vectors. A plant is stepped from outside, as an FMU is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import Layout, LoopwrightError, SimulationError
from ..flat import FlatDiagram, own_step
from ..wiring import stepped_blocks

NEAR = 1e-9
"""Relative distance up to which a communication step is a multiple of a plant's own."""


class Plant(Protocol):
    """A stepped block in a run, as its ``instantiate`` yields it: `bind`, `model_exchange`, `begin`, then each `step`.

    A protocol: instances of FMUs come from the package `fmus`, which this sub-package doesn't know, others from users.
    """

    @property
    def messages(self) -> Sequence[str]:
        """Messages of the run so far."""

    @property
    def failed(self) -> bool:
        """Whether its last call failed, so that neither its outputs nor its state can be used."""

    def bind(self, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Take the vectors that it shares with the run: (n,) of wired inputs to read, (m,) of outputs to write."""

    @property
    def exchange(self) -> Callable[[], None]:
        """Read the inputs and write the outputs that follow from them at the start, before `begin`."""

    def begin(self) -> None:
        """Write the outputs with which the run begins."""

    @property
    def step(self) -> Callable[[float, float], None]:
        """``step(t, h)``: read the inputs, go from t to t + h (both in s), write the outputs there."""

    def operating_point(self) -> dict[str, Any]:
        """Return its time ``t`` in s, ``state`` and ``inputs`` by name."""

    @property
    def can_serialize(self) -> bool:
        """Whether `serialize` works."""

    def serialize(self) -> bytes:
        """Return its complete state."""

    def deserialize(self, data: bytes) -> Any:
        """Make a state, for `restore`, from the bytes of `serialize`."""

    def restore(self, state: Any) -> None:
        """Go to a state, and write the outputs there."""


def note_steps(flat: FlatDiagram, *, step: object) -> tuple[str, ...]:
    """Return messages on the communication steps of plants; ``step`` is that which the run was asked for, or None."""
    known = _KNOWN.setdefault(flat, {})
    if (is_own := step is None) not in known:
        known[is_own] = (*(_note_fine_steps(flat) if is_own else ()), *_note_parts_of_steps(flat))
    return known[is_own]


_KNOWN: WeakKeyDictionary[FlatDiagram, dict[bool, tuple[str, ...]]] = WeakKeyDictionary()
"""The messages on diagrams that have run, by whether no step was asked for: each run has the same."""


def _note_fine_steps(flat: FlatDiagram) -> tuple[str, ...]:
    """Return a message for each plant that steps more finely than any subsystem acts, as it can't do otherwise."""
    shortest = min((clock.every for clock in flat.distinct), default=0)
    found = []
    for path in flat.even_plants:
        own = min(clock.every for clock in flat.plant_ticks[path])
        if own >= shortest or own_step(flat.table.blocks[path]) is not None:
            continue
        found.append(
            f"{path}: takes steps of one length only, so it goes by the common base of the sample times that it is "
            f"wired to, {float(own * flat.base):.6g} s, {shortest / own:.6g} times finer than the fastest subsystem. "
            "Take sample times of which the shortest divides the others, or an FMU with "
            "canHandleVariableCommunicationStepSize."
        )
    return tuple(found)


def _note_parts_of_steps(flat: FlatDiagram) -> tuple[str, ...]:
    """Return a message for each plant whose communication steps are no multiples of the fixed step that it states."""
    found = []
    for path, block in stepped_blocks(flat.table).items():
        own = getattr(block, "fixed_internal_step", None)
        if not own:
            continue
        h = float(min(clock.every for clock in flat.plant_ticks[path]) * flat.base)
        if h < own * (1.0 - NEAR) or abs(h / own - round(h / own)) > NEAR * h / own:
            found.append(
                f"{path}: its solver has steps of {own:.6g} s (fixedInternalStepSize), of which its communication "
                f"steps of {h:.6g} s are no multiples: its outputs may belong to another time. Take sample times, or a "
                "step, that are multiples."
            )
    return tuple(found)


def load_plants(flat: FlatDiagram, stack: ExitStack, start_time: float = 0.0) -> Iterator[tuple[str, Plant]]:
    """Yield the plants by path, each as soon as it is loaded; ``stack`` unloads them."""
    # No end of the run is passed: it may be continued, and an FMU may keep to the end that it was given.
    for path, block in stepped_blocks(flat.table).items():
        stepped: Any = block  # an `Fmu`, or a block of a user's; see `loopwright.Block` for ``instantiate``
        try:
            wired = [port for of, port in map(flat.ports.__getitem__, flat.plant_inputs.slices) if of == path]
            plant: Plant = stack.enter_context(stepped.instantiate(wired, None, start_time=start_time))
            yield path, plant
        except SimulationError as error:
            error.at(block=path, t=0.0)
            raise
        except LoopwrightError as error:
            error.at(block=path)
            raise


def bind(flat: FlatDiagram, plants: Mapping[str, Plant], inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Let the plants read their inputs from a vector like z, and write their outputs to one like w."""
    for path, plant in plants.items():
        own = part_of(flat, flat.plant_inputs, path), part_of(flat, flat.plant_outputs, path)
        plant.bind(inputs[own[0]], outputs[own[1]])


def part_of(flat: FlatDiagram, layout: Layout, path: str) -> slice:
    """Return where the ports of a plant are in z or w."""
    mine = [s for name, s in layout.slices.items() if flat.ports[name][0] == path]
    return slice(mine[0].start, mine[-1].stop) if mine else slice(0, 0)
