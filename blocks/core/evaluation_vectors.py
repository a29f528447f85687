"""One evaluation of a block in model exchange: the quantities that are wanted, and the vectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Wanted(NamedTuple):
    """Quantities that are wanted of a block, in the order in which they are returned, flat."""

    outputs: tuple[str, ...] = ()  # names of ports
    rates: bool = False  # whether the derivatives of all states follow
    indicators: bool = False  # whether the indicators of all events follow


class EvaluationVectors(NamedTuple):
    """Vectors that an evaluation reads, and the one that it writes, where they are; all flat, of float64."""

    t: np.ndarray  # time in s, shape (1,)
    x: np.ndarray  # the block's states
    u: np.ndarray  # its inputs
    into: np.ndarray  # the result
