"""One evaluation of a block in model exchange: the quantities that are wanted, and the vectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Wanted(NamedTuple):
    """Quantities that are wanted of a block, in the order in which they are returned, flat.

    ``rates``: whether the derivatives of all states follow.
    ``indicators``: whether the indicators of all events follow.
    """

    outputs: tuple[str, ...] = ()
    rates: bool = False
    indicators: bool = False


class EvaluationVectors(NamedTuple):
    """Vectors that an evaluation reads, and the one that it writes, where they are; all of float64.

    ``t``: time in s, shape (1,).
    """

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    into: np.ndarray
