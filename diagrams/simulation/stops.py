"""Stop conditions: outputs of blocks that end a run, and blocks that ask for its end."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..flat import TRUE, FlatDiagram
from ..results import Stopped
from ..wiring import join


class StopConditions:
    """The stop conditions of a diagram, looked up in the last evaluation."""

    def __init__(self, flat: FlatDiagram, log: np.ndarray, asking: Callable[[], str]):
        # log: outputs of all blocks, which the run evaluates into; asking: path of an FMU that asks for the end, or ""
        self._log, self._asking = log, asking
        self._entries: list[tuple[int, str]] = []
        for path in sorted(flat.checked.traced):
            port = flat.table.blocks[path].stops
            if port is not None:
                self._entries.append((flat.log.slices[join(path, port)].start, path))

    @property
    def exist(self) -> bool:
        """Whether the diagram has any."""
        return bool(self._entries)

    @property
    def entries(self) -> list[int]:
        """Entries of the outputs that end the run where they are true."""
        return [entry for entry, _ in self._entries]

    @property
    def paths(self) -> list[str]:
        """Paths of the blocks that these entries belong to."""
        return [path for _, path in self._entries]

    def is_met(self) -> bool:
        """Whether any is true."""
        return any(self._log[i] > TRUE for i, _ in self._entries) or bool(self._asking())

    def met_at(self, t: float) -> Stopped:
        """Return the first one that is true, by path, with the time in s at which it was met."""
        path = next((path for i, path in self._entries if self._log[i] > TRUE), None)
        return Stopped(t, self._asking() if path is None else path)
