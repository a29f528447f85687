"""The linear model of a diagram with sampled parts: over one base period, or the least common one of several rates.

The state of a discrete model is that of all blocks and FMUs just before a tick, what subsystems hold, and for an FMU
the inputs that still act on its outputs: a co-simulation FMU's outputs are those at the end of its last step. A tick is
the derivative of the tick's function, the time to the next one that of the flow over it, an FMU's that of its step. The
operating point goes along: every tick of a period is linearized where the diagram is then.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...blocks.core import Block, left_of
from ...fmus.running import Derivation
from ..flat import NONE, FlatDiagram
from ..results import OperatingPoint
from .derivatives import Parts, Signal
from .findings import EventWithinPeriod, Finding, MemoryActs, UnusualStart
from .plant_models import PlantModel, inputs_before, joined, states_of, step_models

EQUILIBRIUM = 1e-9
"""Up to this residual an operating point counts as an equilibrium."""
SAME = 1e-12
"""What differs by no more than that, relative to 1 + its size, is the same operating point."""


@dataclass
class Model:
    """Matrices of a linear model, and what is to be said about them."""

    matrices: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    dt: float
    states: list[str]
    affine: np.ndarray
    derivations: dict[str, Derivation] = field(default_factory=dict)
    uncertainty: float = 0.0
    memory: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


def discrete(flat: FlatDiagram, parts: Parts, at: OperatingPoint, way: str | None) -> Model:
    """Return the model over the least common period of all clocks."""
    period = math.lcm(*(clock.every for clock in flat.distinct)) if flat.distinct else 1
    chain = Chain(flat, parts, at, way)
    for k, following in ticks(flat, at.tick, period):
        chain.go(k, following - k)
    A, B = chain.M, chain.N
    names = chain.labels
    keep = needed(A, chain.C, own_states(flat), set(range(flat.width, flat.width + chain.n_p)))
    memory, findings = _memory(flat, A, names)
    findings += chain.findings(at.tick + period)
    A, B, C = A[np.ix_(keep, keep)], B[keep], chain.C[:, keep]
    labels = [names[i] for i in keep]
    return Model(
        (A, B, C, chain.D),
        float(flat.base * period),
        labels,
        chain.affine()[keep],
        chain.derivations,
        chain.uncertainty,
        tuple(m for m in memory if m in labels),
        tuple(findings),
    )


def ticks(flat: FlatDiagram, first: int, period: int) -> Iterator[tuple[int, int]]:
    """Yield the ticks of a period with the one after each: all where an FMU is stepped, else those that matter."""
    every = bool(flat.plant_outputs.total or flat.plant_inputs.total)
    ticks = [k for k in range(first, first + period) if every or k == first or flat.acting(k)]
    yield from zip(ticks, [*ticks[1:], first + period], strict=True)


class Chain:
    """The way through a period, tick by tick.

    M and N lead from the state just before the first tick, and from what is injected, to the state before the tick that
    is reached; C and D to what is measured at the first tick. ``steps`` holds the four matrices of each tick.
    """

    def __init__(self, flat: FlatDiagram, parts: Parts, at: OperatingPoint, way: str | None):
        self.flat, self.parts, self.way = flat, parts, way
        self.first = self.here = at
        self.models: Sequence[PlantModel] = ()
        self.derivations: dict[str, Derivation] = {}
        self.uncertainty, self.n_p = 0.0, 0
        self._reuse: dict[str, Any] = {}
        self._begun = False
        self.steps: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
        self._fired: list[Finding] = []
        self._first_tick: dict[Any, Any] = {}

    def go(self, k: int, count: int) -> None:
        """Go from tick ``k`` over ``count`` base periods."""
        flat, here, h = self.flat, self.here, float(self.flat.base * count)
        tick = self.parts.at(flat.acting(k), here.t, here.x, here.w)
        models = self.models = self._plants(tick["z"], h)
        Ap, Bp, Cp, Dp = (joined(flat, models, which) for which in "ABCD")
        nx, nz, n_p = flat.width, flat.plant_inputs.total, len(Ap)
        n = nx + n_p + nz
        W = np.zeros((flat.plant_outputs.total, n))  # the FMUs' outputs before the tick
        W[:, nx : nx + n_p], W[:, nx + n_p :] = Cp, Dp

        def after(what: str) -> tuple[np.ndarray, np.ndarray]:
            by_state = tick[what, "w"] @ W
            by_state[:, :nx] += tick[what, "x"]
            return by_state, tick[what, "d"]

        x_of, x_by_d = after("x")
        z_of, z_by_d = after("z")
        x1 = tick["x"]
        if flat.continuous.size:
            E, Ew, Ed, x1 = self._flow(x1, h)
            x_of, x_by_d = E @ x_of + Ew @ W, E @ x_by_d + Ed
        P = Bp @ z_of
        P[:, nx : nx + n_p] += Ap
        M, N = np.vstack([x_of, P, z_of]), np.vstack([x_by_d, Bp @ z_by_d, z_by_d])
        self.steps.append((M, N, *after("y")))
        if not self._begun:
            (self.M, self.N, self.C, self.D), self.n_p = self.steps[0], n_p
            self._begun, self._first_tick = True, tick
        else:
            self.M, self.N = M @ self.M, M @ self.N + N
        self._move(k + count, h, x1, tick["z"])

    def _plants(self, z: np.ndarray, h: float) -> Sequence[PlantModel]:
        before, known = inputs_before(self.flat, self.here), self._reuse.get("plants")
        if known is not None and known[0] == h and _same(known[1], z) and _same(known[2], before):
            t = {path: point["t"] + h for path, point in self.here.plants.items()}
            return [replace(m, next={**m.next, "t": t[m.path]}) for m in known[3]]
        models = step_models(self.flat, self.here, z, h, self.way)
        self.derivations |= {m.path: m.derivation for m in models}
        self.uncertainty = max([self.uncertainty, *(m.uncertainty for m in models)])
        if all(_same(m.f, m.x0) for m in models):  # at rest: with the same inputs the same again
            self._reuse["plants"] = (h, z, before, models)
        return models

    def _flow(self, x1: np.ndarray, h: float) -> Any:
        here = self.here
        known = self._reuse.get("flow")
        if known is not None and known[0] == h and _same(known[1], x1) and _same(known[2], here.w):
            return known[3]
        found = transition(self.flat, self.parts, here.t, x1, here.w, h)
        if not self.parts.varies and _same(found[3], x1):
            self._reuse["flow"] = (h, x1, here.w, found)
        self._look_at_events(found[3], h)
        return found

    def _look_at_events(self, x_end: np.ndarray, h: float) -> None:
        flat, here = self.flat, self.here
        if not flat.events:
            return
        (g0, _), (g1, opened) = (
            flat.indicators(t, x, here.w, flat.p) for t, x in ((here.t, here.x), (here.t + h, x_end))
        )
        for event, a, b, now in zip(flat.events, g0 > 0, g1 > 0, opened > 0.5, strict=True):
            if a != b and now:
                self._fired.append(EventWithinPeriod(event.path, event.name, here.t))

    def _move(self, k: int, h: float, x: np.ndarray, z: np.ndarray) -> None:
        """Take the operating point along."""
        w, plants = self.here.w.copy(), dict(self.here.plants)
        for m in self.models:
            w[m.outputs] = m.y_next
            plants[m.path] = m.next
        t = self.first.t + float((k - self.first.tick) * self.flat.base)
        self.here = replace(self.here, t=t, tick=k, x=x, w=w, z=z, plants=plants)

    @property
    def labels(self) -> list[str]:
        """Names of its states: of blocks, of FMUs, and of the inputs that FMUs hold."""
        held = [f"held({label})" for label in self.flat.plant_inputs.labels]
        return self.flat.labels + states_of(self.models) + held

    def affine(self) -> np.ndarray:
        """Return by how much the states change over the period at the operating point itself."""
        last, first = self.here, self.first
        ends = [inputs_before(self.flat, point) for point in (first, last)]
        moved = [_plant_states(self.flat, point, self.models) for point in (first, last)]
        return np.concatenate([last.x - first.x, moved[1] - moved[0], ends[1] - ends[0]])

    def findings(self, last: int) -> list[Finding]:
        """Return events within the period, and a start that is unlike all that follows."""
        findings = list(dict.fromkeys(self._fired))
        if self.first.tick == 0 and np.max(np.abs(self.affine()), initial=0.0) <= EQUILIBRIUM:
            later = self.parts.at(self.flat.acting(last), self.here.t, self.here.x, self.here.w)
            pairs = [(self._first_tick[e, a], later[e, a]) for e in "xzy" for a in "xwd"]
            if any(np.max(np.abs(a - b), initial=0.0) > 1e-9 * (1 + np.max(np.abs(b), initial=0.0)) for a, b in pairs):
                findings.append(UnusualStart())
        return findings


def _plant_states(flat: FlatDiagram, point: OperatingPoint, models: Sequence[PlantModel]) -> np.ndarray:
    parts = [np.zeros(0)]
    for m in models:
        if m.identified:  # its states are made up, and zero at rest
            parts.append(np.zeros(len(m.A)))
            continue
        block: Any = flat.table.blocks[m.path]
        parts += [np.ravel(point.plants[m.path]["state"][name]) for name in block.description.states]
    return np.concatenate(parts)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.all(np.abs(a - b) <= SAME * (1.0 + np.abs(a))))


# --- between ticks ---------------------------------------------------------------------------------------------------


def transition(
    flat: FlatDiagram, parts: Parts, t: float, x1: np.ndarray, w: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivative of x after the time h by x at its beginning, by w and by d, and x then.

    All but the continuous states is held. At an equilibrium of the continuous states it is a matrix exponential;
    elsewhere the variational equation is integrated along the motion (DOP853 at 1e-12), up to the left of each
    discontinuity of a source, and on from its right.
    """
    from scipy.linalg import expm

    xc = flat.continuous
    nc, nx, nw, m = len(xc), flat.width, len(w), parts.n_inputs
    many = nx + nw + m

    def slopes(time: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = x1.copy()
        x[xc] = state
        J = parts.at(NONE, time, x, w)
        rest = J["dx", "x"].copy()
        rest[:, xc] = 0.0
        return np.hstack([J["dx", "x"][:, xc], rest, J["dx", "w"], J["dx", "d"]]), J["dx"]

    start, end = x1[xc], t + h
    F, f0 = slopes(t, start)
    final = x1.copy()
    if not parts.varies and np.max(np.abs(f0) / (1.0 + np.abs(start)), initial=0.0) <= EQUILIBRIUM:
        big = np.zeros((nc + many, nc + many))
        big[:nc] = F
        whole = expm(big * h)[:nc]
        final[xc] = start + f0 * h
    else:
        from scipy.integrate import solve_ivp

        s = np.concatenate([start, np.hstack([np.eye(nc), np.zeros((nc, many))]).ravel()])
        for begin, edge in _pieces(flat, t, end):
            left = left_of(edge) if edge < end else edge

            def rates(time: float, s: np.ndarray, left: float = left) -> np.ndarray:
                J, dx = slopes(min(time, left), s[:nc])
                V = s[nc:].reshape(nc, nc + many)
                forced = J[:, :nc] @ V
                forced[:, nc:] += J[:, nc:]
                return np.concatenate([dx, forced.ravel()])

            found = solve_ivp(rates, (begin, edge), s, method="DOP853", rtol=1e-12, atol=1e-14)
            s = found.y[:, -1]
        final[xc] = s[:nc]
        whole = s[nc:].reshape(nc, nc + many)
    E, Ew, Ed = np.eye(nx), np.zeros((nx, nw)), np.zeros((nx, m))
    E[np.ix_(xc, xc)] = whole[:, :nc]
    E[xc] += whole[:, nc : nc + nx]
    Ew[xc], Ed[xc] = whole[:, nc + nx : nc + nx + nw], whole[:, nc + nx + nw :]
    return E, Ew, Ed, final


def _pieces(flat: FlatDiagram, t: float, end: float) -> Iterator[tuple[float, float]]:
    """Yield the pieces of an interval between the discontinuities of the sources."""
    sources = [
        flat.table.blocks[path]
        for path in flat.checked.traced
        if not flat.table.is_sampled(flat.table.subsystem_of[path])
        and type(flat.table.blocks[path]).next_instant is not Block.next_instant
    ]
    while t < end:
        edge = min([end, *(source.next_instant(t) for source in sources)])
        yield t, edge
        t = edge


def moves_between(flat: FlatDiagram, parts: Parts, at: OperatingPoint) -> tuple[str, ...]:
    """Return the signals that change between ticks, and that continuous blocks use between ticks."""
    if not flat.continuous.size:
        return ()
    by_d = parts.at(NONE, at.t, at.x, at.w)["dx", "d"]
    injected = zip(parts.inputs, parts.injected, strict=True)
    return tuple(signal.name for signal, where in injected if np.any(by_d[:, where]) and _moves(flat, signal))


def _moves(flat: FlatDiagram, signal: Signal) -> bool:
    """Whether a signal follows continuous states between two ticks."""
    return bool(flat.output(signal.port).depends("y", "x")[:, flat.continuous].any())


# --- what counts as a state ------------------------------------------------------------------------------------------


def own_states(flat: FlatDiagram) -> set[int]:
    """Return the states of blocks that are states of the model: not the modes that only events change.

    Nor what a block in continuous time only starts its search from.
    """
    table = flat.table
    sampled = flat.states.entries(path for path in flat.states.slices if table.is_sampled(table.subsystem_of[path]))
    return {*flat.continuous.tolist(), *sampled}


def needed(A: np.ndarray, C: np.ndarray, own: set[int], plants: set[int]) -> list[int]:
    """Return the states of blocks and FMUs, and of the rest those that act on anything.

    The rest only records: what is held since a tick, solutions of loops.
    """
    keep = list(range(len(A)))
    while True:
        gone = [
            j
            for j in keep
            if j not in own | plants and not np.any(A[np.ix_([i for i in keep if i != j], [j])]) and not np.any(C[:, j])
        ]
        gone += [j for j in keep if j not in own | plants and j not in gone and _only_stays(A, keep, j)]
        if not gone:
            return keep
        keep = [j for j in keep if j not in gone]


def _only_stays(A: np.ndarray, keep: list[int], j: int) -> bool:
    """Whether a state stays what it is, whatever the others do: a mode."""
    row = A[j, keep].copy()
    row[keep.index(j)] -= 1.0
    return not np.any(row)


def _memory(flat: FlatDiagram, A: np.ndarray, names: list[str]) -> tuple[list[str], list[Finding]]:
    """Return the states from which a block only starts its search: what they are has no effect on anything."""
    found, findings = list[str](), list[Finding]()
    scale = np.max(np.abs(A), initial=1.0)
    for path, where in flat.states.slices.items():
        if not flat.table.blocks[path].memory or where.stop == where.start:
            continue
        if np.max(np.abs(A[:, where])) <= EQUILIBRIUM * scale:
            found += names[where]
        else:
            findings.append(MemoryActs(path, float(np.max(np.abs(A[:, where])))))
    return found, findings
