"""Facts of a diagram that its method of integration is set up with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...blocks.core import Block, SimulationError, identity
from ..flat import Announcer, FlatDiagram, Times


def time_scale_of(flat: FlatDiagram) -> float:
    """Return the shortest time within which a source in a continuous subsystem changes."""
    table = flat.table
    paths = (p for p in flat.checked.traced if not table.is_sampled(table.subsystem_of[p]))
    return min((float(table.blocks[p].time_scale()) for p in paths), default=math.inf)


def remembers(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous subsystem has a memory, such as a projection's last foot point."""
    table = flat.table
    return any(table.blocks[p].memory and not table.is_sampled(table.subsystem_of[p]) for p in flat.checked.traced)


def has_guards(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous subsystem has guards, which are looked at after every step."""
    table, traced = flat.table, flat.checked.traced
    return any(traced[p].guards and not table.is_sampled(table.subsystem_of[p]) for p in traced)


def absolute_tolerances(flat: FlatDiagram, atol: float, nominals: np.ndarray | None = None) -> Any:
    """Return the absolute tolerance of each continuous state: ``atol`` times its nominal value."""
    # ``nominals`` are those of the entries of x whose blocks declare none.
    scale = np.ones(flat.width) if nominals is None else nominals.copy()
    for path, own in flat.states.of_block.items():
        for name, where in own.slices.items():
            nominal = flat.table.blocks[path].states[name].nominal
            if nominal is not None:
                scale[where] = nominal
    scale = scale[flat.continuous]
    return atol if np.all(scale == 1.0) or np.ndim(atol) else atol * scale


def longest_step(flat: FlatDiagram, max_step: float | None, time_scale: float, shortest_delay: float) -> float | None:
    """Return the longest step of a solver in s: that asked for, or what memories, sources and delays allow."""
    longest = max_step
    if longest is None and remembers(flat):
        longest = float(flat.base)  # memory is renewed at accepted steps, and must not grow stale
    if longest is None and time_scale < math.inf:
        longest = 5.0 * time_scale  # else a step may fit whole periods of a source
    if shortest_delay < math.inf:
        longest = min(longest or math.inf, shortest_delay)
    return longest


def find_late(sources: Sequence[tuple[str, Announcer]]) -> dict[float, float]:
    """Return the instants in s at which sources are seen at a time just after, and that time."""
    return {t: after for _, one in sources if isinstance(one, Times) for t, after in one.late.items()}


def next_instant(path: str, block: Announcer, t: float) -> float:
    """Return the next instant of a block; one that does not come after t would keep the run where it is."""
    try:
        found = block.next_instant(t)
        later = found > t
    except Exception as error:
        raise SimulationError(
            f"its next_instant({t!r}) failed: {type(error).__name__}: {error}. Expected a time after that, or math.inf "
            "if there is none.",
            block=path,
            t=t,
        ) from error
    if not later:
        raise SimulationError(
            f"its next_instant({t!r}) is {found!r}; expected a time after that, or math.inf if there is none.",
            block=path,
            t=t,
        )
    return found


def scales_of(block: Block) -> object:
    """Return what a block contributes to tolerances and to the limit of a step."""
    return block.time_scale(), [identity(port.nominal) for port in block.states.values()]
