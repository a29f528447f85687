"""How many ticks a run has, and whether its samples fit."""

from __future__ import annotations

import math
import os
from fractions import Fraction

from ..blocks._errors import OptionError


def ticks_in(duration: float, base: Fraction, name: str) -> int:
    """Return the number of ticks in a duration; rounding of a few ulps, as in 0.1 + 0.2, is forgiven."""
    try:
        span = float(duration)
    except (TypeError, ValueError):
        span = math.nan
    if not 0 < span < math.inf or isinstance(duration, str | bool):
        raise OptionError(f"found a duration of {duration!r}; expected seconds, positive.", block=name, port="duration")
    n = round(Fraction(span) / base)
    if n < 1 or abs(Fraction(span) - n * base) > Fraction(span) * Fraction(1, 10**12):
        raise OptionError(
            f"found a duration of {duration!r} s, no multiple of the {float(base):g} s between ticks; take "
            f"{float(max(n, 1) * base)!r} s.",
            block=name,
            port="duration",
        )
    return n


def check_memory(samples: int, width: int, base: Fraction, name: str) -> None:
    """Refuse a run whose samples can't fit, before it takes the machine down."""
    needed = samples * (8 * width + 40)
    try:
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not on Windows
        there = 16 * 2**30
    if needed > 0.8 * there:
        raise OptionError(
            f"found {samples - 1} ticks of {float(base):g} s; {width} numbers each need {needed / 2**30:.0f} GiB, "
            f"and this machine has {there / 2**30:.0f}. Is the duration in s? Take a shorter one, or a larger step.",
            block=name,
            port="duration",
        )
