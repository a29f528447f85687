"""Between Python and C: what the loop is bound to, and the plans of the method."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from ..compiled import (
    CompiledHybrid,
    CompiledLoop,
    DiagramCode,
    HandedOver,
    MethodOptions,
    NativeModelExchange,
)
from ..flat import NONE
from ..results import Recorder
from ..solvers import METHODS
from .algebraic_loops import newton_options
from .compiled_plants import PlantsInC
from .continuous import Continuous
from .solver_setup import has_guards, next_instant, remembers
from .workspace import Workspace

_MOST_EDGES = 100_000  # discontinuities of sources in a call


def bind_loop(
    workspace: Workspace,
    plants: PlantsInC,
    code: DiagramCode,
    recorder: Recorder,
    stops: Sequence[int],
    exchange: NativeModelExchange | None = None,
    rest: Callable[[], int] | None = None,
) -> CompiledLoop:
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
        loops={clocks: newton_options(workspace.flat, clocks, here.x) for clocks in code.loops},
        exchange=exchange,
        held=plants.held,
        inputs=plants.inputs,
        rest=rest,
    )


def bind_hybrid(
    code: DiagramCode,
    workspace: Workspace,
    continuous: Continuous,
    plants: PlantsInC,
    recorder: Recorder,
    stops: Sequence[int],
    methods: Sequence[MethodOptions],
    *,
    rest: Callable[[], int],  # evaluates a tick for which there is no code; see `CompiledLoop`
    drain: Callable[[], None],  # reports the events that have happened
) -> tuple[CompiledHybrid, HandedOver | None]:
    """Return the loop in C, bound to the numbers of a run, and its blocks in model exchange."""
    flat, here, domains, blocks = workspace.flat, workspace.here, continuous.domains, continuous.exchanged
    # Blocks in model exchange and their own events come together, or neither is there.
    handed = (
        None
        if blocks is None or continuous.own_events is None
        else HandedOver(
            flat,
            blocks.blocks,
            blocks.evaluators,
            lambda event: continuous.report_own_event(*event),
            continuous.own_events.count,
        )
    )
    native = None if handed is None else handed.native
    ticks = bind_loop(workspace, plants, code, recorder, stops, native, rest)
    loop = CompiledHybrid(
        code,
        flat,
        ticks,
        [here.t, here.x, here.w, here.p],
        workspace.x_next,
        methods,
        step=float(flat.base) if continuous.fixed else None,
        domains=domains,
        accepts=accepts_of(
            workspace, continuous, judged=code.judged, plants=bool(plants.entries), exchanged=native is not None
        ),
        loops=newton_options(flat, NONE, here.x) if flat.active_loops(NONE) else None,
        exchange=native,
        delays=continuous.delays,
        tolerances=continuous.resolution,
        drain=drain,
        coupled=plants.are_coupled,
    )
    return loop, handed


def accepts_of(
    workspace: Workspace, continuous: Continuous, *, judged: bool, plants: bool = False, exchanged: bool = False
) -> int:
    """Return after which steps blocks are evaluated, see `CompiledHybrid`; ``judged``: outputs may be non-finite."""
    flat, judged = workspace.flat, judged and not continuous.fixed
    always = plants or workspace.looped or remembers(flat) or has_guards(flat)
    return 1 if always or (judged and not exchanged) else 2 if judged else 0


def describe_methods(methods: Sequence[MethodOptions], solver: str) -> str:
    """Return in words which methods integrate for a solver of a name, and where."""
    facts = METHODS.get(solver)
    if facts is not None and facts.library is not None:
        return f"{facts.library.value} takes steps of {facts.title}, and the rest of the run is C"
    names = ", and where it is stiff ".join(f"{METHODS[m.name].title} ({m.name})" for m in methods)
    return f"{names} runs in C as solver={solver!r}"


def methods_of(continuous: Continuous) -> list[MethodOptions]:
    """Return the methods in C that integrate a run."""
    method, n = continuous.method, continuous.where.size
    if not n:
        return [MethodOptions("euler", 1.0, np.zeros(0), method.max_step)]
    if method.fixed:
        return [MethodOptions(method.name, 1.0, np.zeros(n), method.max_step)]
    atol = np.broadcast_to(np.asarray(method.atol, dtype=float), (n,)).copy()
    return [MethodOptions(name, method.rtol, atol, method.max_step) for name in method.names]


def find_edges(
    continuous: Continuous, t: float, end: float, *, limited: bool = True
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the discontinuities of sources from t to the first of each after the end; None if they are too many."""
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


class EdgesAhead:
    """Discontinuities of sources, found once for a stretch of ticks, in however many calls C goes through it."""

    def __init__(self, continuous: Continuous):
        self._continuous = continuous
        self._begin, self._end = math.inf, -math.inf
        self._found = np.zeros(0), np.zeros(0)

    def until(self, t: float, end: float, *, limited: bool) -> tuple[np.ndarray, np.ndarray] | None:
        """Return those from t on, up to an end and the first one of each source after it; see `find_edges`."""
        if t < self._begin or end > self._end:
            found = find_edges(self._continuous, t, end, limited=limited)
            if found is None:
                return None
            self._begin, self._end, self._found = t, end, found
        edges, late = self._found
        first = int(np.searchsorted(edges, t, side="left" if t in self._continuous.late else "right"))
        return edges[first:], late[first:]
