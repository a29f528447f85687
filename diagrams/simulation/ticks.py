"""From tick to tick where nothing happens between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...blocks.core.errors import SimulationError
from ..flat.layout import Clock
from .diagnosis import failure
from .workspace import Machine

CHUNK = 1000  # ticks between two looks at the progress bar


def run_ticks(
    machine: Machine,
    plants: Sequence[Any],
    k: int,
    last: int,
    *,
    every: bool,
    row: Callable[[float, np.ndarray], None],
    arrived: Callable[[int], bool],
    progress: Callable[[float], None],
) -> None:
    """Run the ticks after tick ``k`` up to ``last``.

    Parameters
    ----------
    every : bool
        Visit every tick, not only those at which a box acts.
    row : callable
        Records a sample.
    arrived : callable
        Told each tick after it was recorded; returns whether the run ends there.
    progress : callable
        Told the time now and then, and at the end.
    """
    flat = machine.flat
    t, x, x_next, ok, log = machine.here.t, machine.here.x, machine.x_next, machine.ok, machine.log
    only = plants[0].step if len(plants) == 1 else None
    n, d, h = flat.base.numerator, flat.base.denominator, float(flat.base)
    always = machine.tick(flat.acting(0)) if all(c == Clock() for c in flat.distinct) else None
    count, now = 0, k * n / d
    for k in flat.ticks(k, last, every=every):  # noqa: B020
        try:
            if only is not None:
                only(now, h)
            else:
                for plant in plants:
                    plant.step(now, h)
        except SimulationError as error:
            raise error.at(t=k * n / d) from error.__cause__
        t[0] = now = k * n / d
        if always is not None:
            always()
        else:
            machine.tick(flat.acting(k))()
        if not ok[0]:
            raise failure(machine, flat.acting(k)).at(t=now)
        row(now, log)
        x[:] = x_next
        if arrived(k):
            return
        count += 1
        if count == CHUNK:
            progress(now)
            count = 0
    progress(now)
