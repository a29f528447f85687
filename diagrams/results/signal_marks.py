"""Facts about signals that plots mark: set-points, held signals, limits. Read from the diagram of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...blocks.core import Block, primary_outputs
from ...blocks.library import (
    PID,
    DiscreteIntegrator,
    LimitedIntegrator,
    Pulse,
    PulseTrain,
    Requirement,
    ResettableIntegrator,
    Saturation,
    Step,
)

LIMITED = (Saturation, PID, LimitedIntegrator, ResettableIntegrator, DiscreteIntegrator)
"""Blocks whose first output stays within their parameters ``lower``, ``upper`` or ``limit``."""

STEPS = (Step, Pulse, PulseTrain)
"""Sources that keep their value between their jumps."""


def is_set_point(diagram: Any, port: tuple[str, str]) -> bool:
    """Whether a port is that of a source: a block without inputs and states, which is no FMU."""
    block = None if diagram is None else diagram.blocks.get(port[0])
    return block is not None and not block.inputs and not block.states and not block.stepped


def is_held(diagram: Any, port: tuple[str, str]) -> bool:
    """Whether a port keeps its value between samples: a source of steps, or one on a clock where others move."""
    block = None if diagram is None else diagram.blocks.get(port[0])
    if block is None or isinstance(block, STEPS):
        return block is not None
    if not (diagram.is_continuous or diagram.has_fmu):
        return False
    structure = diagram.structure
    return not block.stepped and structure.clock(structure.subsystem_of[port[0]]) is not None


def is_of_a_plant(diagram: Any, path: str) -> bool:
    """Whether a block is a plant, as far as a table knows: an FMU, or a block with states in continuous time."""
    block, structure = diagram.blocks.get(path), diagram.structure
    if block is None:
        return False
    return bool(block.stepped or (block.states and structure.clock(structure.subsystem_of[path]) is None))


def limits_of(diagram: Any, port: tuple[str, str]) -> tuple[float, ...]:
    """Return the limits of a port: its block's, those that its port declares, and those of requirements on it."""
    block = None if diagram is None else diagram.blocks.get(port[0])
    if block is None:
        return ()
    found: list[float] = []
    if isinstance(block, LIMITED) and primary_outputs(block.outputs)[:1] == [port[1]]:
        found += _bounds(block)
    declared = block.outputs.get(port[1])
    found += _numbers(getattr(declared, "minimum", None), getattr(declared, "maximum", None))
    for (reader, _), wire in diagram.wires.items():
        if (wire.block, wire.port) == port and isinstance(diagram.blocks[reader], Requirement):
            found += _bounds(diagram.blocks[reader])
    return tuple(dict.fromkeys(found))


def _bounds(block: Block) -> list[float]:
    limit = getattr(block, "limit", None)
    ends = (getattr(block, "lower", None), getattr(block, "upper", None))
    return _numbers(*ends) if limit is None else _numbers(-np.asarray(limit), limit)


def _numbers(*values: Any) -> list[float]:
    """Return the finite numbers among some limits, which may be None or arrays."""
    flat = [float(v) for value in values if value is not None for v in np.ravel(np.asarray(value, dtype=float))]
    return [v for v in flat if np.isfinite(v)]
