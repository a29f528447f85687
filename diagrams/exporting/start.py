"""The start of a diagram of which a part is exported: signals and states at t = 0, with the plants of its runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..flat import FlatDiagram, WiredDiagram
from ..simulation import RunOptions, Simulation
from ..wiring import join

_STEP = 1e-3  # s, of a diagram without any; its start has none


@dataclass(frozen=True, eq=False)
class DiagramStart:
    """Signals and states of a diagram at t = 0."""

    flat: FlatDiagram | None
    log: np.ndarray
    states: Mapping[str, np.ndarray]

    @classmethod
    def none(cls) -> DiagramStart:
        """Return the start of which nothing is asked."""
        return cls(None, np.zeros(0), {})

    def signal(self, path: str, port: str) -> np.ndarray:
        """Return an output of a block."""
        assert self.flat is not None
        full = join(path, port)
        return np.array(self.log[self.flat.log.slices[full]].reshape(self.flat.log.shapes[full]))


def find_start(wired: WiredDiagram) -> DiagramStart:
    """Begin a run of a diagram, and return its start.

    Raises `LoopwrightError`: as a run does.
    """
    with Simulation(wired, RunOptions(step=None if wired.has_base else _STEP)) as simulation:
        flat, view = simulation.flat, simulation.view
        log, x = view.log.copy(), view.x.copy()
    # blocks that delays and units have become are other ones in a part, and start from their inputs
    own = {path: x[where] for path, where in flat.states.slices.items() if path in wired.structure.blocks}
    return DiagramStart(flat, log, own)
