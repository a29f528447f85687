"""The reduced loops of a diagram of Fig. 3, and the stiffness limits of their environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...blocks import Path
from ...fmus.models import Gantry
from ..contact import SIDES
from ..flat import WiredDiagram
from ..report import Implementation
from ..results import OperatingPoint
from .compliance_loop import AdmittanceLoop
from .coupled_stability import StabilityLimit, stability_limit

FRICTION = "_friction"
"""End of the keys of what has the plant's friction, where there is the same without it, too."""
NO_FRICTION = {"coulomb_scale": 0.0, "viscous_scale": 0.0}
OPTIONS: Mapping[Implementation, Mapping[str, Any]] = {
    Implementation.CONTINUOUS: {"implementation": "continuous", "delay": 0},
    Implementation.SAMPLED: {"implementation": "sampled", "delay": 0},
    Implementation.DELAYED: {"implementation": "sampled", "delay": 1},
}
"""Parameters of a reduced loop that make it one of an implementation."""


class LoopKind(NamedTuple):
    """A loop with its title, and what is around the names of its numbers in their keys."""

    title: str
    loop: AdmittanceLoop
    prefix: str = ""
    suffix: str = ""

    def key_of(self, name: str) -> str:
        """Return the key of a number, such as ``force_tracking.ke_limit_friction``."""
        return f"{self.prefix}{name}{self.suffix}"


@dataclass(frozen=True)
class ReducedLoops:
    """The reduced loops of a diagram: by direction, with or without friction, impedance control or force tracking."""

    plain: Mapping[str, AdmittanceLoop]  # of the design without friction, where there is some
    rough: Mapping[str, AdmittanceLoop]  # with the slope of friction at rest, and its compensation; {} without
    _limits: dict[tuple[str, str, Implementation, float], StabilityLimit] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls, base: WiredDiagram, smooth: WiredDiagram | None, plant: Gantry | None, path: Path, point: OperatingPoint
    ) -> ReducedLoops:
        """Return the loops of a diagram."""
        coordinates = (point.values[f"controller.transverse_transform.{name}"] for name in ("eta", "xi"))
        eta, xi = (float(np.ravel(value)[0]) for value in coordinates)
        period = path.length if path.period is not None else None
        at: dict[str, Any] = {**OPTIONS[Implementation.SAMPLED], "point": point}
        at |= {"eta": eta % period if period else eta, "xi": xi}
        if smooth is None or plant is None:
            return cls({side: AdmittanceLoop.of(base.facade, side, plant=plant, **at) for side in SIDES}, {})
        bare = plant.replace(**NO_FRICTION)
        return cls(
            {side: AdmittanceLoop.of(smooth.facade, side, plant=bare, **at) for side in SIDES},
            {side: AdmittanceLoop.of(base.facade, side, plant=plant, **at) for side in SIDES},
        )

    def suffixed(self, side: str) -> dict[str, AdmittanceLoop]:
        """Return the loops of a direction by the end of their keys: none, and that of friction."""
        return {"": self.plain[side]} | ({FRICTION: self.rough[side]} if side in self.rough else {})

    def kinds(self, side: str) -> dict[str, LoopKind]:
        """Return the loops of a direction, with impedance control and with force tracking, by the keys of limits."""
        found: list[LoopKind] = []
        for suffix, loop in self.suffixed(side).items():
            title = ", friction slope at rest" if suffix else ""
            kind = "impedance control" if loop.admittance.stiffness > 0 else "force tracking"
            found.append(LoopKind(kind + title, loop, suffix=suffix))
            if loop.admittance.stiffness > 0:
                tracking = "force tracking, k = 0" + title
                found.append(LoopKind(tracking, with_tracking(loop), "force_tracking.", suffix))
        return {kind.key_of("ke_limit"): kind for kind in found}

    def limit(self, side: str, key: str, implementation: Implementation, damping: float) -> StabilityLimit:
        """Return the largest stiffness of an environment with a damping in N s/m, computed once."""
        place = side, key, implementation, damping
        if place not in self._limits:
            loop = self.kinds(side)[key].loop.replace(**OPTIONS[implementation])
            self._limits[place] = stability_limit(loop, damping=damping)
        return self._limits[place]


def each_implementation(loop: AdmittanceLoop) -> dict[Implementation, AdmittanceLoop]:
    """Return a loop in each implementation."""
    return {implementation: loop.replace(**options) for implementation, options in OPTIONS.items()}


def with_tracking(loop: AdmittanceLoop) -> AdmittanceLoop:
    """Return the loop with force tracking in its direction: no stiffness, the same damping."""
    a = loop.admittance
    free = a.replace(stiffness=0.0, damping=float(a.effective_damping), damping_ratio=None)
    return loop.replace(**{f"admittance_{loop.side}": free})
