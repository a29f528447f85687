"""Between Python and C: plans of the solver, domains of indicators, and plants are handed over and taken back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby

import numpy as np

from ...fmus.calls import FmuInstance, NativeStep, RemoteStep
from ..compiled import RECENT, REFUSED, UNDER_WAY, Fired, MethodOptions, Watch
from ..coupling import Plant, end_all, runs_apart, step_all
from ..events import Domains
from .continuous import Continuous
from .solver_setup import next_instant

OBSTACLES = (
    "ports that are no Float64 in this process, texts, or options of its steps, or it runs in a process of its own on "
    "a platform where C can't ask it"
)
"""Reasons for which C can't step a plant."""
_MOST_EDGES = 100_000  # discontinuities of sources in a call


def hand_over_domains(domains: Domains, watch: Watch) -> list[float]:
    """Let C go on with the domains; return the times in s at which events have fired last."""
    (domain, _, low, high, slack), (size, rounding), watch.fresh, limits = domains.save()
    watch.latest, watch.largest[:], recent, _, _ = limits
    watch.domain[:], watch.low[:], watch.high[:], watch.slack[:] = domain, low, high, slack
    watch.size[:], watch.rounding[:] = size, rounding
    return [t for t, _ in recent]


def take_back_domains(domains: Domains, watch: Watch, fired: Sequence[Fired]) -> None:
    """Let Python go on with the domains from C, where some events have fired since they were handed over."""
    (_, first, *_), _, _, (_, _, recent, side, stuck) = domains.save()
    groups = groupby(fired, key=lambda one: one.t)
    recent = [*recent, *((t, tuple(one.event for one in group)) for t, group in groups)][-RECENT:]
    states = watch.domain.astype(int), first, watch.low, watch.high, watch.slack
    limits = watch.latest, np.array(watch.largest), recent, side, stuck
    domains.restore((states, (watch.size, watch.rounding), watch.fresh, limits))


def methods_of(continuous: Continuous) -> list[MethodOptions]:
    """Return the methods in C that do what a run's solver does."""
    solver, n = continuous.solver, continuous.where.size
    if not n:
        return [MethodOptions("euler", 1.0, np.zeros(0), solver.max_step)]
    if solver.fixed:
        return [MethodOptions(solver.name, 1.0, np.zeros(n), solver.max_step)]
    atol = np.broadcast_to(np.asarray(solver.atol, dtype=float), (n,)).copy()
    names = [solver.name] if solver.name != "auto" else ["RK45" if solver.rtol >= 1e-8 else "DOP853", "Radau"]
    return [MethodOptions(name, solver.rtol, atol, solver.max_step) for name in names]


def find_edges(
    continuous: Continuous, t: float, end: float, *, limited: bool = True
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the discontinuities of sources from t on, up to the first one of each after the end; see `Span`.

    Parameters
    ----------
    limited : bool
        Return None if there are more than fit into a call.
    """
    found = set[float]()
    for path, source in continuous.sources:
        edge = t
        while edge <= end and (edge := next_instant(path, source, edge)) < math.inf:
            found.add(edge)
            if limited and len(found) > _MOST_EDGES:
                return None
    if t in continuous.late:
        found.add(t)
    edges = np.array(sorted(found))
    return edges, np.array([continuous.late.get(float(edge), float(edge)) for edge in edges])


def active_method(continuous: Continuous, methods: Sequence[MethodOptions]) -> int:
    """Return the place of the method that a run's solver goes on with."""
    active = continuous.solver.save().get("active")
    return next((i for i, m in enumerate(methods) if m.name == active), 0)


def planned_steps(continuous: Continuous, methods: Sequence[MethodOptions]) -> list[float | None]:
    """Return the steps in s that a run's solver would take next, by its methods."""
    saved = continuous.solver.save()
    each = saved.get("methods", {})
    return [each.get(m.name, saved).get("planned") for m in methods]


def restore_plans(continuous: Continuous, methods: Sequence[MethodOptions], steps: Sequence[float | None]) -> None:
    """Let a run's solver take steps of some lengths in s next."""
    saved = continuous.solver.save()
    if "methods" in saved:
        saved["methods"] = {m.name: {"planned": step} for m, step in zip(methods, steps, strict=True)}
        continuous.solver.restore(saved)
    elif "planned" in saved:
        continuous.solver.restore({"planned": steps[0]})


def plants_for_c(plants: Mapping[str, Plant]) -> dict[str, FmuInstance]:
    """Return the plants that C can step, by path: in this process, or in others."""
    return {
        path: plant for path, plant in plants.items() if isinstance(plant, FmuInstance) and step_in_c(plant) is not None
    }


def step_in_c(plant: FmuInstance) -> NativeStep | RemoteStep | None:
    """Return the step of a plant as C takes it."""
    return plant.native or plant.remote


def steps_in_c(plants: Iterable[FmuInstance]) -> list[NativeStep | RemoteStep]:
    """Return the steps of plants, all of which C can step."""
    found = list[NativeStep | RemoteStep]()
    for plant in plants:
        step = step_in_c(plant)
        assert step is not None
        found.append(step)
    return found


def step_plants(plants: Sequence[FmuInstance], t: float, h: float) -> None:
    """Step all plants from t over h, both in s, by Python."""
    if len(plants) > 1 and any(map(runs_apart, plants)):
        step_all(plants, t, h)
    else:
        for plant in plants:
            plant.step(t, h)


def end_steps(plants: Sequence[FmuInstance], first: int, stage: int, status: int, t: float, h: float) -> None:
    """Go on with steps from t over h, both in s, from the plant on that C could not go beyond.

    Parameters
    ----------
    plants : sequence of FmuInstance
        All plants; those before the first one have taken their steps.
    first : int
        Place of that plant.
    stage, status : int
        How far C has come with it; see `Outcome`.

    Raises
    ------
    SimulationError
        Of the first plant that fails, once no other one is under way.
    """
    if stage == REFUSED:
        step_plants(plants, t, h)
        return
    apart = any(map(runs_apart, plants))
    rest = list[Callable[[], None]]()
    for plant in plants[first:]:
        if runs_apart(plant):
            rest.append(partial(plant.finish_remote, t, h))
        elif plant is plants[first]:
            rest.append(partial(_judge, plant, stage, status, t, h))
        else:
            rest.append(partial(plant.step, t, h))
    assert apart or stage != UNDER_WAY
    if apart:
        end_all(rest)
    else:
        for end in rest:
            end()


def _judge(plant: FmuInstance, stage: int, status: int, t: float, h: float) -> None:
    plant.judge_native(stage, status, t, h)
    plant.read(t + h)
