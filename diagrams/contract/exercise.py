"""Exercise of a block: signals within the ranges of its inputs, and points at which its equations are evaluated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as replace_fields
from functools import cached_property
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import (
    Array,
    Block,
    Call,
    Layout,
    OptionError,
    Output,
    PortUnit,
    Shape,
    ShapeError,
    Signal,
    State,
    as_signal,
    near,
    parameter,
    shape_of,
)
from ...blocks.tracing import (
    GUARDS,
    NEXT,
    Columns,
    Point,
    Traced,
    bundle,
    constants_of,
    evaluate,
    initial_state,
    start_values,
    traced_parameters,
)
from ..diagram import Diagram
from ..results import Run
from ..wiring import Collector, exact_time

_SAMPLES = 400  # of the exercise, over its duration


class Wander(Block):
    """A sum of three sines within [low, high], whose frequencies and phases come from a seed."""

    low: Array = parameter(description="smallest values")
    high: Array = parameter(description="largest values")
    duration: float = parameter(unit="s", above=0.0, description="period")
    seed: tuple[int, ...] = parameter(description="seed of frequencies and phases")
    unit: PortUnit = parameter(default=None, description="unit of the signal")
    y = Output(shape=None, description="the signal")

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """The signal."""
        return {"y": Output(np.shape(self.low), self.unit, name="y")}

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the signal."""
        rng = np.random.default_rng(self.seed)
        wave: Array = 0.0 * self.low
        for weight, turns in ((0.5, 1.0), (0.3, 2.6), (0.2, 4.3)):
            rate = turns / self.duration * rng.uniform(0.8, 1.2, shape_of(self.low))
            phase = rng.uniform(size=shape_of(self.low))
            wave = wave + weight * np.sin(2.0 * np.pi * (rate * t + phase))
        return 0.5 * (self.low + self.high) + 0.5 * (self.high - self.low) * wave


@dataclass(frozen=True)
class Exercise:
    """Ranges and signals that drive a block's inputs."""

    block: Block
    shapes: dict[str, Shape]  # of every input
    ranges: dict[str, tuple[np.ndarray, np.ndarray]]  # lowest and highest values of the inputs without a signal
    signals: dict[str, Signal]  # that the other inputs are wired to
    sample_time: float
    ticks: int
    seed: int

    @classmethod
    def of(
        cls,
        block: Block,
        inputs: Mapping[str, object],
        shapes: Mapping[str, Shape],
        sample_time: float,
        ticks: int,
        seed: int,
    ) -> Exercise:
        """Return the exercise for a block; see `check_block`."""
        for option, names in (("inputs", inputs), ("shapes", shapes)):
            for name in names:
                if name not in block.inputs:
                    raise OptionError(
                        f"found {name!r}, which is no input of {block.label}. {near(name, block.inputs)}",
                        block="check_block",
                        port=option,
                    )
        ranges: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        signals: dict[str, Signal] = {}
        found: dict[str, Shape] = {}
        for name, port in block.inputs.items():
            shape = port.shape
            if shape is None:
                shape = tuple(shapes.get(name, () if port.default is None else np.shape(port.default)))
            given = inputs.get(name)
            # where nothing is given: some nominal values around 0, moved within the limits that the port declares
            reach = 3.0 * (port.nominal or 1.0)
            low, high = port.minimum, port.maximum
            low = low if low is not None else -reach if high is None else min(-reach, high - 2.0 * reach)
            high = high if high is not None else max(reach, low + 2.0 * reach)
            ends: tuple[ArrayLike, ArrayLike] = (low, high)
            if _is_range(given):
                ends = given
                if port.shape is None and name not in shapes:
                    shape = np.broadcast_shapes(*map(np.shape, ends))
            elif given is not None:
                signals[name] = as_signal(given, block=block.label, port=name)
                continue
            try:
                lowest, highest = (np.array(np.broadcast_to(v, shape), dtype=float) for v in ends)
            except ValueError:
                raise ShapeError(
                    f"found a range of shape {np.shape(ends[0])}; expected {shape}. Give numbers, or arrays of this "
                    "shape.",
                    block=block.label,
                    port=name,
                ) from None
            ranges[name], found[name] = (lowest, highest), shape
        result = cls(block, found, ranges, signals, sample_time, ticks, seed)
        if signals:
            found.update({n: np.shape(v)[1:] for n, v in result.samples.items() if n in signals})
        return replace_fields(result, shapes={n: found[n] for n in block.inputs})

    @property
    def duration(self) -> float:
        """Simulated time of the exercise in s."""
        return float(exact_time(self.sample_time) * self.ticks)

    def make_signals(self) -> dict[str, Signal]:
        """Return the signal that drives each input."""
        made = dict(self.signals)
        for number, (name, (low, high)) in enumerate(self.ranges.items()):
            unit = self.block.inputs[name].unit
            source = Wander(
                low=low, high=high, duration=self.duration, seed=(self.seed, number), unit=unit, name=f"input_{number}"
            )
            made[name] = source.y
        return made

    def diagram(self, sampled: bool) -> Diagram:
        """Return the block, driven, in a subsystem of one kind."""
        return _make_diagram("contract", [self.block(**self.make_signals())], self.sample_time if sampled else None)

    @cached_property
    def samples(self) -> dict[str, np.ndarray]:
        """Values of the inputs over time, one row for each instant of `times`."""
        if not self.block.inputs:
            return {}
        names = {f"u_{i}": (name, signal) for i, (name, signal) in enumerate(self.make_signals().items())}
        roots = [signal.named(short) for short, (_, signal) in names.items()]
        run = _make_diagram("exercise", roots, None).simulate(
            self.duration, step=self.duration / _SAMPLES, progress=False
        )
        _, last = np.unique(run.t, return_index=True)  # the last one of several samples of one time
        return {name: _read_rows(run, short, self.times, last) for short, (name, _) in names.items()}

    @property
    def times(self) -> np.ndarray:
        """Instants of `samples`."""
        return np.linspace(0.0, self.duration, _SAMPLES + 1)

    def inputs_at(self, i: int, rng: np.random.Generator | None = None) -> dict[str, np.ndarray]:
        """Return the inputs at an instant; with a generator, those with a range are drawn from it."""
        drawn = {} if rng is None else {n: rng.uniform(*ends) for n, ends in self.ranges.items()}
        return {n: np.asarray(drawn[n] if n in drawn else self.samples[n][i]) for n in self.shapes}


def _is_range(given: object) -> TypeGuard[tuple[ArrayLike, ArrayLike]]:
    return isinstance(given, tuple) and len(given) == 2 and not any(isinstance(v, Signal | Block) for v in given)


def _read_rows(run: Run, name: str, times: np.ndarray, kept: np.ndarray) -> np.ndarray:
    where = np.searchsorted(run.t[kept], times - 1e-9 * times[-1])
    samples: np.ndarray = run[name][kept][np.minimum(where, len(kept) - 1)]
    return samples


def _make_diagram(name: str, roots: Sequence[Call | Signal], sample_time: float | None) -> Diagram:
    table = Collector(roots).structure()
    if sample_time is not None:
        table.subsystems[""] = replace_fields(table.subsystems[""], sample_time=exact_time(sample_time))
    return Diagram._of(name, table)


@dataclass
class Bench:
    """A block's equations in a subsystem of one kind, with NumPy and traced."""

    exercise: Exercise
    sampled: bool
    traced: Traced
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        block, T = self.block, self.exercise.sample_time if self.sampled else np.nan
        self.rng = np.random.default_rng([self.exercise.seed, 2014])
        self.T = np.float64(T)
        self.p = self.traced.pack(block, float(T))
        self.numbers = numbers_of(block, float(T), self.traced.method)
        self.names = [*self.traced.outputs, NEXT, GUARDS]
        self.points = list(points(self.exercise, self.rng, 24))

    @property
    def block(self) -> Block:
        """The block."""
        return self.exercise.block

    @property
    def kind(self) -> str:
        """The kind of subsystem in words."""
        return kind_text(self.sampled)

    def evaluate_with_numpy(self, point: Point, names: list[str]) -> dict[str, np.ndarray]:
        """Return the results of equations with NumPy, or none where they can't be computed."""
        try:
            found = evaluate(self.block, point.arguments(), self.T, self.numbers, names)
        except (ArithmeticError, np.linalg.LinAlgError):
            return {}
        return {name: np.asarray(value, dtype=float) for name, value in found.items()}

    def evaluate_trace(self, columns: Columns) -> list[np.ndarray]:
        """Return the results of the traced function, one column for each column of its arguments."""
        return [np.array(v) for v in self.traced.function.call([*columns, self.p])]

    def evaluate(self, equation: str, columns: Columns, *more: np.ndarray) -> np.ndarray:
        """Return the results of the traced ``indicators`` or ``jump``."""
        return np.ravel(np.array(getattr(self.traced, equation).call([*columns, self.p, *more])[0]))


def numbers_of(block: Block, T: float, method: str) -> dict[str, Any]:
    """Return parameters and precomputed numbers by name, as equations see them."""
    entries = [*traced_parameters(block), *constants_of(block, T, method).items()]
    return {k: np.float64(v) if np.ndim(v) == 0 else v for k, v in entries}


def points(exercise: Exercise, rng: np.random.Generator, count: int) -> Iterator[Point]:
    """Yield points at which equations are evaluated: inputs in their ranges, states around their start values."""
    block = exercise.block
    starts = start_values(block, exercise.shapes)
    for number in range(count):
        i = int(rng.integers(_SAMPLES))
        u = exercise.inputs_at(i, rng)
        x = starts
        if block.starts_from_inputs:
            bundled = bundle("u", {n: np.asarray(v, dtype=float) for n, v in u.items()})
            flat = initial_state(block, {n: v.shape for n, v in starts.items()}, bundled)
            x = Layout.of({n: v.shape for n, v in starts.items()}).split(flat)
        if number and not block.memory:
            x = {n: v + _draw_offset(rng, block.states[n], v.shape) for n, v in x.items()}
        fired = {name: float(rng.integers(2)) for name in block.events}
        yield Point(float(exercise.times[i]), x, u, fired)


def _draw_offset(rng: np.random.Generator, port: State, shape: Shape) -> np.ndarray:
    """Draw the distance of a state from its start value; a discrete state moves by whole numbers."""
    scale = port.nominal or 1.0
    return np.asarray(rng.integers(-1, 2, shape) * 1.0 if port.discrete else scale * rng.standard_normal(shape))


def kind_text(sampled: bool) -> str:
    """Return a kind of subsystem in words."""
    return "sampled" if sampled else "continuous"
