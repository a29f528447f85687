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
from typing import Any

import numpy as np

from ...blocks.core import Finding, Layout, OptionError
from ...fmus.fmu_block import Derivation
from ..flat import NONE, FlatDiagram, TickPattern
from ..frequency import FourMatrices
from ..results import OperatingPoint
from .chain_slopes import Slopes
from .coupled_chain import LinearStep, coupling_at
from .delay_channels import delay_channels
from .delayed_flow import DelayedFlow, DelayLine, find_steady_slopes
from .derivatives import LocalDerivatives, Numbers
from .derivatives_along import slope_of
from .exchanged import fmu_at, noise_of
from .flow_model import differentiate_flow
from .left_out_effects import EventWithinPeriod, UnusualStart
from .plant_models import (
    EQUILIBRIUM,
    PlantModel,
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
        flat, here, place = self.flat, self.here, len(self.steps)
        h = float(flat.base * (following - k))
        acting = flat.acting(k) - self.frozen
        tick = self.local.differentiate(acting, here.t, here.x, here.w)
        on_way = [path for path in self.paths if self._until[path] != k]
        keeping = self._begin_steps(k, tick["z"])
        line = self._begin_line(tick["x"])
        state, of_plants = self._lay_out(line)
        # At the tick: the states after it, the inputs of FMUs and the measured signals.
        W = self._outputs_before(state, on_way, line, tick["x", "x"].dtype)
        x, z, y = (_read(tick, name, W) for name in "xzy")
        for path in keeping:
            z.hold(self._models[path].inputs, state.slices["z"].start)
        begun = tuple(self._models[path] for path in self.paths if path not in on_way)
        self.visits.append(Visit(acting, here, h, tick, W, tick["x"], begun))
        # From the tick to the next one: the flow of continuous blocks, with the past of transport delays.
        signals = line.signals(x, W) if line else None
        x_end, flow_by_w = tick["x"], np.zeros((flat.width, len(W)), dtype=W.dtype)
        if flat.continuous.size:
            E, flow_by_w, by_d, x_end = self._differentiate_flow(x_end, h)
            x = E @ x + Slopes(flow_by_w @ W, by_d)
        if line and signals:
            late = line.flow_over(place, signals)
            x.by_state[flat.continuous], x.by_d[flat.continuous] = late.by_state, late.by_d
        # The steps of FMUs. Outputs change where a coupling says so; else they follow from the state at the next tick.
        w = Slopes(W, np.zeros((len(W), x.by_d.shape[1]), dtype=W.dtype))
        if self._coupled is None:
            p = self._step_plants(z, state, of_plants, following)
        else:
            n, m = state.total, x.by_d.shape[1]
            p_before = np.zeros((of_plants.total, n + m), dtype=W.dtype)
            p_before[:, state.slices["p"]] = np.eye(of_plants.total)
            step = LinearStep(
                x.side_by_side,
                z.side_by_side,
                w.side_by_side,
                p_before,
                here.t,
                self._end_time(following),
                x_end,
                here.w,
                tick["z"],
                dict(of_plants.slices),
            )
            self._models |= self._coupled.go(step, lambda path, z: self._model_plant(path, z, h), flow_by_w)
            x, p, z, w = (Slopes.split(part, n) for part in (step.x, step.p, step.z, step.w))
        after = [x, p, z, *([w] if self._holds else []), *([line.move(place, signals)] if line and signals else [])]
        whole = Slopes.stack(after)
        if not self.steps:
            self.n_p, self._first_tick = of_plants.total, tick
        self.steps.append((whole.by_state, whole.by_d, y.by_state, y.by_d))
        self._move(following, x_end, tick["z"])

    def _lay_out(self, line: DelayLine | None) -> tuple[Layout, Layout]:
        """Return the layout of the chain's state before a tick, and that of the FMUs' states in it."""
        of_plants = Layout.of({m.path: (len(m.A),) for m in self.models})
        sizes = {
            "x": self.flat.width,
            "p": of_plants.total,
            "z": self.flat.plant_inputs.total,
            "w": self.flat.plant_outputs.total if self._holds else 0,
            "past": len(line) if line else 0,
        }
        return Layout.of({name: (size,) for name, size in sizes.items()}), of_plants

    def _outputs_before(
        self, state: Layout, on_way: Sequence[str], line: DelayLine | None, kind: np.dtype[Any]
    ) -> np.ndarray:
        """Return the derivatives of the outputs of FMUs and transport delays before a tick by the state.

        Those of FMUs that are on their way are held.
        """
        C, D = (join_matrices(self.flat, self.models, which) for which in "CD")
        W = np.zeros((len(C), state.total), dtype=np.result_type(C, kind))
        W[:, state.slices["p"]], W[:, state.slices["z"]] = C, D
        kept = [*self._straight, *(i for path in on_way for i in self._models[path].outputs)]
        W[kept] = 0.0
        W[kept, [state.slices["w"].start + i for i in kept]] = 1.0
        if line:
            W[self._channels.outputs, state.slices["past"]] = line.outputs(len(self.steps))
        return W

    def _step_plants(self, z: Slopes, state: Layout, of_plants: Layout, following: int) -> Slopes:
        """Return the FMUs' states at the next tick; those of FMUs whose steps end later stay."""
        A, B = (join_matrices(self.flat, self.models, which) for which in "AB")
        p: Slopes = B @ z
        p.by_state[:, state.slices["p"]] += A
        for path in self.paths:
            if self._until[path] != following:
                p.hold(of_plants.entries([path]), state.slices["p"].start)
        return p

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


def _read(tick: Numbers, name: str, W: np.ndarray) -> Slopes:
    """Return the slopes of a result of a tick, in which the outputs of FMUs follow from the state."""
    by_state = tick[name, "w"] @ W
    by_state[:, : tick[name, "x"].shape[1]] += tick[name, "x"]
    return Slopes(by_state, tick[name, "d"])


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
