"""Ranges of parameters in which a worst case is looked for, and points of them: a fraction of each range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import OptionError, shorten
from ..flat import WiredDiagram
from ..sweeps import Box, Samples
from ..wiring import split_path
from .varied_parameters import find_declaration


@dataclass(frozen=True)
class Ranges:
    """Ranges of parameters by their paths; a point of them has a fraction from 0 to 1 for each number."""

    boxes: Mapping[str, Box]

    @property
    def names(self) -> list[tuple[str, int]]:
        """The paths of all numbers, with their places in arrays."""
        return [(name, i) for name, box in self.boxes.items() for i in range(box.size)]

    def parameters_at(self, fractions: np.ndarray) -> dict[str, Any]:
        """Return the parameters at a point."""
        found, first = {}, 0
        for name, box in self.boxes.items():
            part = np.clip(fractions[first : first + box.size], 0.0, 1.0)
            found[name] = box.at(part if np.ndim(box.low) else float(part[0]))
            first += box.size
        return found

    def fractions_of(self, parameters: Mapping[str, Any]) -> np.ndarray:
        """Return the point at which parameters are."""
        parts = []
        for name, box in self.boxes.items():
            low, high, value = _read(box, parameters[name])
            if box.scale == "log":
                low, high, value = np.log(low), np.log(high), np.log(value)
            width = np.where(high > low, high - low, 1.0)
            parts.append(np.clip((value - low) / width, 0.0, 1.0))
        return np.concatenate(parts)

    def widths_at(self, parameters: Mapping[str, Any]) -> np.ndarray:
        """Return the derivative of each number by its fraction where parameters are."""
        parts = []
        for name, box in self.boxes.items():
            low, high, value = _read(box, parameters[name])
            parts.append(value * np.log(high / low) if box.scale == "log" else high - low)
        return np.concatenate(parts)


def _read(box: Box, value: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of a range and a value in it as rows of numbers."""
    low, high, own = (np.ravel(np.asarray(v, dtype=float)) for v in (box.low, box.high, value))
    return low, high, own


def read_boxes(drawn: Samples) -> dict[str, Box]:
    """Return the ranges of a search: those of a Latin hypercube, or from the least to the largest value of a grid."""
    if drawn.boxes:
        return dict(drawn.boxes)
    if drawn.axes is None:
        return {}
    return {
        name: Box(min(values), max(values))
        for name, values in drawn.axes.items()
        if all(isinstance(v, float | int) and not isinstance(v, bool) for v in values)
    }


def check_ranges(diagram: WiredDiagram, boxes: Mapping[str, Box]) -> None:
    """Refuse ranges with an end outside of the bounds that the parameter itself declares, before a case is computed.

    What a block refuses in view of its other parameters is left to the cases: others may go with it.
    """
    for name, box in boxes.items():
        if name in diagram.structure.blocks:
            continue
        path, keys = split_path(diagram.structure, name.partition("[")[0], diagram.name)
        spec = find_declaration(diagram.structure.blocks[path], keys)
        if spec is None:
            continue
        for words, bound, holds in (
            ("above", spec.above, np.greater),
            ("at least", spec.minimum, np.greater_equal),
            ("at most", spec.maximum, np.less_equal),
        ):
            ends = (np.asarray(end, dtype=float) for end in (box.low, box.high))
            if bound is not None and not all(np.all(holds(end, bound)) for end in ends):
                unit = f" {spec.unit}" if spec.unit and spec.unit != "1" else ""
                raise OptionError(
                    f"found a range from {shorten(box.low)} to {shorten(box.high)}; expected values {words} "
                    f"{bound:g}{unit}, as the parameter takes them. Give a range within.",
                    block=path,
                    port=name.removeprefix(f"{path}."),
                )
