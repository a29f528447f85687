"""Numbers of a loop."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from ..frequency import Number, margins, mimo_disk_margin, scan_margins
from ..requirements import SENSES, Sense


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
        found = {name: number.value for name, number in numbers_of(L, delay, skew).items()}
    else:
        found = scan_margins(L, delay=delay, skew=skew)
    return {name: found.get(name, math.nan) for name in names}


def write_open_loop(wire: str, quantity: str, at: object = None) -> str:
    """Return how a number of a loop with slower subsystems held is written as a function for ``quantity``.

    A function's value is the worse, the smaller it is: a number that is the worse, the larger, has its sign changed.
    """
    sign, point = "-" if SENSES[quantity] is Sense.MOST else "", "" if at is None else "at=…"
    return f'lambda d: {sign}margins(d.linearize({point}).loop("{wire}", slow="open")).{quantity}.value'
