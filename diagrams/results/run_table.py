"""The table of a run's signals with unit, smallest, largest and last value."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from ...blocks.core import MOST_ROWS, Grid
from .run_exports import column_labels

MOST_VALUES = 50_000_000
"""Values up to which the smallest and largest are looked for: 0.05 s."""


@dataclass(frozen=True)
class ShownSignal:
    """A signal of a run's table: its name, shape, and the unit of each entry."""

    name: str
    shape: tuple[int, ...]
    units: Sequence[str]


def signal_grid(
    t: np.ndarray, data: Any, signals: Sequence[ShownSignal], read: Callable[[str], np.ndarray]
) -> tuple[Grid, str]:
    """Return the table of some signals with unit, minimum, maximum and end, and the reason where it has only units."""
    count, why = sum(len(signal.units) for signal in signals), ""
    if _is_on_disk(data):
        why = "It is on disk: run['name'] reads a signal."
    elif len(t) * min(count, MOST_ROWS) > MOST_VALUES:
        why = f"Its {len(t)} samples are not looked through: run['name'].max() does that for a signal."
    rows = tuple(islice(_rows(signals, read if len(t) and not why else None), MOST_ROWS))
    return Grid("", ("signal", "unit", "minimum", "maximum", "end"), rows, total=count), why


def _rows(signals: Sequence[ShownSignal], read: Callable[[str], np.ndarray] | None) -> Iterator[tuple[Any, ...]]:
    for signal in signals:
        labels = column_labels(signal.name, signal.shape)
        values = None if read is None else read(signal.name)
        for k, (label, unit) in enumerate(zip(labels, signal.units, strict=True)):
            if values is None:
                yield label, unit
            else:
                column = values.reshape(len(values), -1)[:, k]
                yield label, unit, float(np.min(column)), float(np.max(column)), float(column[-1])


def _is_on_disk(data: Any) -> bool:
    """Return whether an array's values are in a file that is mapped."""
    while data is not None:
        if isinstance(data, np.memmap | mmap.mmap):
            return True
        data = getattr(data, "base", None)
    return False
