"""From tick to tick: this is where time advances."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..coupling import CoupledSteps, Plant, PlantSteps, step_all
from ..flat import EVERY, NONE, TickPattern
from .continuous import Continuous
from .view import Position
from .workspace import Workspace

CHUNK = 1000  # ticks between two looks at the progress bar

Row = Callable[[float, np.ndarray], None]
Progress = Callable[[float], Any]


def run_ticks(
    workspace: Workspace,
    plants: Mapping[str, Plant],
    steps: PlantSteps,
    coupled: CoupledSteps | None,
    k: int,
    last: int,
    *,
    every: bool,
    row: Row,
    arrived: Callable[[int], bool],
    progress: Progress,
) -> None:
    """Run the ticks after tick ``k`` up to ``last`` where nothing happens between them.

    Parameters
    ----------
    every : bool
        Visit every tick, not only those at which a subsystem acts.
    row : callable
        Records a sample.
    arrived : callable
        Told each tick after it was recorded; returns whether the run ends there.
    progress : callable
        Told the time now and then, and at the end.
    """
    flat = workspace.flat
    t, log = workspace.here.t, workspace.log
    each = [plant.step for plant in plants.values()] if steps.regular and coupled is None else []
    only = each[0] if len(each) == 1 else None
    together, regular = steps.regular and steps.apart, steps.regular
    n, d, h = flat.base.numerator, flat.base.denominator, float(flat.base)
    always = workspace.bind_tick(flat.acting(0)) if all(c == EVERY for c in flat.distinct) else None
    count, now, before, width = 0, k * n / d, k, 1
    for k in flat.ticks(k, last, every=every):  # noqa: B020
        if k - before != width:
            width = k - before
            h = float(flat.base * width)
        before = k
        try:
            if only is not None:
                only(now, h)
            elif coupled is not None:
                coupled.go(now, k * n / d, h)
            elif together:
                step_all(plants.values(), now, h)
            elif steps.regular:
                for step in each:
                    step(now, h)
            else:
                steps.go(k - width, k, last=k == last)
        except SimulationError as error:
            raise error.at(t=k * n / d) from error.__cause__
        t[0] = now = k * n / d
        if always is not None:
            always()
        else:
            workspace.tick(flat.acting(k))
        if not regular:
            steps.hold(k)
        row(now, log)
        if arrived(k):
            return
        count += 1
        if count == CHUNK:
            progress(now)
            count = 0
    progress(now)


def run_hybrid(
    workspace: Workspace,
    continuous: Continuous,
    plants: Mapping[str, Plant],
    steps: PlantSteps,
    coupled: CoupledSteps | None,
    position: Position,
    last: int,
    *,
    every: bool,
    row: Row,
    arrived: Callable[[int], bool],
    progress: Progress,
) -> float | None:
    """Run the ticks up to ``last`` with a solver between them.

    Parameters
    ----------
    every, row, arrived, progress
        As for `run_ticks`.

    Returns
    -------
    float or None
        Time in s at which a stop condition has ended the run between two ticks.
    """
    flat, time_of = workspace.flat, position.time_of
    clocks, count, samples = flat.visited if plants else flat.distinct, 0, 0

    def sample(t: float) -> bool:
        nonlocal samples
        row(t, workspace.log)
        samples += 1
        if samples % CHUNK == 0:
            progress(t)
        return continuous.is_stopped()

    sampled = every or not clocks or EVERY in clocks
    while position.tick < last:
        k = position.tick
        lands = continuous.fixed or (plants and sampled) or (continuous.lands and sampled)
        following = k + 1 if lands else min([*(c.after(k) for c in clocks), last])
        between = range(k + 1, following) if sampled else range(0)
        now, h = time_of(k), float(flat.base * (following - k))
        if coupled is None:
            ended = continuous.advance(now, time_of(following), map(time_of, between), sample)
        else:
            ended = coupled.go(now, time_of(following), h, sample)
        if ended is not None:
            return ended
        if coupled is None:
            steps.go(k, following, last=following == last)
        take_tick(workspace, continuous, plants, time_of(following), flat.acting(following))
        steps.hold(following)
        row(time_of(following), workspace.log)
        if arrived(following):
            return None
        count += 1
        if count % 16 == 0:
            progress(position.t)
    progress(position.t)
    return None


def end_between_ticks(
    workspace: Workspace,
    continuous: Continuous | None,
    plants: Mapping[str, Plant],
    steps: PlantSteps,
    coupled: CoupledSteps | None,
    position: Position,
    end: float,
    row: Row,
) -> float | None:
    """Go on from a tick to the end of a run before the next one, where nothing sampled acts.

    Returns
    -------
    float or None
        Time in s at which a stop condition has ended the run before.
    """

    def sample(t: float) -> bool:
        row(t, workspace.log)
        return continuous is not None and continuous.is_stopped()

    now, ended = position.t, None
    if coupled is not None:
        ended = coupled.go(now, end, end - now, sample)
    elif continuous is not None:
        ended = continuous.advance(now, end, (), sample)
    if ended is not None:
        return ended
    if coupled is None:
        steps.end_at(end, position.tick)
    if continuous is not None:
        take_tick(workspace, continuous, plants, end, NONE)
    else:
        workspace.here.t[0] = end
        workspace.evaluate_with_held()
    row(end, workspace.log)
    return None


def take_tick(
    workspace: Workspace,
    continuous: Continuous | None,
    plants: Mapping[str, object],
    now: float,
    acting: frozenset[TickPattern],
) -> None:
    """Go through one tick with the events before and after it, and leave in ``log`` what is to be recorded.

    Parameters
    ----------
    now : float
        Its time in s.
    acting : frozenset of TickPattern
        The clocks that act at it.
    """
    if continuous is None:
        workspace.here.t[0] = now
        workspace.tick(acting)
        return
    continuous.enter(now)
    if acting or continuous.domains is not None:
        continuous.settle(now, ahead=True)  # subsystems and the record see the instant after its own events
    workspace.tick(acting)
    continuous.enter(now)
    if (acting or plants) and continuous.delays is not None:
        continuous.delays.note_edge(now)  # held signals have jumped
    states = workspace.log[workspace.flat.log.total :]
    before = states.copy()
    if continuous.settle(now):
        taken = workspace.flat.taken_at(acting)
        states[taken] = before[taken]
