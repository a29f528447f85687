"""Discrete linear models of a diagram: over one base period, or over the least common period of several rates.

The state of a discrete model is that of all blocks and FMUs just before a tick, the signals that subsystems hold, and
the inputs of FMUs that still act on their outputs: the outputs of a co-simulation FMU are those at the end of its last
step. A tick contributes the derivative of the tick's function, the time to the next tick that of the flow, and an FMU
that of its step. The operating point moves along: every tick of a period is linearized at the states of that tick.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from ...blocks.core import Finding, left_of
from ...fmus.running import Derivation
from ..flat import NONE, FlatDiagram, TickPattern
from ..results import OperatingPoint
from ..simulation import announcers
from .derivatives import LocalDerivatives, Numbers, Tap
from .findings import EventWithinPeriod, MemoryActs, UnusualStart
from .plant_models import PlantModel, fmu_at, inputs_before, join_matrices, model_steps, states_of

EQUILIBRIUM = 1e-9
"""Largest residual of an equilibrium."""
SAME = 1e-12
"""Largest difference of values that are the same, relative to 1 + their size."""
Four: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass
class Model:
    """Matrices A, B, C, D of a linear model, with its states and findings; see `Linearization`."""

    matrices: Four
    dt: float
    states: list[str]
    affine: np.ndarray
    derivations: dict[str, Derivation] = field(default_factory=dict)
    uncertainty: float = 0.0
    memory: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


def period_of(flat: FlatDiagram, frozen: frozenset[TickPattern] = NONE) -> int:
    """Return the least common period of all clocks that are not frozen, in ticks of the base."""
    return math.lcm(*(clock.every for clock in flat.distinct if clock not in frozen))


def model_period(
    flat: FlatDiagram,
    local: LocalDerivatives,
    at: OperatingPoint,
    way: str | None,
    frozen: frozenset[TickPattern] = NONE,
) -> Model:
    """Return the model over the least common period of all clocks; those that are frozen do not act."""
    period = period_of(flat, frozen)
    chain = Chain(flat, local, at, way, frozen)
    for k, following in ticks_of_period(flat, at.tick, period):
        chain.go(k, following - k)
    A, B = chain.M, chain.N
    names = chain.labels
    keep = find_needed(A, chain.C, own_states(flat, frozen), set(range(flat.width, flat.width + chain.n_p)))
    memory, findings = _find_memory(flat, A, names)
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


def ticks_of_period(flat: FlatDiagram, first: int, period: int) -> Iterator[tuple[int, int]]:
    """Yield the ticks of a period, each with the next one.

    They are the first one, and those at which a clock acts or an FMU steps.
    """
    every = flat.plants_at_every_tick
    ticks = [k for k in range(first, first + period) if every or k == first or flat.acting(k)]
    yield from zip(ticks, [*ticks[1:], first + period], strict=True)


class Chain:
    """Linear models of the ticks of a period, one after the other.

    M and N lead from the state just before the first tick, and from the injected signals, to the state just before the
    tick that is reached. C and D lead to the signals that are measured at the first tick. ``steps`` holds the four
    matrices of each tick. Clocks that are ``frozen`` do not act: their subsystems hold outputs and states.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        local: LocalDerivatives,
        at: OperatingPoint,
        way: str | None,
        frozen: frozenset[TickPattern] = NONE,
    ):
        self.flat, self.local, self.way, self.frozen = flat, local, way, frozen
        self.first = self.here = at
        self.models: Sequence[PlantModel] = ()
        self.derivations: dict[str, Derivation] = {}
        self.uncertainty, self.n_p = 0.0, 0
        self._known_plants: tuple[float, np.ndarray, np.ndarray, Sequence[PlantModel]] | None = None
        self._known_flow: tuple[float, np.ndarray, np.ndarray, Four] | None = None
        self._begun = False
        self.steps: list[Four] = []
        self._fired: list[Finding] = []
        self._first_tick: Numbers = {}

    def go(self, k: int, count: int) -> None:
        """Go from tick ``k`` to the tick ``count`` base periods later."""
        flat, here, h = self.flat, self.here, float(self.flat.base * count)
        tick = self.local.differentiate(flat.acting(k) - self.frozen, here.t, here.x, here.w)
        models = self.models = self._model_plants(tick["z"], h)
        Ap, Bp, Cp, Dp = (join_matrices(flat, models, which) for which in "ABCD")
        nx, nz, n_p = flat.width, flat.plant_inputs.total, len(Ap)
        n = nx + n_p + nz
        W = np.zeros((flat.plant_outputs.total, n))  # the FMUs' outputs before the tick
        W[:, nx : nx + n_p], W[:, nx + n_p :] = Cp, Dp

        def eliminate_w(quantity: str) -> tuple[np.ndarray, np.ndarray]:
            by_state = tick[quantity, "w"] @ W
            by_state[:, :nx] += tick[quantity, "x"]
            return by_state, tick[quantity, "d"]

        x_of, x_by_d = eliminate_w("x")
        z_of, z_by_d = eliminate_w("z")
        x1 = tick["x"]
        if flat.continuous.size:
            E, Ew, Ed, x1 = self._differentiate_flow(x1, h)
            x_of, x_by_d = E @ x_of + Ew @ W, E @ x_by_d + Ed
        P = Bp @ z_of
        P[:, nx : nx + n_p] += Ap
        M, N = np.vstack([x_of, P, z_of]), np.vstack([x_by_d, Bp @ z_by_d, z_by_d])
        self.steps.append((M, N, *eliminate_w("y")))
        if not self._begun:
            (self.M, self.N, self.C, self.D), self.n_p = self.steps[0], n_p
            self._begun, self._first_tick = True, tick
        else:
            self.M, self.N = M @ self.M, M @ self.N + N
        self._move(k + count, h, x1, tick["z"])

    def _model_plants(self, z: np.ndarray, h: float) -> Sequence[PlantModel]:
        """Return the models of the FMUs' steps; at rest, those of the last tick are used again."""
        before, known = inputs_before(self.flat, self.here), self._known_plants
        if known is not None and known[0] == h and _are_same(known[1], z) and _are_same(known[2], before):
            t = {path: point["t"] + h for path, point in self.here.plants.items()}
            return [replace(m, next={**m.next, "t": t[m.path]}) for m in known[3]]
        models = model_steps(self.flat, self.here, z, h, self.way)
        self.derivations |= {m.path: m.derivation for m in models}
        self.uncertainty = max([self.uncertainty, *(m.uncertainty for m in models)])
        if all(_are_same(m.f, m.x0) for m in models):  # at rest: the same inputs give the same models
            self._known_plants = (h, z, before, models)
        return models

    def _differentiate_flow(self, x1: np.ndarray, h: float) -> Four:
        """Return `differentiate_flow` from here on; at rest, that of the last tick is used again."""
        here, known = self.here, self._known_flow
        if known is not None and known[0] == h and _are_same(known[1], x1) and _are_same(known[2], here.w):
            return known[3]
        found = differentiate_flow(self.flat, self.local, here.t, x1, here.w, h)
        if not self.local.varies and _are_same(found[3], x1):
            self._known_flow = (h, x1, here.w, found)
        self._note_events(found[3], h)
        return found

    def _note_events(self, x_end: np.ndarray, h: float) -> None:
        """Add a finding for each event whose indicator changes its sign over the flow."""
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
        """Move the operating point to tick k."""
        w, plants = self.here.w.copy(), dict(self.here.plants)
        for m in self.models:
            w[m.outputs] = m.y_next
            plants[m.path] = m.next
        t = self.first.t + float((k - self.first.tick) * self.flat.base)
        self.here = replace(self.here, t=t, tick=k, x=x, w=w, z=z, plants=plants)

    @property
    def labels(self) -> list[str]:
        """Names of the model's states: of blocks, of FMUs, and of the inputs that FMUs hold."""
        held = [f"held({label})" for label in self.flat.plant_inputs.labels]
        return self.flat.labels + states_of(self.models) + held

    def affine(self) -> np.ndarray:
        """Return the change of the states over the period at the operating point itself."""
        last, first = self.here, self.first
        inputs = [inputs_before(self.flat, point) for point in (first, last)]
        states = [_plant_states(self.flat, point, self.models) for point in (first, last)]
        return np.concatenate([last.x - first.x, states[1] - states[0], inputs[1] - inputs[0]])

    def findings(self, last: int) -> list[Finding]:
        """Return the events within the period, and a start whose tick is unlike the tick ``last``."""
        findings = list(dict.fromkeys(self._fired))
        if self.first.tick == 0 and np.max(np.abs(self.affine()), initial=0.0) <= EQUILIBRIUM:
            later = self.local.differentiate(
                self.flat.acting(last) - self.frozen, self.here.t, self.here.x, self.here.w
            )
            pairs = [(self._first_tick[e, a], later[e, a]) for e in "xzy" for a in "xwd"]
            if any(np.max(np.abs(a - b), initial=0.0) > 1e-9 * (1 + np.max(np.abs(b), initial=0.0)) for a, b in pairs):
                findings.append(UnusualStart())
        return findings


def _plant_states(flat: FlatDiagram, point: OperatingPoint, models: Sequence[PlantModel]) -> np.ndarray:
    parts = [np.zeros(0)]
    for m in models:
        if m.identified:  # the states of an identified model are zero at rest
            parts.append(np.zeros(len(m.A)))
            continue
        state = point.plants[m.path]["state"]
        parts += [np.ravel(state[name]) for name in fmu_at(flat, m.path).description.states]
    return np.concatenate(parts)


def _are_same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.all(np.abs(a - b) <= SAME * (1.0 + np.abs(a))))


# --- between ticks ---------------------------------------------------------------------------------------------------


def differentiate_flow(
    flat: FlatDiagram, local: LocalDerivatives, t: float, x1: np.ndarray, w: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives of x after the time h by x before it, by w and by d, and x after the time h.

    Only continuous states change. At an equilibrium the derivative is a matrix exponential. Elsewhere the variational
    equation is integrated along the motion (DOP853 at 1e-12), from one discontinuity of a source to the next.
    """
    from scipy.linalg import expm

    xc = flat.continuous
    nc, nx, nw, m = len(xc), flat.width, len(w), local.n_inputs
    many = nx + nw + m

    def differentiate(time: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = x1.copy()
        x[xc] = state
        J = local.differentiate(NONE, time, x, w)
        rest = J["dx", "x"].copy()
        rest[:, xc] = 0.0
        return np.hstack([J["dx", "x"][:, xc], rest, J["dx", "w"], J["dx", "d"]]), J["dx"]

    start, end = x1[xc], t + h
    F, f0 = differentiate(t, start)
    final = x1.copy()
    if not local.varies and np.max(np.abs(f0) / (1.0 + np.abs(start)), initial=0.0) <= EQUILIBRIUM:
        big = np.zeros((nc + many, nc + many))
        big[:nc] = F
        whole = np.asarray(expm(big * h))[:nc]
        final[xc] = start + f0 * h
    else:
        from scipy.integrate import solve_ivp

        s = np.concatenate([start, np.hstack([np.eye(nc), np.zeros((nc, many))]).ravel()])
        for begin, edge in _split_at_discontinuities(flat, t, end):
            left = left_of(edge) if edge < end else edge

            def rates(time: float, s: np.ndarray, left: float = left) -> np.ndarray:
                J, dx = differentiate(min(time, left), s[:nc])
                V = s[nc:].reshape(nc, nc + many)
                forced = J[:, :nc] @ V
                forced[:, nc:] += J[:, nc:]
                return np.concatenate([dx, forced.ravel()])

            found = solve_ivp(rates, (begin, edge), s, method="DOP853", rtol=1e-12, atol=1e-14)
            s = np.asarray(found.y)[:, -1]
        final[xc] = s[:nc]
        whole = s[nc:].reshape(nc, nc + many)
    E, Ew, Ed = np.eye(nx), np.zeros((nx, nw)), np.zeros((nx, m))
    E[np.ix_(xc, xc)] = whole[:, :nc]
    E[xc] += whole[:, nc : nc + nx]
    Ew[xc], Ed[xc] = whole[:, nc + nx : nc + nx + nw], whole[:, nc + nx + nw :]
    return E, Ew, Ed, final


def _split_at_discontinuities(flat: FlatDiagram, t: float, end: float) -> Iterator[tuple[float, float]]:
    """Yield the parts of an interval between the discontinuities of the sources."""
    sources = announcers(flat)
    while t < end:
        edge = min([end, *(source.next_instant(t) for _, source in sources)])
        yield t, edge
        t = edge


def find_moving(flat: FlatDiagram, local: LocalDerivatives, at: OperatingPoint) -> tuple[str, ...]:
    """Return the names of injected signals that change between ticks and that continuous blocks use there."""
    if not flat.continuous.size:
        return ()
    by_d = local.differentiate(NONE, at.t, at.x, at.w)["dx", "d"]
    injected = zip(local.inputs, local.injected, strict=True)
    return tuple(signal.name for signal, where in injected if np.any(by_d[:, where]) and is_moving(flat, signal))


def is_moving(flat: FlatDiagram, signal: Tap) -> bool:
    """Whether a signal follows continuous states between two ticks."""
    return bool(flat.output(signal.port).depends("y", "x")[:, flat.continuous].any())


# --- states of the model ---------------------------------------------------------------------------------------------


def own_states(flat: FlatDiagram, frozen: frozenset[TickPattern] = NONE) -> set[int]:
    """Return the numbers of the states of blocks that are states of the model.

    Modes that only events change, states from which a block in continuous time only starts a search, and states of
    frozen clocks are not.
    """
    table = flat.table

    def acts(path: str) -> bool:
        subsystem = table.subsystem_of[path]
        return table.is_sampled(subsystem) and flat.clocks.get(subsystem) not in frozen

    sampled = flat.states.entries(path for path in flat.states.slices if acts(path))
    return {*flat.continuous.tolist(), *sampled}


def find_needed(A: np.ndarray, C: np.ndarray, own: set[int], plants: set[int]) -> list[int]:
    """Return the numbers of the states of blocks and FMUs, and of the other entries that act on anything.

    The other entries are signals held since a tick and solutions of loops; many are only recorded.
    """
    keep = list(range(len(A)))
    while True:
        gone = [
            j
            for j in keep
            if j not in own | plants and not np.any(A[np.ix_([i for i in keep if i != j], [j])]) and not np.any(C[:, j])
        ]
        gone += [j for j in keep if j not in own | plants and j not in gone and _is_constant(A, keep, j)]
        if not gone:
            return keep
        keep = [j for j in keep if j not in gone]


def _is_constant(A: np.ndarray, keep: list[int], j: int) -> bool:
    """Whether a state stays constant, whatever the others do: a mode."""
    row = A[j, keep].copy()
    row[keep.index(j)] -= 1.0
    return not np.any(row)


def _find_memory(flat: FlatDiagram, A: np.ndarray, names: list[str]) -> tuple[list[str], list[Finding]]:
    """Return the states that only start a search, without effect on the motion, and findings about those that act."""
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
