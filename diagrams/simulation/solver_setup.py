"""What a solver is told of a diagram, and what it remembers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..flat.flat_diagram import FlatDiagram

_MEMORY = ("planned", "_hits", "_misses", "_easy")


def solver_memory(solver: Any) -> dict[str, Any]:
    """Return what a solver would do next: its step, and the method that the default has chosen."""
    kept = {name: getattr(solver, name) for name in _MEMORY if hasattr(solver, name)}
    if hasattr(solver, "_active"):
        kept["active"] = solver._active.name
        kept["methods"] = {m.name: solver_memory(m) for m in (solver._explicit, solver._implicit)}
    return kept


def recall(solver: Any, kept: dict[str, Any]) -> None:
    """Let a solver go on as the one did whose `solver_memory` it is; another method starts anew."""
    for name in _MEMORY:
        if name in kept and hasattr(solver, name):
            setattr(solver, name, kept[name])
    if "active" in kept and hasattr(solver, "_active"):
        for method in (solver._explicit, solver._implicit):
            if method.name in kept["methods"]:
                recall(method, kept["methods"][method.name])
            if method.name == kept["active"]:
                solver._active = method


def time_scale_of(flat: FlatDiagram) -> float:
    """Return the shortest time within which a source in a continuous frame changes."""
    table = flat.table
    paths = (p for p in flat.checked.traced if not table.is_sampled(table.frame_of[p]))
    return min((float(table.blocks[p].time_scale()) for p in paths), default=math.inf)


def remembers(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous frame has a memory, such as a projection's last foot point."""
    table = flat.table
    return any(table.blocks[p].memory and not table.is_sampled(table.frame_of[p]) for p in flat.checked.traced)


def absolute_tolerances(flat: FlatDiagram, atol: float) -> Any:
    """Return the absolute tolerance of each continuous state: ``atol`` times its nominal value."""
    scale = np.ones(flat.width)
    for path, own in flat.states.of_block.items():
        for name, where in own.slices.items():
            nominal = flat.table.blocks[path].states[name].nominal
            scale[where] = 1.0 if nominal is None else nominal
    scale = scale[flat.continuous]
    return atol if np.all(scale == 1.0) or np.ndim(atol) else atol * scale
