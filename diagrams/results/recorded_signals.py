"""The signals of a run, as plots and exports read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ..wiring.structure import Wire


class RecordedSignals(Protocol):
    """A run, as far as its plots and exports need it: `loopwright.diagrams.Run` is one."""

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
