"""Numbers of a loop."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from ..frequency import Number, margins, mimo_disk_margin, scan_margins


def numbers_of(L: Any, delay: int = 0, skew: float = 0.0) -> dict[str, Number]:
    """Return the numbers of a loop by name; of one with several channels the disk margin."""
    if L.ninputs > 1:
        return {"disk_margin": mimo_disk_margin(L, delay=delay, skew=skew).alpha}
    return margins(L, delay=delay, skew=skew).numbers()


def compared_numbers(L: Any, names: Iterable[str], delay: int = 0, skew: float = 0.0) -> dict[str, float]:
    """Return some numbers of a loop that are only compared with confirmed ones; NaN where the loop is unstable.

    Nothing confirms them, which takes most of the time of `numbers_of`, where a scan of the response has them all.
    """
    names = list(names)
    if L.ninputs > 1 or any(name.startswith("delay_margin") for name in names):
        found = numbers_of(L, delay, skew)
    else:
        found = scan_margins(L, delay=delay, skew=skew)
    return {name: found[name].value if name in found else math.nan for name in names}
