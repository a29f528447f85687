"""All signals of a run at one recorded instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ...blocks.core import brief, count_of, explain_calls
from ..wiring import Wire, index_of, split_entry
from .signal_names import resolve


class RecordedRun(Protocol):
    """Members of a `loopwright.diagrams.Run` with which an instant of it is found again."""

    @property
    def diagram_name(self) -> str:
        """Name of its diagram."""

    @property
    def recipe(self) -> Mapping[str, Any]:
        """Options of the run."""


@explain_calls
@dataclass(frozen=True)
class Snapshot:
    """All signals and states at one recorded instant."""

    t: float
    tick: int
    """The sample's number in the run, from 0: the tick, where every tick was recorded."""
    values: dict[str, Any]
    state: np.ndarray
    """The state vector x of the flattened diagram."""
    names: dict[str, Wire]
    """The named wires: two of one short name are told apart by their source."""
    run: RecordedRun | None = field(default=None, repr=False, compare=False)
    """The run that it comes from."""

    def __repr__(self) -> str:
        of = f" of {self.run.diagram_name!r}" if self.run is not None and self.run.diagram_name else ""
        facts = count_of(len(self.values), "signal"), count_of(self.state.size, "state")
        return brief(f"instant t = {self.t:.9g} s{of}", *facts, then="instant['name'], diagram.linearize(instant)")

    def __getitem__(self, name: str) -> Any:
        full, entry = split_entry(resolve(name, self.names, self.values), self.values)
        value = self.values[full]
        return value[index_of(entry, value.shape, full)] if entry else value
