"""Between Python and C: plans of the solver and domains of indicators are handed over and taken back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from ...blocks.core import SimulationError
from ..compiled import (
    LIBRARY_METHODS,
    CompiledHybrid,
    CompiledLoop,
    Fired,
    HandedOver,
    HybridCode,
    MethodOptions,
    NativeExchange,
    Pile,
    TickCode,
    Watch,
)
from ..events import Domains
from ..exchange import INPUT_EVENT
from ..flat import NONE, TickPattern
from ..results import Recorder
from ..solvers import SUNDIALS, AutoSolver
from .algebraic_loops import newton_options
from .compiled_plants import PlantsInC
from .continuous import Continuous
from .solver_setup import has_guards, next_instant, remembers
from .workspace import Workspace

_MOST_EDGES = 100_000  # discontinuities of sources in a call
_METHODS = {"euler": "Euler", "heun": "Heun", "rk4": "Runge-Kutta 4", "RK23": "Bogacki-Shampine 3(2)",
            "RK45": "Dormand-Prince 5(4)", "DOP853": "Dormand-Prince 8(5,3)", "Radau": "Radau IIA 5"}  # fmt: skip


def bind_loop(
    workspace: Workspace, plants: PlantsInC, code: TickCode, recorder: Recorder, stops: Sequence[int],
    exchange: NativeExchange | None = None,
) -> CompiledLoop:  # fmt: skip
    """Return the loop over ticks in C, bound to the numbers of a run, its plants, and the samples that it keeps."""
    entries, here = recorder.entries, workspace.here
    return CompiledLoop(
        code,
        [here.t, here.x, here.w, here.p],
        [workspace.x_next, workspace.z, workspace.log, workspace.ok],
        [*plants.entries.values()],
        columns=entries,
        width=workspace.log.size if entries is None else len(entries),
        every=recorder.every,
        stops=stops,
        loops={clocks: newton_options(workspace.flat, clocks) for clocks in code.loops},
        exchange=exchange,
        held=plants.held,
        inputs=plants.inputs,
    )


def bind_hybrid(
    code: HybridCode,
    workspace: Workspace,
    continuous: Continuous,
    plants: PlantsInC,
    recorder: Recorder,
    stops: Sequence[int],
    methods: Sequence[MethodOptions],
) -> tuple[CompiledHybrid, HandedOver | None]:
    """Return the loop in C, bound to the numbers of a run, and its blocks that are evaluated from outside."""
    flat, here, domains, blocks = workspace.flat, workspace.here, continuous.domains, continuous.exchanged
    handed = (
        None if blocks is None else HandedOver(flat, blocks.blocks, blocks.evaluators, partial(_tell_jump, continuous))
    )
    native = None if handed is None else handed.native
    ticks = bind_loop(workspace, plants, code.ticks, recorder, stops, native)
    always = bool(plants.entries) or workspace.looped or remembers(flat) or has_guards(flat)
    judged = code.judged and not continuous.fixed
    loop = CompiledHybrid(
        code, flat, ticks, [here.t, here.x, here.w, here.p], workspace.x_next, methods,
        step=float(flat.base) if continuous.fixed else None,
        spacing=math.inf if domains is None else domains.spacing,
        own=() if domains is None else domains.own,
        accepts=1 if always or (judged and native is None) else 2 if judged else 0,
        loops=newton_options(flat, NONE) if flat.active_loops(NONE) else None,
        exchange=native,
        delays=continuous.delays,
        tolerances=continuous.resolution,
    )  # fmt: skip
    return loop, handed


def _tell_jump(continuous: Continuous, t: float, path: str, before: np.ndarray, after: np.ndarray) -> None:
    continuous.tell_outside(t, path, INPUT_EVENT, before, after)


def describe_methods(methods: Sequence[MethodOptions], solver: str) -> str:
    """Return in words which methods integrate for a solver of a name, and where."""
    if solver in LIBRARY_METHODS:
        library = "SUNDIALS" if solver in SUNDIALS else "SciPy"
        return f"{library} takes steps of {solver}, and the rest of the run is C"
    names = ", and where it is stiff ".join(f"{_METHODS[m.name]} ({m.name})" for m in methods)
    return f"{names} runs in C as solver={solver!r}"


def hand_over_domains(domains: Domains, loop: CompiledHybrid, watch: Watch) -> None:
    """Let C go on with the domains, and with the times at which events have fired last."""
    (domain, watch.start[:], low, high, slack), (size, rounding), watch.fresh, limits = domains.save()
    watch.latest, watch.largest[:], (loop.fired_times, *recent), rest = limits
    watch.domain[:], watch.low[:], watch.high[:], watch.slack[:] = domain, low, high, slack
    watch.size[:], watch.rounding[:] = size, rounding
    parts: list[np.ndarray] = [*watch.recent, *watch.rest]
    for part, values in zip(parts, [*recent, *rest], strict=True):
        part[:] = values


def take_back_domains(domains: Domains, loop: CompiledHybrid, watch: Watch) -> None:
    """Let Python go on with the domains from C."""
    side, stuck, briefs, brief_at = watch.rest
    rest = side.astype(int), stuck.astype(int), briefs.astype(int), brief_at
    states = watch.domain.astype(int), watch.start.astype(int), watch.low, watch.high, watch.slack
    limits = watch.latest, np.array(watch.largest), (loop.fired_times, *watch.recent), rest
    domains.restore((states, (watch.size, watch.rounding), watch.fresh, limits))


def pile_up(continuous: Continuous, loop: CompiledHybrid, t: float) -> SimulationError:
    """Return the error of events that pile up at t in s, where C has come to; the domains have been taken back."""
    assert continuous.domains is not None
    assert loop.watch is not None
    limits, (pile, event, times) = continuous.domains.limits, loop.pile
    if pile is Pile.IN_CONTACT:
        return limits.rests_in_contact(t, event, times)
    if pile is Pile.ZENO:
        return limits.shows_zeno(event)
    if pile is Pile.CHATTERS:
        continuous.enter(t)
        return continuous.domains.chatters(t, continuous.workspace.here.x[continuous.where])
    return limits.endless(t, loop.watch.fires, times)


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


def changes_method(workspace: Workspace, continuous: Continuous, t: float, h: float) -> bool:
    """Decide, after signs of stiffness or of none in steps of h, whether another method goes on from t."""
    solver = continuous.solver
    assert isinstance(solver, AutoSolver)
    continuous.enter(t)
    told = len(solver.statistics.messages)
    found = solver.decide(t, workspace.here.x[continuous.where], h)
    workspace.messages += tuple(solver.statistics.messages[told:])
    return found


def tell_fired(continuous: Continuous, fired: Sequence[Fired]) -> None:
    """Tell events that have fired in C."""
    for one in fired:
        continuous.tell_event(one.t, one.event, one.before, one.after)


# --- blocks that are evaluated from outside -------------------------------------------------------------------------


def let_act(
    workspace: Workspace, continuous: Continuous, t: float, left: float | None, fired: np.ndarray | None
) -> bool:
    """Let events act at an instant between ticks that C has come to; return whether a stop condition is true there.

    Parameters
    ----------
    left : float or None
        Where a discontinuity is at t: the time in s from the left of it, at which the events act.
    fired : ndarray or None
        Which events of indicators fire; None for events of blocks from outside alone.
    """
    if left is not None:
        continuous.enter(t)
        continuous.stand_left(t, left)
        if fired is None:
            continuous.settle(t)
    elif fired is not None:
        continuous.enter(t)
    if fired is not None:
        continuous.fire(t, fired)
        workspace.messages += continuous.sliding.look(continuous.domains, t)
    continuous.enter(t)
    continuous.settle(t)
    continuous.accept()
    workspace.evaluate()
    return continuous.is_stopped()


def end_tick(
    workspace: Workspace, continuous: Continuous, loop: CompiledHybrid, t: float, acting: frozenset[TickPattern]
) -> None:
    """Let events act behind a tick whose blocks C has evaluated."""
    continuous.enter(t)
    continuous.settle(t)
    continuous.accept()
    flat, taken = workspace.flat, workspace.flat.taken_at(acting)
    workspace.log[flat.log.total :][taken] = loop.taken_states[taken]
