"""How many ticks a run has, and whether its samples fit."""

from __future__ import annotations

import math
import os
import shutil
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...blocks.core.errors import OptionError

if TYPE_CHECKING:
    from ..diagram import Diagram

FIXED_STEP = ("euler", "heun", "rk4")


def ticks_in(duration: Any, base: Fraction, name: str) -> int:
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


def default_step(diagram: Diagram, step: Any, duration: float | None, solver: str, start: Any = None) -> Any:
    """Return the seconds between two samples of a run that has neither a ``step`` nor a clock.

    That of the run that is gone on from; else a thousandth of the duration, in whole nanoseconds where it has them,
    where the diagram has no FMU and the solver chooses its own steps.
    """
    if step is not None or diagram.has_clock:
        return step
    if start is not None and hasattr(start, "base"):
        return start.base
    if duration is None:
        return step
    from ..solvers.base import solver_name

    if diagram.has_fmu or solver_name(solver) in FIXED_STEP:
        return step
    try:
        span = Fraction(repr(float(duration)))
    except (TypeError, ValueError):
        span = Fraction(0)
    if not span > 0:
        ticks_in(duration, Fraction(1), diagram.name)  # refused
    ticks = span / Fraction(1, 10**9)
    if ticks.denominator != 1:
        return span / 1000
    return next((span / n for n in (1000, 500, 200, 100, 10, 1) if (ticks / n).denominator == 1), span)


def memory() -> int:
    """Return the bytes of memory of this machine."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not on Windows
        return 16 * 2**30


def check_memory(samples: int, width: int, base: Fraction, name: str, *, every: int = 1, to: Any = None) -> None:
    """Refuse a run whose samples can't fit, before it takes the machine down.

    Parameters
    ----------
    samples : int
        Samples of the run, one more than its ticks.
    width : int
        Numbers that are recorded of each, without the time.
    base : Fraction
        Seconds between two ticks.
    name : str
        The diagram's name.
    every : int
        Of so many samples one is recorded.
    to : path, optional
        Folder on disk that they go to.

    Raises
    ------
    OptionError
        If more than 80 % of the memory were needed, or more than is free on the disk.
    """
    needed = -(-samples // every) * 8 * (width + 1)
    if to is None:
        there, most, place = memory(), 0.8 * memory(), "this machine has"
        remedy = "record less with record=[…] or every=…, or stream to disk with to=path"
    else:
        there = most = free_on_disk(Path(to))
        place, remedy = "the disk has free", "record less with record=[…] or every=…, or choose another disk"
    if needed > most:
        kept = f"{width} numbers each" if every == 1 else f"{width} numbers of each {every}th"
        raise OptionError(
            f"found {samples - 1} ticks of {float(base):g} s; {kept} need {needed / 2**30:.0f} GiB, "
            f"and {place} {there / 2**30:.0f}. Is the duration in s? Take a shorter one or a larger step, {remedy}.",
            block=name,
            port="duration",
        )


def free_on_disk(path: Path) -> int:
    """Return the bytes that are free where a path is to be created."""
    path = path.absolute()
    return shutil.disk_usage(next(p for p in (path, *path.parents) if p.exists())).free
