"""A diagram's functions with states that are shifted along directions of its linear model: whether anything notices.

They are evaluated at all ticks of a period and between the ticks, by `LocalDerivatives`, and steps of FMUs are taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...blocks.core import FmuError, Layout, LoopwrightError
from ...fmus.fmu_block import take_shifted_steps
from ...fmus.platform import is_built_here
from ..flat import NONE, FlatDiagram, TickPattern, WiredDiagram
from ..frequency import LinearDelays
from ..results import OperatingPoint
from ..wiring import Wire, join
from .absorbed_shifts import ShiftedBlock
from .delay_channels import delay_channels
from .derivatives import LocalDerivatives, Numbers
from .exchanged import fmu_at, noise_of
from .over_a_period import find_needed, own_states
from .plant_models import PlantModel, join_matrices, linearize_equations, plant_entries, plant_point
from .signal_paths import SignalPaths
from .taps import Tap, find_signal, wire_entries
from .tick_chain import Chain, Visit, period_of

ROUNDING = 1e-10
"""Rounding of a diagram's function, relative to the sizes of what is summed in it: some 1e5 roundings."""
SLOPES = 1e-7
"""Relative difference up to which slopes count as the same."""
SIZES = (7.390851e-7, 7.390851e-4, 7.390851e-2, 0.7390851, 7.390851, 7.390851e2, 7.390851e5)
"""Sizes of shifts, in units of a state's nominal value. No period of a periodic function fits into all of them."""
PLANT_SIZES = (7.390851e-2, 0.7390851, 7.390851)
"""The same of an FMU's states, whose solver may follow their size."""
QUANTA = (1.0, 7.0, 739.0, 73907.0)
"""The same in whole quanta, where a shift moves what an encoder or a converter rounds."""
PART = 0.37
"""Part of an FMU's step after which its states are looked at, too."""
SOLVED = 1e-6
"""Relative error of the steps of another tool's FMU."""


@dataclass(frozen=True, eq=False)
class ClosedModel:
    """A linear model with what it was made of; its attributes are those of a `Linearization`."""

    wired: WiredDiagram
    point: OperatingPoint
    A: np.ndarray
    dt: float
    states: tuple[str, ...]
    memory: tuple[str, ...] = ()
    openings: tuple[str, ...] = ()
    uncertainty: float = 0.0
    plants: str | None = None
    stairs: str | None = None
    delays: LinearDelays | None = None


def _watched(flat: FlatDiagram, model: ClosedModel, required: Iterable[str]) -> tuple[list[Tap], list[ShiftedBlock]]:
    """Return the signals that a free motion does not change: wires on loops, and those on which something is required.

    A block with a guard, and one that ends a run, requires its inputs. Wires on loops that lead into a block which may
    absorb a shift are left out; these blocks are the second result.
    """
    cut = [find_signal(flat, wire).port for wire in model.openings]
    table, found = flat.table, dict[tuple[str, str], set[int]]()

    def add(wire: Wire) -> None:
        found.setdefault((wire.block, wire.port), set()).update(wire_entries(flat, wire))

    on_loops = SignalPaths(flat, cut).wires_on_loops()
    read: dict[str, list[str]] = {}
    for _, reader in on_loops:
        if not reader.is_output:
            read.setdefault(reader.block, []).append(reader.port)
    blocks = {path: block for path, ports in read.items() if (block := ShiftedBlock.of(flat, path, ports)) is not None}
    for source, reader in on_loops:
        if reader.is_output or reader.block not in blocks:
            read_by = None if reader.is_output else table.wires.get((reader.block, reader.port))
            add(Wire(source.block, source.port, None if read_by is None else read_by.index))
    for (path, _), wire in table.wires.items():
        reading = table.blocks[path]
        if hasattr(reading, "guards") or reading.stops:
            add(wire)
    taps = [Tap(join(*port), port, tuple(sorted(entries)), ()) for port, entries in sorted(found.items())]
    return [*taps, *(find_signal(flat, name) for name in dict.fromkeys(required))], list(blocks.values())


@dataclass(frozen=True, eq=False)
class _Instant:
    """An instant of a period at which functions are evaluated with shifted states.

    ``Vx`` and ``Vw`` lead from the model's states at the beginning to the shifts of x and w here, ``rows`` are the
    entries of each result that count, ``still`` those of z that go into delays of a continuous model.
    """

    acting: frozenset[TickPattern]
    t: float
    x: np.ndarray
    w: np.ndarray
    Vx: np.ndarray
    Vw: np.ndarray
    numbers: Numbers
    rows: Mapping[str, np.ndarray]
    still: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))

    def slope(self, name: str) -> np.ndarray:
        """Return the derivative of a result's rows by the model's states."""
        by_x, by_w = (self.numbers[name, a][self.rows[name]] for a in "xw")
        return np.asarray(by_x @ self.Vx + by_w @ self.Vw)

    def follows(self, name: str) -> np.ndarray:
        """Return what `slope` is along a free motion: rates and signals stay, states keep their shift.

        Inputs of FMUs may follow a shift: their steps say what comes of it.
        """
        if name == "z":
            found = self.slope(name)
            found[self.still] = 0.0
            return found
        return self.Vx[self.rows[name]] if name == "x" else np.zeros((len(self.rows[name]), self.Vx.shape[1]))

    def size(self, name: str) -> np.ndarray:
        """Return the sums of the sizes of which `slope` and `follows` are made."""
        by_x, by_w = (np.abs(self.numbers[name, a][self.rows[name]]) for a in "xw")
        return np.asarray(by_x @ np.abs(self.Vx) + by_w @ np.abs(self.Vw) + np.abs(self.follows(name)))


@dataclass(frozen=True, eq=False)
class _PlantStep:
    """A step of an FMU in a period, with the shifts of its states and inputs by the model's states.

    ``equations`` are A and B of its equations where it gives them, ``outputs`` the entries that something depends on.
    """

    path: str
    point: OperatingPoint
    z: np.ndarray
    h: float
    model: PlantModel
    Vp: np.ndarray
    Vz: np.ndarray
    equations: tuple[np.ndarray, np.ndarray] | None
    outputs: np.ndarray


class ShiftedDiagram:
    """Evaluates a diagram's functions with states shifted along directions of its linear model."""

    def __init__(
        self,
        flat: FlatDiagram,
        local: LocalDerivatives,
        instants: Sequence[_Instant],
        plants: Sequence[_PlantStep],
        blocks: Sequence[ShiftedBlock],
        nominals: np.ndarray,
        noise: float,
    ):
        self.blocks = blocks
        self.flat, self.local, self.instants, self.plants = flat, local, instants, plants
        self.nominals, self.noise = nominals, noise
        self.error, noise_of_slopes = noise_of(local.evaluators)
        self.slopes = max(SLOPES, 10.0 * noise_of_slopes)
        self.sizes: tuple[float, ...]
        self.sizes, self.rounding = (PLANT_SIZES, SOLVED) if _has_foreign(flat) else (SIZES, ROUNDING)

    @classmethod
    def of(cls, model: ClosedModel, required: Iterable[str], kept: list[int], noise: float) -> ShiftedDiagram:
        """Return the diagram of a linear model; ``kept`` are the model's states that are no memory."""
        flat, at = model.wired.flatten_like(model.point), model.point
        watched, blocks = _watched(flat, model, required)
        cut, inputs = [find_signal(flat, wire) for wire in model.openings], [t for b in blocks for t in b.taps.values()]
        local = LocalDerivatives.at(flat, at, (), [*watched, *inputs], cut, model.stairs)
        make = _list_instants_of_period if model.dt else _list_instants_of_flow
        instants, plants = make(model, local, kept, np.arange(_count(watched)))
        return cls(flat, local, instants, plants, blocks, _nominals(flat, model, kept), noise)

    def seen(self, directions: np.ndarray, balance: np.ndarray) -> np.ndarray:
        """Return what the linear model sees of some directions: rows of size 1, of which rounding is left out.

        ``balance`` are the sizes of the states in balanced units.
        """
        found = [np.zeros((0, directions.shape[1]))]
        large = np.max(np.abs(directions) / balance[:, None], axis=0) * balance[:, None]

        def add(slope: np.ndarray, size: np.ndarray) -> None:
            rows = self._clean(slope @ directions, size @ large)
            rows = rows[np.any(rows, axis=1)]
            found.append(rows / np.linalg.norm(rows, axis=1)[:, None])

        for instant in self.instants:
            for name in instant.rows:
                add(instant.slope(name) - instant.follows(name), instant.size(name))
        for plant in self.plants:
            if plant.equations is not None:
                A, B = plant.equations
                size = np.abs(A) @ np.abs(plant.Vp) + np.abs(B) @ np.abs(plant.Vz)
                add(A @ plant.Vp + B @ plant.Vz, size)
        return np.vstack(found)

    def _clean(self, values: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return values without those that are rounding of what they are made of."""
        return np.where(np.abs(values) <= self.noise * sizes, 0.0, values)

    def _shift(self, V: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return V v without rounding."""
        return self._clean(V @ v, np.abs(V) @ np.full(len(v), np.max(np.abs(v))))

    def holds(self, v: np.ndarray) -> tuple[bool, tuple[str, ...]]:
        """Return whether nothing notices shifts along a direction, and the FMUs whose states could not be shifted."""
        unit = 1.0 / float(np.max(np.abs(v) / self.nominals))
        alone: dict[str, None] = {}
        try:
            if not all(self._holds_at(instant, v, unit) and self._absorbs(instant, v) for instant in self.instants):
                return False, ()
        except LoopwrightError:  # a shifted state that a block refuses
            return False, ()
        for plant in self.plants:
            held = self._holds_in_step(plant, v, unit)
            if held is None:
                alone[plant.path] = None
            elif not held:
                return False, ()
        return True, tuple(alone)

    def _holds_at(self, instant: _Instant, v: np.ndarray, unit: float) -> bool:
        vx, vw = self._shift(instant.Vx, v), self._shift(instant.Vw, v)
        if not (vx.any() or vw.any()):
            return True
        t, acting, evaluate = instant.t, instant.acting, self.local.evaluate
        before = evaluate(acting, t, instant.x, instant.w)
        quantum = self._find_quantum(instant, vx, vw, before, unit)
        sizes, stairs = (self.sizes, (before["v"], before["s"])) if quantum is None else (QUANTA, None)
        for far in (sign * (quantum or unit) * s for s in sizes for sign in (1.0, -1.0)):
            x, w = instant.x + far * vx, instant.w + far * vw
            after = evaluate(acting, t, x, w, stairs_from=stairs)
            for name, rows in instant.rows.items():
                follows = far * self._shift(instant.follows(name), v)
                by_x, by_w = (np.abs(instant.numbers[name, a][rows]) for a in "xw")
                large = by_x @ (np.abs(instant.x) + np.abs(far * vx)) + by_w @ (np.abs(instant.w) + np.abs(far * vw))
                large = large + np.abs(before[name][rows]) + np.abs(follows)
                if not np.all(np.abs(after[name][rows] - before[name][rows] - follows) <= self.rounding * large):
                    return False
            if not self._has_same_events(t, instant, x, w):
                return False
        return self._has_same_slopes(instant, vx, vw, unit)

    def _find_quantum(
        self, instant: _Instant, vx: np.ndarray, vw: np.ndarray, before: Numbers, unit: float
    ) -> float | None:
        """Return the shift that moves all rounded inputs by one quantum; None where none moves, or they differ."""
        stairs, found = self.local.stairs, set[float]()
        moved = self.local.evaluate(instant.acting, instant.t, instant.x + unit * vx, instant.w + unit * vw)["v"]
        moved = np.abs(moved - before["v"]) / unit
        for i, stair in enumerate(stairs.stairs):
            shift = moved[stairs.v.slices[str(i)]]
            block = self.flat.table.blocks[stair.path]
            if shift.any() and stair.source not in block.quanta:
                return None
            if shift.any():
                quantum = np.broadcast_to(np.ravel(getattr(block, block.quanta[stair.source])), shift.shape)
                found |= set((quantum[shift > 0.0] / shift[shift > 0.0]).tolist())
        return max(found) if found and max(found) - min(found) <= 1e-9 * max(found) else None

    def _absorbs(self, instant: _Instant, v: np.ndarray) -> bool:
        """Return whether the blocks with states on loops answer a shift of their inputs alike at every point."""
        vx = self._shift(instant.Vx, v)
        by_x, by_w = instant.numbers["y", "x"], instant.numbers["y", "w"]
        shift = self._clean(
            (by_x @ instant.Vx + by_w @ instant.Vw) @ v,
            (np.abs(by_x) @ np.abs(instant.Vx) + np.abs(by_w) @ np.abs(instant.Vw)) @ np.abs(v),
        )
        first = _count(self.local.outputs) - _count(tap for block in self.blocks for tap in block.taps.values())
        for block in self.blocks:
            inputs = {}
            for name, tap in block.taps.items():
                inputs[name], first = shift[first : first + len(tap.entries)], first + len(tap.entries)
            if not block.absorbs(self.flat, instant.t, vx[self.flat.states.slices[block.path]], inputs):
                return False
        return True

    def _has_same_slopes(self, instant: _Instant, vx: np.ndarray, vw: np.ndarray, unit: float) -> bool:
        """Return whether the linear model is the same after a shift to either side."""
        for far in (0.7390851 * unit, -7.390851 * unit):
            x, w = instant.x + far * vx, instant.w + far * vw
            after = self.local.differentiate(instant.acting, instant.t, x, w)
            for name, rows in instant.rows.items():
                for a in "xw":
                    old, new = instant.numbers[name, a][rows], after[name, a][rows]
                    allowed = self.slopes * np.max(np.abs(old), axis=1, initial=0.0)[:, None] + 10.0 * self.error
                    if not np.all(np.abs(new - old) <= allowed):
                        return False
        return True

    def _has_same_events(self, t: float, instant: _Instant, x: np.ndarray, w: np.ndarray) -> bool:
        """Return whether the indicators of all events are the same after a shift."""
        flat = self.flat
        if not flat.events or instant.acting:
            return True
        (g, _), (moved, _) = (
            flat.indicators(t, *at, flat.p, evaluators=self.local.evaluators) for at in ((instant.x, instant.w), (x, w))
        )
        large = max(float(np.max(np.abs(part), initial=0.0)) for part in (x, w))
        return bool(np.all(np.abs(moved - g) <= self.rounding * (np.abs(g) + large)))

    def _holds_in_step(self, plant: _PlantStep, v: np.ndarray, unit: float) -> bool | None:
        """Return whether a shift stays as it is over an FMU's step; None if its states can't be shifted."""
        vp, vz, m = self._shift(plant.Vp, v), self._shift(plant.Vz, v), plant.model
        if not (vp.any() or vz.any()):
            return True
        block = fmu_at(self.flat, plant.path)
        if m.identified or not block.description.states:
            return None
        _, _, wired = plant_entries(self.flat, plant.path)
        inputs = Layout.of({port: spec.shape or () for port, spec in block.inputs.items()})
        u = np.zeros(inputs.total)
        u[wired] = vz
        sizes = [sign * unit * s for s in PLANT_SIZES for sign in (1.0, -1.0)]
        now = plant_point(self.flat, plant.point, plant.path, plant.z)
        rounding = ROUNDING if is_built_here(block.description.digest) else SOLVED
        to_outputs = m.y_by_states @ plant.Vp + m.y_by_inputs @ plant.Vz
        follows = np.concatenate([vp, self._shift(to_outputs[plant.outputs], v)])
        for h in (plant.h, PART * plant.h):
            try:
                steps = take_shifted_steps(block, h=h, shifts=[(s * vp, s * u) for s in sizes], **now)
            except FmuError:
                if h == plant.h:
                    return None
                continue  # an FMU of one step length; its equations have been looked at
            ends = [np.concatenate([states, outputs[plant.outputs]]) for states, outputs in steps]
            for s, end in zip(sizes, ends[1:], strict=True):
                large = np.abs(ends[0]) + np.abs(s * follows) + np.max(np.abs(s * vp), initial=0.0)
                if not np.all(np.abs(end - ends[0] - s * follows) <= rounding * large):
                    return False
        return True


def _has_foreign(flat: FlatDiagram) -> bool:
    """Whether an FMU of another tool is evaluated in the diagram's functions."""
    blocks: list[Any] = [flat.table.blocks[path] for path in flat.in_model_exchange]
    return not all(is_built_here(block.description.digest) for block in blocks if hasattr(block, "description"))


def _nominals(flat: FlatDiagram, model: ClosedModel, kept: list[int]) -> np.ndarray:
    """Return the nominal values of a model's states, 1 where none is declared."""
    known: dict[str, float] = {}
    for path, layout in flat.states.of_block.items():
        ports = flat.table.blocks[path].states
        for name in layout.slices:
            nominal = getattr(ports.get(name), "nominal", None)
            for label in Layout.of({f"{path}.{name}": layout.shapes[name]}).labels:
                known[label] = 1.0 if nominal is None else float(np.max(np.abs(nominal)))
    return np.array([known.get(model.states[i], 1.0) or 1.0 for i in kept])


def _list_instants_of_flow(
    model: ClosedModel, local: LocalDerivatives, kept: list[int], watched: np.ndarray
) -> tuple[list[_Instant], list[_PlantStep]]:
    """Return the one instant of a diagram without sampling, and steps of its FMUs from there."""
    flat, at = local.flat, model.point
    J = local.differentiate(NONE, at.t, at.x, at.w)
    models = local.model_equations(at, model.plants)
    nc, n = len(flat.continuous), len(model.states)
    Vx, Vp = np.zeros((flat.width, n)), np.eye(n)[nc:]
    Vx[flat.continuous, np.arange(nc)] = 1.0
    Cp, Dp = (join_matrices(flat, models, which) for which in "CD")
    loop = np.eye(len(at.w)) - Dp @ J["z", "w"]
    Vw = np.linalg.solve(loop, Dp @ J["z", "x"] @ Vx + Cp @ Vp)
    Vx, Vw, Vp = Vx[:, kept], Vw[:, kept], Vp[:, kept]
    rows = {"dx": np.arange(len(J["dx"])), "y": watched, "z": np.arange(len(J["z"]))}
    still = delay_channels(flat).inputs
    instants = [_Instant(NONE, at.t, at.x, at.w, Vx, Vw, J, rows, still)]
    needed = np.any(np.vstack([J[name, "w"] != 0.0 for name in rows]), axis=0)
    Vz = J["z", "x"] @ Vx + J["z", "w"] @ Vw
    plants, first = [], 0
    for m in models:
        own, first = Vp[first : first + len(m.A)], first + len(m.A)
        outputs = np.flatnonzero(needed[m.outputs])
        plants.append(_PlantStep(m.path, at, at.z, float(flat.base), m, own, Vz[m.inputs], (m.A, m.B), outputs))
    return instants, plants


def _list_instants_of_period(
    model: ClosedModel, local: LocalDerivatives, kept: list[int], watched: np.ndarray
) -> tuple[list[_Instant], list[_PlantStep]]:
    """Return the instants at the ticks of a period and between them, and the steps of FMUs."""
    flat = local.flat
    chain = Chain(local, model.point, model.plants, period_of(flat))
    chain.go_on()
    names, nx, n_p = chain.labels, flat.width, chain.n_p
    place = {name: i for i, name in enumerate(names)}
    own = [place[model.states[i]] for i in kept]
    needed = np.array(find_needed(chain.steps, own_states(flat, chain)), dtype=int)
    memory = {place[name] for name in model.memory if name in place}
    needed = np.array([i for i in needed if i not in memory], dtype=int)
    V = np.zeros((len(names), len(own)))
    V[own, np.arange(len(own))] = 1.0
    others = np.setdiff1d(np.arange(len(names)), own)
    whole = np.eye(len(names))
    for M, *_ in chain.steps:
        whole = M @ whole
    for _ in range(2):  # what nothing of the model depends on follows its states
        V[others] = (whole @ V)[others]
    rows = {"x": needed[needed < nx], "z": np.arange(flat.plant_inputs.total), "y": watched}
    between = {"dx": np.arange(len(flat.continuous)), "y": rows["y"]}
    instants, plants = list[_Instant](), list[_PlantStep]()
    equations: dict[tuple[str, int], tuple[np.ndarray, np.ndarray] | None] = {}
    ends = [*(visit.point.x for visit in chain.visits[1:]), chain.here.x]
    for visit, (M, *_), end in zip(chain.visits, chain.steps, ends, strict=True):
        point, tick = visit.point, visit.numbers
        Vx, Vw = V[:nx], visit.W @ V
        instants.append(_Instant(visit.acting, point.t, point.x, point.w, Vx, Vw, tick, rows))
        Vx, Vz = tick["x", "x"] @ Vx + tick["x", "w"] @ Vw, tick["z", "x"] @ Vx + tick["z", "w"] @ Vw
        if flat.continuous.size:
            for t, x in ((point.t, visit.x), (point.t + visit.h, end)):
                numbers = local.differentiate(NONE, t, x, point.w)
                instants.append(_Instant(NONE, t, x, point.w, Vx, Vw, numbers, between))
        plants += _begun_steps(flat, visit, V[nx : nx + n_p], Vz, equations, rows, chain)
        V = M @ V
    return instants, plants


def _count(taps: Iterable[Tap]) -> int:
    return sum(len(tap.entries) for tap in taps)


def _begun_steps(
    flat: FlatDiagram,
    visit: Visit,
    Vp: np.ndarray,
    Vz: np.ndarray,
    equations: dict[tuple[str, int], tuple[np.ndarray, np.ndarray] | None],
    rows: Mapping[str, np.ndarray],
    chain: Chain,
) -> list[_PlantStep]:
    """Return the steps of the FMUs that begin at a tick."""
    needed = [visit.numbers[name, "w"][rows[name]] != 0.0 for name in rows]
    needed = [np.any(np.vstack(needed), axis=0), np.any(visit.numbers["dx", "w"] != 0.0, axis=0)]
    found, slices = [], Layout.of({m.path: (len(m.A),) for m in chain.models}).slices
    for m in visit.begun:
        key = m.path, id(m.A)
        z = visit.numbers["z"]
        if key not in equations:
            try:
                made = linearize_equations(flat, visit.point, m.path, z)
                equations[key] = (made.A, made.B[:, plant_entries(flat, m.path)[2]])
            except LoopwrightError:
                equations[key] = None
        outputs = np.flatnonzero((needed[0] | needed[1])[m.outputs])
        h = float(m.next["t"] - visit.point.plants[m.path]["t"])
        step = _PlantStep(m.path, visit.point, z, h, m, Vp[slices[m.path]], Vz[m.inputs], equations[key], outputs)
        found.append(step)
    return found
