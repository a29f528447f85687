"""Numbers of a loop."""

from __future__ import annotations

from typing import Any

from ..frequency import Number, margins, mimo_disk_margin


def numbers_of(L: Any, delay: int = 0, skew: float = 0.0) -> dict[str, Number]:
    """Return the numbers of a loop by name; of one with several channels the disk margin."""
    if L.ninputs > 1:
        return {"disk_margin": mimo_disk_margin(L, delay=delay, skew=skew).alpha}
    return margins(L, delay=delay, skew=skew).numbers()
