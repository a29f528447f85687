"""Members of the block `Fmu` that a loaded library needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ..archive import FmuDescription


class FmuBlock(Protocol):
    """A block of an FMU: its file, its start values and the names of its ports."""

    @property
    def label(self) -> str:
        """Name for messages."""

    @property
    def description(self) -> FmuDescription:
        """The FMU's description, read and checked."""

    @property
    def start(self) -> Mapping[str, Any]:
        """Start values by the FMU's names."""

    @property
    def rename(self) -> Mapping[str, str]:
        """Names of ports by the FMU's names."""

    @property
    def variable_step(self) -> bool:
        """Whether communication steps may differ in length."""
