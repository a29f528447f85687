"""A plant that an environment touches, with the rest of its diagram, linear at an operating point."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from .contact_ports import Ports
from .coupled_parts import ContactParts
from .environment import check_properties
from .stability_limits import CoupledLoop

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..results import OperatingPoint


@dataclass(frozen=True, eq=False)
class TouchedPlant:
    """A plant in its diagram, and the direction in which an environment touches it."""

    wired: WiredDiagram
    ports: Ports = field(repr=False)
    direction: np.ndarray
    point: OperatingPoint
    parts: ContactParts = field(repr=False)

    @property
    def plant(self) -> str:
        """Path of the plant."""
        return self.ports.plant

    @property
    def sample_time(self) -> float:
        """Sample time of the controller in s, the common period of several rates; 0 if the diagram is continuous."""
        return self.parts.sample_time

    @property
    def shortest(self) -> float:
        """Shortest time between ticks in s: the sample time in one rate; 0 if the diagram is continuous."""
        return self.parts.shortest

    @property
    def entry(self) -> str | None:
        """Wire to which the environment's force is added; None if the controller does not measure it."""
        return self.parts.entry

    def loop(self, vary: str, **environment: float) -> CoupledLoop:
        """Return the loop with an environment of which one property varies; see `Contact.stability_limit`."""
        return CoupledLoop.of(self.parts, self.direction, vary, check_properties(environment, vary))
