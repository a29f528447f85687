"""Ticks of a run: their number, and the step between them."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

from ...blocks.core import OptionError
from ..flat import FlatDiagram, WiredDiagram, takes_any_step
from ..wiring import stepped_blocks

FIXED_STEP = ("euler", "heun", "rk4")


def ticks_in(duration: Any, base: Fraction, name: str) -> tuple[int, Fraction]:
    """Return the number of ticks in a duration, and the seconds that are left after them.

    Rounding of a few ulps, as in 0.1 + 0.2, is forgiven: nothing is left then.
    """
    try:
        span = float(duration)
    except (TypeError, ValueError):
        span = math.nan
    if not 0 < span < math.inf or isinstance(duration, str | bool):
        raise OptionError(f"found a duration of {duration!r}; expected seconds, positive.", block=name, port="duration")
    exact = Fraction(span)
    n = round(exact / base)
    if n and abs(exact - n * base) <= exact * Fraction(1, 10**12):
        return n, Fraction(0)
    n = exact // base
    return n, exact - n * base


def refuse_rest(flat: FlatDiagram, n: int, duration: Any, name: str) -> None:
    """Refuse an end between two ticks where an FMU takes steps of one length only."""
    for path, plant in stepped_blocks(flat.table).items():
        if not takes_any_step(plant):
            raise OptionError(
                f"found a duration of {duration!r} s, no multiple of the {float(flat.base):g} s between ticks, and "
                f"{path} takes steps of one length only; take {float(max(n, 1) * flat.base)!r} s.",
                block=name,
                port="duration",
            )


def default_step(diagram: WiredDiagram, step: Any, duration: float | None, solver: str, start: Any = None) -> Any:
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
    from ..solvers import solver_name

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
