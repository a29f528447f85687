"""Stop conditions: outputs of blocks that end a run."""

from __future__ import annotations

import numpy as np

from ..flat import TRUE, FlatDiagram
from ..results import Stopped
from ..wiring import join


class StopConditions:
    """The stop conditions of a diagram, looked up in the last evaluation.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    log : ndarray
        The outputs of all blocks: the run's own vector, which it evaluates into.
    """

    def __init__(self, flat: FlatDiagram, log: np.ndarray):
        self._log = log
        self._entries: list[tuple[int, str]] = []
        for path in sorted(flat.checked.traced):
            port = flat.table.blocks[path].stops
            if port is not None:
                self._entries.append((flat.log.slices[join(path, port)].start, path))

    @property
    def exist(self) -> bool:
        """Whether the diagram has any."""
        return bool(self._entries)

    def is_met(self) -> bool:
        """Whether any is true."""
        return any(self._log[i] > TRUE for i, _ in self._entries)

    def met_at(self, t: float) -> Stopped:
        """Return the first one that is true, by path, with the time in s at which it was met."""
        return Stopped(t, next(path for i, path in self._entries if self._log[i] > TRUE))
