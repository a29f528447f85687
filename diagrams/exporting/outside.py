"""The outside of a diagram that is exported: its inputs, as outputs of one block."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...blocks.core import Block, Output, parameter


class Outside(Block):
    """Whatever is around a diagram that is exported: nothing steps it, its outputs are set from outside."""

    stepped = True
    ports: Any = parameter(kw_only=False, description="inputs of the diagram: name, shape, unit, start value, ...")

    @property
    def outputs(self) -> dict[str, Output]:  # type: ignore[override]
        """The inputs of the diagram."""
        return {
            name: Output(shape=shape, unit=unit, description=description, name=name)
            for name, shape, unit, description, _ in self.ports
        }

    def start_of(self, name: str) -> np.ndarray:
        """Return the start value of an input, flat."""
        shape, start = next((shape, start) for key, shape, _, _, start in self.ports if key == name)
        return np.ravel(np.broadcast_to(np.asarray(start, dtype=float), shape))
