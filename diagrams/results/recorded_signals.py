"""The part of a run that plots and exports read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ..wiring import Wire


class RecordedSignals(Protocol):
    """The members of a run that plots and exports need; `loopwright.diagrams.Run` has them."""

    @property
    def t(self) -> np.ndarray:
        """Times in s, (N,)."""

    @property
    def wires(self) -> Mapping[str, Wire]:
        """The named wires."""

    @property
    def names(self) -> list[str]:
        """Names of all signals."""

    @property
    def diagram_name(self) -> str:
        """Name of the diagram."""

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the samples of a signal, one row each."""

    def part(self, name: str, samples: slice) -> np.ndarray:
        """Return some samples of a signal."""

    def unit(self, name: str) -> str | tuple[str, ...] | None:
        """Return the unit of a signal, one for each entry where they differ; None where it is not declared."""
