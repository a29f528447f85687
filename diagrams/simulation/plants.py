"""The FMUs of a run: loaded, and bound to the vectors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np

from ...blocks.core.errors import LoopwrightError, SimulationError
from ..flat.flat_diagram import FlatDiagram
from ..flat.layout import Layout
from .workspace import Machine


def has_plants(flat: FlatDiagram) -> bool:
    """Whether an FMU is in a diagram."""
    return bool(_plants(flat))


def loaded(flat: FlatDiagram, stack: ExitStack, start_time: float = 0.0) -> Iterator[tuple[str, Any]]:
    """Yield the FMUs by path, each as soon as it is loaded; ``stack`` unloads them.

    They are told no end of the run: it may be gone on from, and an FMU may keep to the end that it was told.
    """
    for path, block in _plants(flat).items():
        try:
            wired = [port for port in block.inputs if (path, port) in flat.table.wires]
            yield path, stack.enter_context(block.instantiate(wired, None, start_time=start_time))
        except SimulationError as error:
            error.at(block=path, t=0.0)
            raise
        except LoopwrightError as error:
            error.at(block=path)
            raise


def bind(machine: Machine, plants: Iterable[tuple[str, Any]]) -> None:
    """Let the FMUs read their inputs from z and write their outputs to w."""
    flat = machine.flat
    for path, plant in plants:
        inputs = _part(flat, flat.plant_inputs, path, machine.z)
        plant.bind(inputs, _part(flat, flat.plant_outputs, path, machine.here.w))


def _plants(flat: FlatDiagram) -> dict[str, Any]:
    table = flat.table
    return {p: table.blocks[p] for p in sorted(table.blocks) if table.stepped(p) and not table.blocks[p].transport}


def _part(flat: FlatDiagram, layout: Layout, path: str, vector: np.ndarray) -> np.ndarray:
    mine = [s for name, s in layout.slices.items() if flat.ports[name][0] == path]
    return vector[mine[0].start : mine[-1].stop] if mine else vector[:0]
