"""Linear models of the ticks of a period, one after the other.

The state of a discrete model is that of all blocks and FMUs just before a tick, the signals that subsystems hold, and
the inputs of FMUs that still act on their outputs: the outputs of a co-simulation FMU are those at the end of its last
step. A tick contributes the derivative of the tick's function, the time to the next tick that of the flow, and an FMU
that of its step. The operating point moves along: every tick of a period is linearized at the states of that tick.
`over_a_period` makes models of a whole period of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...blocks.core import Finding, Layout, OptionError
from ...fmus.running import Derivation
from ..flat import NONE, FlatDiagram, TickPattern
from ..frequency import FourMatrices
from ..results import OperatingPoint
from .coupled_chain import LinearStep, coupling_at
from .delay_channels import delay_channels
from .delayed_flow import DelayedFlow, DelayLine, find_steady_slopes
from .derivatives import LocalDerivatives, Numbers
from .derivatives_along import slope_of
from .exchanged import noise_of
from .flow_model import differentiate_flow
from .left_out_effects import EventWithinPeriod, UnusualStart
from .plant_models import (
    EQUILIBRIUM,
    PlantModel,
    fmu_at,
    inputs_before,
    join_matrices,
    plant_paths,
    states_of,
)

SAME = 1e-12
"""Largest difference of values that are the same, relative to 1 + their size."""


def period_of(flat: FlatDiagram, frozen: frozenset[TickPattern] = NONE) -> int:
    """Return the least common period of all clocks and FMUs that are not frozen, in ticks of the base."""
    plants = {clock for clocks in flat.plant_ticks.values() for clock in clocks}
    return math.lcm(*(clock.every for clock in {*flat.distinct} | plants if clock not in frozen))


def ticks_of_period(flat: FlatDiagram, first: int, period: int, *, every: bool = False) -> Iterator[tuple[int, int]]:
    """Yield the ticks of a period, each with the next one.

    They are the first one, and those at which a clock acts or an FMU steps; or all of them.
    """
    ticks = [k for k in range(first, first + period) if every or k == first or any(c.acts(k) for c in flat.visited)]
    yield from zip(ticks, [*ticks[1:], first + period], strict=True)


@dataclass(frozen=True, eq=False)
class Visit:
    """A tick of a chain with what its linear model was made of."""

    acting: frozenset[TickPattern]  # clocks that act
    point: OperatingPoint  # operating point just before the tick
    h: float  # time to the next tick in s
    numbers: Numbers  # values and derivatives at the tick, of `LocalDerivatives.differentiate`
    W: np.ndarray  # derivatives of the FMUs' outputs before the tick by the chain's state
    x: np.ndarray  # the vector x after the tick
    begun: tuple[PlantModel, ...]  # models of the FMUs' steps that begin at the tick


class Chain:
    """Linear models of the ticks of a period, one after the other.

    ``steps`` holds four matrices for each tick. They lead from the state just before the tick and the injected signals
    to the state just before the next tick, and to the signals that are measured at the tick. Clocks that are ``frozen``
    do not act: their subsystems hold outputs and states.

    An FMU goes from one of its communication points to the next, with the inputs of the first one. Between them its
    outputs are held: where an FMU has fewer of them than there are ticks, these outputs are states, too.

    Ticks at which nothing acts are left out, unless the chain is to go through ``every`` tick.
    """

    def __init__(
        self,
        local: LocalDerivatives,
        at: OperatingPoint,
        way: str | None,
        count: int,
        frozen: frozenset[TickPattern] = NONE,
        *,
        every: bool = False,
    ):
        flat = local.flat
        self._coupled = coupling_at(local, at)
        self.flat, self.local, self.way, self.frozen = flat, local, way, frozen
        self.first = self.here = at
        self.ticks = list(ticks_of_period(flat, at.tick, count, every=every))
        self._end = at.tick + count
        self.paths = plant_paths(flat)
        self._until = dict.fromkeys(self.paths, at.tick)
        self._holds = any(not self._steps_at(path, k) for path in self.paths for k, _ in self.ticks[1:])
        self._straight = [] if self._coupled is None else np.flatnonzero(self._coupled.straight).tolist()
        if self._coupled is not None:
            self._coupled.check_ticks(self._holds or any(not self._steps_at(path, at.tick) for path in self.paths))
            self._holds = bool(self._straight)
        self._channels = delay_channels(flat)
        self._line: DelayLine | None = None
        if len(self._channels):
            self._check_delays()
        self._models: dict[str, PlantModel] = {}
        self.derivations: dict[str, Derivation] = {}
        self.uncertainty, self.n_p = 0.0, 0
        self._known_plants: dict[str, tuple[float, np.ndarray, np.ndarray, PlantModel]] = {}
        self._known_flow: tuple[float, np.ndarray, np.ndarray, FourMatrices, float] | None = None
        self.steps: list[FourMatrices] = []
        self.visits: list[Visit] = []
        self._fired: list[Finding] = []
        self._first_tick: Numbers = {}

    @property
    def models(self) -> list[PlantModel]:
        """Models of the FMUs' present steps."""
        return [self._models[path] for path in self.paths]

    def _steps_at(self, path: str, k: int) -> bool:
        return any(clock.acts(k) for clock in self.flat.plant_ticks[path] if clock not in self.frozen)

    def go_on(self) -> None:
        """Go through all ticks."""
        for k, following in self.ticks:
            self.go(k, following)

    def go(self, k: int, following: int) -> None:
        """Go from tick ``k`` to the next one."""
        flat, here, h = self.flat, self.here, float(self.flat.base * (following - k))
        acting = flat.acting(k) - self.frozen
        tick = self.local.differentiate(acting, here.t, here.x, here.w)
        mid_step = [path for path in self.paths if self._until[path] != k]
        held = self._begin_steps(k, tick["z"])
        kept = [*self._straight, *(i for path in mid_step for i in self._models[path].outputs)]
        models = self.models
        Ap, Bp, Cp, Dp = (join_matrices(flat, models, which) for which in "ABCD")
        line = self._begin_line(tick["x"])
        nx, nz, n_p, nw = flat.width, flat.plant_inputs.total, len(Ap), flat.plant_outputs.total
        n = nx + n_p + nz + (nw if self._holds else 0) + (len(line) if line else 0)
        W = np.zeros((nw, n), dtype=np.result_type(Cp, tick["x", "x"]))  # outputs of FMUs and delays before the tick
        W[:, nx : nx + n_p], W[:, nx + n_p : nx + n_p + nz] = Cp, Dp
        W[kept] = 0.0
        W[kept, [nx + n_p + nz + i for i in kept]] = 1.0
        place = len(self.steps)
        if line:
            W[self._channels.outputs, n - len(line) :] = line.outputs(place)

        def eliminate_w(quantity: str) -> tuple[np.ndarray, np.ndarray]:
            by_state = tick[quantity, "w"] @ W
            by_state[:, :nx] += tick[quantity, "x"]
            return by_state, tick[quantity, "d"]

        x_of, x_by_d = eliminate_w("x")
        z_of, z_by_d = eliminate_w("z")
        for path in held:  # the inputs that it has already
            mine = self._models[path].inputs
            z_of[mine], z_by_d[mine] = 0.0, 0.0
            z_of[mine, [nx + n_p + i for i in mine]] = 1.0
        x1 = tick["x"]
        signals = line.signals((x_of, x_by_d), W) if line else None
        begun = tuple(self._models[path] for path in self.paths if path not in mid_step)
        self.visits.append(Visit(acting, here, h, tick, W, x1, begun))
        if flat.continuous.size:
            E, Ew, Ed, x1 = self._differentiate_flow(x1, h)
            x_of, x_by_d = E @ x_of + Ew @ W, E @ x_by_d + Ed
        else:
            Ew = np.zeros((nx, nw), dtype=W.dtype)
        if line and signals:
            x_of[flat.continuous], x_by_d[flat.continuous] = line.flow_over(place, signals)
        P, P_by_d = Bp @ z_of, Bp @ z_by_d
        P[:, nx : nx + n_p] += Ap
        W_next, states = W, Layout.of({m.path: (len(m.A),) for m in models})
        for path in self.paths:
            if self._until[path] != following:  # it is on its way
                rows = states.entries([path])
                P[rows], P_by_d[rows] = 0.0, 0.0
                P[rows, [nx + i for i in rows]] = 1.0
        W_by_d = np.zeros((nw, x_by_d.shape[1]), dtype=W.dtype)
        if self._coupled is not None:
            before = np.zeros((n_p, n + x_by_d.shape[1]), dtype=P.dtype)
            before[:, nx : nx + n_p] = np.eye(n_p)
            x_all, z_all, w_all = (np.hstack(pair) for pair in ((x_of, x_by_d), (z_of, z_by_d), (W, W_by_d)))
            end = self._end_time(following)
            step = LinearStep(x_all, z_all, w_all, before, here.t, end, x1, here.w, tick["z"], dict(states.slices))
            self._models |= self._coupled.go(step, lambda path, z: self._model_plant(path, z, h), Ew)
            (x_of, x_by_d), (P, P_by_d), (z_of, z_by_d), (W_next, W_by_d) = (
                (part[:, :n], part[:, n:]) for part in (step.x, step.p, step.z, step.w)
            )
        M, N = np.vstack([x_of, P, z_of]), np.vstack([x_by_d, P_by_d, z_by_d])
        if self._holds:
            M, N = np.vstack([M, W_next]), np.vstack([N, W_by_d])
        if line and signals:
            past = line.move(place, signals)
            M, N = np.vstack([M, past[0]]), np.vstack([N, past[1]])
        if not self.steps:
            self.n_p, self._first_tick = n_p, tick
        self.steps.append((M, N, *eliminate_w("y")))
        self._move(following, x1, tick["z"])

    def _check_delays(self) -> None:
        """Refuse transport delays next to FMUs that are coupled within a step."""
        if self._coupled is not None:
            raise OptionError(
                "found a transport delay next to FMUs with a coupling that acts within a step; expected "
                "coupling='jacobi'. Linearize with it, or put the delay into a sampled subsystem.",
                block=self._channels.paths[0],
            )

    def _begin_line(self, x1: np.ndarray) -> DelayLine | None:
        """Return the line of transport delays' past, from the derivatives after the first tick; None without delays."""
        if not len(self._channels):
            return None
        flat, here = self.flat, self.here
        J = find_steady_slopes(self.local, self._channels, here.t, x1, here.w)
        if self._line is None:
            start, base = self.first.tick, flat.base
            times = [base * (k - start) for k, _ in self.ticks]
            flow = DelayedFlow(self._channels, flat.continuous, J, times, base * (self._end - start))
            self._line = DelayLine(flow, flat, [label for s in self.local.inputs for label in s.labels])
        else:
            self._line.flow.check_same(J)
        return self._line

    def _begin_steps(self, k: int, z: np.ndarray) -> list[str]:
        """Begin the steps of the FMUs that stand at a tick; return those that keep the inputs that they hold."""
        held = []
        for path in self.paths:
            own = self._steps_at(path, k)
            if not own:
                held.append(path)
            if self._until[path] == k:
                ends = (clock.after(k) for clock in self.flat.plant_ticks[path] if clock not in self.frozen)
                self._until[path] = min([*ends, self._end])
                h = float(self.flat.base * (self._until[path] - k))
                self._models[path] = self._model_plant(path, z if own else inputs_before(self.flat, self.here), h)
        return held

    def _model_plant(self, path: str, z: np.ndarray, h: float) -> PlantModel:
        """Return the model of an FMU's step; at rest, that of the last one is used again."""
        before, known = inputs_before(self.flat, self.here), self._known_plants.get(path)
        if known is not None and known[0] == h and _are_same(known[1], z) and _are_same(known[2], before):
            return replace(known[3], next={**known[3].next, "t": self.here.plants[path]["t"] + h})
        model = self.local.model_step(self.here, path, z, h, self.way)
        self.derivations[path] = model.derivation
        self.uncertainty = max(self.uncertainty, model.uncertainty)
        if _are_same(model.f, model.x0):  # at rest: the same inputs give the same model
            self._known_plants[path] = (h, z, before, model)
        return model

    def _differentiate_flow(self, x1: np.ndarray, h: float) -> FourMatrices:
        """Return `differentiate_flow` from here on; at rest, that of the last tick is used again."""
        here, known = self.here, self._known_flow
        if (
            known is not None
            and known[0] == h
            and here.t + h <= known[4]
            and _are_same(known[1], x1)
            and _are_same(known[2], here.w)
        ):
            return known[3]
        found = differentiate_flow(self.local, here.t, x1, here.w, h)
        if _are_same(found[3], x1):
            self._known_flow = (h, x1, here.w, found, self.local.stays_until(here.t))
        self._note_events(found[3], h)
        return found

    def _note_events(self, x_end: np.ndarray, h: float) -> None:
        """Add a finding for each event whose indicator changes its sign over the flow."""
        flat, here = self.flat, self.here
        if not flat.events:
            return
        evaluators = self.local.evaluators
        (g0, _), (g1, opened) = (
            flat.indicators(t, np.real(x), np.real(here.w), flat.p, evaluators=evaluators)
            for t, x in ((here.t, here.x), (here.t + h, x_end))
        )
        for event, a, b, now in zip(flat.events, g0 > 0, g1 > 0, opened > 0.5, strict=True):
            if a != b and now:
                self._fired.append(EventWithinPeriod(event.path, event.name, here.t))

    def _end_time(self, k: int) -> float:
        return self.first.t + float((k - self.first.tick) * self.flat.base)

    def _move(self, k: int, x: np.ndarray, z: np.ndarray) -> None:
        """Move the operating point to tick k."""
        kind = np.result_type(self.here.w, *(m.y_next for m in self.models))
        w, plants = self.here.w.astype(kind), dict(self.here.plants)
        for m in self.models:
            if self._until[m.path] == k:
                w[m.outputs] = m.y_next
                plants[m.path] = m.next
        self.here = replace(self.here, t=self._end_time(k), tick=k, x=x, w=w, z=z, plants=plants)

    @property
    def labels(self) -> list[str]:
        """Names of the model's states: of blocks, of FMUs, and of the inputs and outputs that FMUs hold."""
        ports = self.flat.plant_inputs.labels + (self.flat.plant_outputs.labels if self._holds else [])
        held = [f"held({label})" for label in ports]
        return self.flat.labels + states_of(self.models) + held + (self._line.labels if self._line else [])

    def affine(self) -> np.ndarray:
        """Return the change of the states over the period at the operating point itself."""
        last, first = self.here, self.first
        inputs = [inputs_before(self.flat, point) for point in (first, last)]
        states = [_plant_states(self.flat, point, self.models) for point in (first, last)]
        outputs = [last.w - first.w] if self._holds else []
        late = [np.resize(self._delay_changes(), len(self._line))] if self._line else []
        return np.concatenate([last.x - first.x, states[1] - states[0], inputs[1] - inputs[0], *outputs, *late])

    def _delay_changes(self) -> np.ndarray:
        """Return what the outputs of the transport delays still have to change by until they are their inputs."""
        last = self.here
        z = self.local.differentiate(NONE, last.t, last.x, last.w)["z"]
        return np.asarray(z[self._channels.inputs] - last.w[self._channels.outputs])

    def findings(self, last: int) -> list[Finding]:
        """Return the events within the period, and a start whose tick is unlike the tick ``last``."""
        findings = list(dict.fromkeys(self._fired))
        if self.first.tick == 0 and np.max(np.abs(self.affine()), initial=0.0) <= EQUILIBRIUM:
            later = self.local.differentiate(
                self.flat.acting(last) - self.frozen, self.here.t, self.here.x, self.here.w
            )
            pairs = [(self._first_tick[e, a], later[e, a]) for e in "xzy" for a in "xwd"]
            same = max(1e-9, 10.0 * noise_of(self.local.evaluators)[0])
            if any(np.max(np.abs(a - b), initial=0.0) > same * (1 + np.max(np.abs(b), initial=0.0)) for a, b in pairs):
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
    if np.iscomplexobj(a) or np.iscomplexobj(b):  # values with slopes
        return _are_same(np.real(a), np.real(b)) and _are_same(slope_of(a), slope_of(b))
    return bool(np.all(np.abs(a - b) <= SAME * (1.0 + np.abs(a))))
