"""The blocks in continuous time as a part of a communication step that may be gone back over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..coupling import accept_steps, try_steps
from ..model_exchange import BlocksInModelExchange
from ..results import Occurrence
from .continuous import Continuous
from .workspace import Workspace


@dataclass
class _Saved:
    t: float
    x: np.ndarray
    continuous: Any
    exchanged: Mapping[str, bytes]
    messages: tuple[str, ...]
    events: int


class ContinuousPart:
    """The blocks in continuous time between two ticks: advanced, saved and restored; see `ContinuousRest`."""

    def __init__(self, workspace: Workspace, continuous: Continuous | None, exchanged: BlocksInModelExchange):
        self._workspace, self._continuous, self._exchanged = workspace, continuous, exchanged
        self._events: list[Occurrence] = []  # reported when they are accepted: a pass may be gone back over
        self.go_between: Callable[[float, float], float | None] | None = None
        """Takes them from one instant to another, as `HybridTicks.go_between`; None where nothing happens between."""
        if continuous is not None:
            self._report = continuous.on_event
            continuous.on_event = self._events.append

    def advance(self, t: float, end: float) -> float | None:
        """Go from t to the end, both in s; return the time at which a stop condition has ended the run."""
        if self._continuous is None:
            return None
        assert self.go_between is not None
        self._workspace.here.t[0] = t
        if self._continuous.delays is not None:
            self._continuous.delays.note_edge(t)  # the outputs of the plants have jumped
        return self.go_between(t, end)

    def save(self) -> _Saved:
        """Return the present state."""
        here, workspace = self._workspace.here, self._workspace
        continuous = None if self._continuous is None else self._continuous.save()
        try_steps(self._exchanged.blocks.values())
        exchanged = {path: block.serialize() for path, block in self._exchanged.blocks.items()}
        return _Saved(float(here.t[0]), here.x.copy(), continuous, exchanged, workspace.messages, len(self._events))

    def restore(self, saved: _Saved) -> None:
        """Go back to a state."""
        here, workspace = self._workspace.here, self._workspace
        here.t[0], here.x[:] = saved.t, saved.x
        workspace.messages = saved.messages
        del self._events[saved.events :]
        for path, block in self._exchanged.blocks.items():
            block.restore_bytes(saved.exchanged[path])
            block.refused = None
        if self._continuous is not None:
            self._continuous.restore(saved.continuous)

    def accept(self) -> None:
        """Report the events that have happened, and raise the error of an input that was out of its range."""
        accept_steps(self._exchanged.blocks.values())
        if self._events:
            for event in self._events:
                self._report(event)
            self._events.clear()
