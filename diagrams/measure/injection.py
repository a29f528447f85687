"""A test signal in a running diagram: the consumers of a port get its signal plus the test signal.

First the run with the signal, then its parts with their lines, windows and phasors, then the samples at its wire.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, cast

import numpy as np

from ...blocks.core import Array, Block, Output, Sum, WiringError, parameter
from ..flat import FlatDiagram, WiredDiagram
from ..linearization import Tap, ticks_between_renewals, ticks_to_renewal, with_passed_values
from ..results import OperatingPoint
from ..simulation import RunOptions, Simulation, copy_states
from ..wiring import SubsystemSettings, Wire
from .beginning import can_start_at, check_reached

NEVER = 1e12
"""Time in s that no run reaches."""
KINDS = ("sine", "multisine", "chirp")
SAMPLES = 256
"""Smallest number of samples in a window of a test signal."""


class Excitation(Block):
    """Test signal: d = e g Σ aₖ sin(ωₖ τ + ½ cₖ τ² + φₖ), τ = t − t₀ modulo the period.

    The ramp g rises from 0 to 1 within ``ramp`` seconds from t₀ on, with two continuous derivatives.
    """

    direction: Array = parameter(description="e, the share of each entry in the signal")
    amplitude: Array = parameter(description="aₖ of each line")
    frequency: Array = parameter(unit="rad/s", description="ωₖ of each line")
    sweep: Array = parameter(description="cₖ of each line in rad/s²")
    phase: Array = parameter(unit="rad", description="φₖ of each line")
    start_time: float = parameter(unit="s", description="t₀")
    ramp: float = parameter(unit="s", description="length of the ramp")
    period: float = parameter(unit="s", description="period of the signal")
    y = Output(shape=None, description="the test signal d")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the test signal."""
        since = t - self.start_time
        z = since / self.ramp
        z = np.where(z < 0.0, 0.0, np.where(z > 1.0, 1.0, z))
        rise = z**3 * (10.0 - z * (15.0 - 6.0 * z))
        tau = since - self.period * np.floor(since / self.period)
        lines = self.amplitude * np.sin((self.frequency + 0.5 * self.sweep * tau) * tau + self.phase)
        return self.direction * (rise * np.sum(lines))


@dataclass(frozen=True, eq=False)
class Waveform:
    """A periodic test signal: its lines, in the units of `Excitation`, and its period in s."""

    amplitude: np.ndarray
    frequency: np.ndarray
    sweep: np.ndarray
    phase: np.ndarray
    period: float


@dataclass(frozen=True, eq=False)
class InjectedDiagram:
    """A diagram with a test signal added at one of its ports; all other blocks keep their paths."""

    diagram: WiredDiagram
    source: str  # path of the test signal's block
    sum: str  # path of the sum
    lines: int  # number of lines of the test signal


def inject_signal(
    diagram: WiredDiagram, signal: Tap, lines: int, held: tuple[Fraction, Fraction] | None
) -> InjectedDiagram:
    """Return a diagram in which every consumer of a port gets the port's signal plus a test signal.

    ``held`` are the seconds between two samples of the test signal, and the time of the first one; without it the
    signal is continuous.
    """
    lowered = diagram.scheduled
    table = lowered.copy()
    for path, subsystem in table.subsystems.items():
        table.subsystems[path] = replace(subsystem, delay=0)  # the delays have become blocks
    block, port = signal.port
    consumers = [
        (group, key)
        for group in (table.wires, table.controls)
        for key, w in group.items()
        if (w.block, w.port) == (block, port)
    ]
    if not consumers:
        raise WiringError(
            f"found nothing wired to it; expected a consumer for the test signal at {signal.name!r}. Name a wire of a "
            "loop.",
            block=block,
            port=port,
        )
    taken = {*table.blocks, *table.subsystems}
    frame_path, total = _find_free_name("injection", taken), _find_free_name("injection_sum", taken)
    source = f"{frame_path}.signal"
    shape = diagram.checked.shapes[signal.port]
    ones = np.ones(lines)
    table.blocks[source] = Excitation(
        direction=np.ones(shape) if shape else 1.0,
        amplitude=ones,
        frequency=ones,
        sweep=ones,
        phase=ones,
        start_time=NEVER,
        ramp=1.0,
        period=1.0,
        name="signal",
    )
    table.subsystems[frame_path] = SubsystemSettings(frame_path, None, "exact", outputs=("y",))
    if held is not None:
        table.subsystems[frame_path] = replace(table.subsystems[frame_path], sample_time=held[0], offset=held[1])
    table.subsystem_of[source] = frame_path
    table.blocks[total], table.subsystem_of[total] = Sum(name=total), ""
    for group, key in consumers:
        wire: Wire = group[key]  # type: ignore[index]
        group[key] = Wire(total, "y", wire.index)  # type: ignore[index]
    table.wires[total, "u1"], table.wires[total, "u2"] = Wire(block, port), Wire(source, "y")
    return InjectedDiagram(diagram.with_structure(table), source, total, lines)


def _find_free_name(name: str, taken: set[str]) -> str:
    path, count = name, 2
    while path in taken:
        path, count = f"{name}_{count}", count + 1
    return path


class InjectionRun:
    """A running simulation with a test signal that can be changed between samples; use it in a ``with`` statement.

    It ``begins`` at an operating point, or at a time in s to which the diagram is run. To a point that a run has
    reached it is run as well where its states are not all that has to be known, or an FMU does not let them be set.
    """

    def __init__(
        self,
        diagram: WiredDiagram,
        made: InjectedDiagram,
        signal: Tap,
        outputs: Iterable[Tap],
        begins: OperatingPoint | float,
        options: Mapping[str, Any],
    ):
        self.made, self.signal, self.outputs = made, signal, list(outputs)
        ports = [signal.port, *(o.port for o in self.outputs)]
        record = sorted({f"{b}.{p}" for b, p in ports} | {f"{made.sum}.y", f"{made.source}.y"})
        start: dict[str, Any] = {}
        self.runs_to: Any = begins
        self.point: OperatingPoint | None = None
        if isinstance(begins, OperatingPoint):
            before = diagram.replace(begins.parameters) if begins.parameters else diagram
            begins = with_passed_values(before, begins)
            self.point = _translate_point(begins, before.flatten_like(begins), made, signal)
            self.runs_to = begins.tick * begins.base
            if can_start_at(made.diagram, begins):
                self.runs_to, start["start"] = 0, self.point
        self.simulation = Simulation(
            made.diagram,
            RunOptions.of({**options, **start, "record": record, "states": False}, block=made.diagram.name),
        )
        self.flat: FlatDiagram = self.simulation.flat
        self.held = True
        """Whether the signal has not changed at any tick between two recorded samples."""

    def __enter__(self) -> InjectionRun:
        simulation = self.simulation
        simulation.__enter__()
        try:
            if self.runs_to:
                simulation.advance(self.runs_to)
                if self.point is not None:
                    check_reached(simulation, self.point)
        except BaseException as error:
            simulation.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.simulation.__exit__(*exc)

    @property
    def t(self) -> float:
        """Time that the run has reached in s."""
        return self.simulation.t

    def play(self, waveform: Waveform, entry: int, ramp: float, ahead: float = 0.0) -> None:
        """Begin a test signal at one entry of the wire, with a ramp in s, now, or some seconds ahead of now."""
        path = self.made.source
        block = cast(Excitation, self.flat.table.blocks[path])
        direction = np.zeros(np.size(block.direction))
        direction[entry] = 1.0
        shape = np.shape(block.direction)
        changed = block.replace(
            direction=direction.reshape(shape) if shape else float(direction[0]),
            amplitude=waveform.amplitude,
            frequency=waveform.frequency,
            sweep=waveform.sweep,
            phase=waveform.phase,
            start_time=self.t - ahead,
            ramp=ramp,
            period=waveform.period,
        )
        self.simulation.set_parameters(path, changed)

    def step(self, size: float, entry: int) -> None:
        """Add a step of a size at one entry of the wire, from now on: a line of frequency 0 whose ramp is over."""
        one, zero = np.ones(1), np.zeros(1)
        self.play(Waveform(size * one, zero, zero, 0.5 * np.pi * one, 1.0), entry, ramp=1.0, ahead=2.0)

    def go(self, count: int, every: int) -> None:
        """Advance the run by ``count`` samples of ``every`` ticks."""
        self.simulation.advance(count * every * self.flat.base)  # type: ignore[arg-type]

    def read_states(self) -> np.ndarray:
        """Return the states of all blocks and the outputs of all FMUs at the last tick."""
        view = self.simulation.view
        return np.concatenate([view.x_next[: self.flat.states.total], view.w])

    def record(self, count: int, every: int, parts: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance the run by ``count`` samples of ``every`` ticks, and return v, u and the outputs.

        v is the port's signal, u that of its consumers: v plus the test signal. Each has a row for each sample, both
        ends included, and a column for each entry. With several ``parts``, which divide ``every``, there is a row for
        each part of a sample.
        """
        simulation = self.simulation
        simulation.run(final=False)  # discards earlier records
        first = simulation.view.tick
        simulation.record_instant()
        self.go(count, every)
        run = simulation.run(final=False)
        times = times_of(range(first, first + count * every + 1, every // parts), self.flat.base)
        rows = np.searchsorted(run.t, times * (1.0 + 1e-15), side="right") - 1

        if every > 1:
            v = np.asarray(run[".".join(self.signal.port)])
            all_times = times_of(range(first, first + count * every), self.flat.base)
            between = np.searchsorted(run.t, all_times, side="right") - 1
            all_ticks = v[between].reshape(count, every, -1)
            self.held &= bool(np.all(all_ticks == all_ticks[:, :1]))

        def read(port: tuple[str, str], entries: tuple[int, ...]) -> np.ndarray:
            data = np.asarray(run[".".join(port)])[rows].reshape(len(rows), -1)
            return np.array(data[:, list(entries)])

        v, u = (read(port, self.signal.entries) for port in (self.signal.port, (self.made.sum, "y")))
        y = [read(o.port, o.entries) for o in self.outputs]
        return v, u, np.hstack([np.zeros((len(rows), 0)), *y])


def times_of(ticks: range, base: Fraction) -> np.ndarray:
    """Return the times of ticks in s, each of them rounded once, as those of a run are."""
    times, whole = base.numerator, base.denominator
    if max(ticks[-1] * times, whole) < 2**53:  # whole numbers that floats hold: their quotient is rounded once
        return np.asarray(np.arange(ticks.start, ticks.stop, ticks.step) * times / whole)
    return np.array([k * times / whole for k in ticks])


def _translate_point(point: OperatingPoint, old: FlatDiagram, made: InjectedDiagram, signal: Tap) -> OperatingPoint:
    """Return an operating point of the diagram as one of the diagram with the test signal."""
    new = made.diagram.flatten_like(point)
    x = new.x0.copy()
    copy_states(point.x, old, new, x)
    known = {**point.values, f"{made.sum}.y": point.values[".".join(signal.port)]}
    for layout in (new.held, new.loops):
        for name, where in layout.slices.items():
            if name in known:
                x[where] = np.ravel(known[name])
    return replace(point, x=x)


def choose_step(omega: np.ndarray) -> Fraction:
    """Return the seconds between samples of a continuous diagram: 16 to a period of the highest frequency, whole ns."""
    return Fraction(max(1, round(2.0 * np.pi / (16.0 * omega[-1]) * 1e9)), 10**9)


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the test signal and its window."""

    waveform: Waveform
    samples: int  # samples of the window
    lines: np.ndarray  # lines to read: whole periods in the window
    omega: np.ndarray  # their frequencies in rad/s
    every_line: bool  # whether the signal has all lines, as a chirp has

    @property
    def silence(self) -> Waveform:
        """Waveform of this part with amplitude zero."""
        return replace(self.waveform, amplitude=0.0 * self.waveform.amplitude)


def plan_signal(kind: str, omega: np.ndarray, dt: float, amplitude: float) -> Iterator[Part]:
    """Yield the parts of a test signal, to be played one after the other."""
    zero = np.zeros(1)
    if kind == "sine":
        for w in omega:
            periods = max(1, math.ceil(SAMPLES * dt * w / (2.0 * np.pi)))
            n = round(2.0 * np.pi * periods / (w * dt))
            fits = np.array([2.0 * np.pi * periods / (n * dt)])
            yield Part(Waveform(zero + amplitude, fits, zero, zero, n * dt), n, np.array([periods]), fits, False)
        return
    gap = float(np.min(np.diff(omega), initial=omega[0]))
    parts = min(64, math.ceil(2.0 * omega[0] / gap))
    n = max(SAMPLES, round(2.0 * np.pi * parts / (omega[0] * dt)))
    unit = 2.0 * np.pi / (n * dt)
    lines = np.unique(np.clip(np.round(omega / unit).astype(int), 1, (n - 1) // 2))
    if kind == "multisine":
        phase = -np.pi * np.arange(len(lines)) * (np.arange(len(lines)) + 1.0) / len(lines)  # Schroeder's
        tau = np.arange(n) * dt
        peak = float(np.max(np.abs(np.sum(np.sin(np.outer(lines * unit, tau) + phase[:, None]), axis=0))))
        each = np.full(len(lines), amplitude / peak)
        waveform = Waveform(each, lines * unit, np.zeros(len(lines)), phase, n * dt)
    else:
        first, last = max(1, int(0.8 * lines[0])), min((n - 1) // 2, math.ceil(1.2 * lines[-1]))
        last -= (last - first) % 2  # whole turns in a period, so that it repeats without a jump
        waveform = Waveform(
            zero + amplitude, zero + first * unit, zero + (last - first) * unit / (n * dt), zero, n * dt
        )
    yield Part(waveform, n, lines, lines * unit, kind == "chirp")


def compute_phasors(part: Part, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the phasors, by line and signal, and the distortion of the first signal.

    The distortion is the rms of the rest next to the lines, relative to that of each line; NaN for a part with every
    line. Over a window of whole periods the lines are orthogonal to all others. The difference of the window's end from
    its beginning is a drift, and is subtracted.
    """
    n = part.samples
    k = np.arange(n)
    data = data[:n] - np.outer(k / n, data[n] - data[0])
    data = data - np.mean(data, axis=0)
    turns = np.exp(-2j * np.pi / n * (np.outer(part.lines, k) % n))
    phasors = 2.0 / n * turns @ data
    lines = len(part.lines)
    if part.every_line:
        return phasors, np.full(lines, np.nan)
    rest = np.sqrt(np.mean((data[:, 0] - np.real(phasors[:, 0] @ turns.conj())) ** 2))
    size = np.abs(phasors[:, 0]) / np.sqrt(2.0)
    return phasors, rest / np.where(size > 0.0, size, np.inf)


@dataclass(frozen=True)
class SamplesAtWire:
    """Samples, from one to the next of which a test signal is held where anything is sampled."""

    every: int  # ticks in a sample
    period: Fraction  # s
    wait: int = 0  # ticks until the wire is renewed
    renewals: int = 1  # samples in the period of all clocks
    held: tuple[Fraction, Fraction] | None = None  # period of the test signal and its first time, where it is held

    @classmethod
    def of(cls, flat: FlatDiagram, signal: Tap, tick: int, *, each_renewal: bool = False) -> SamplesAtWire:
        """Return the samples at a wire of a sampled diagram from a tick on: one in the period of all clocks.

        They begin where the wire is renewed, as for its loop's linear model. With ``each_renewal`` they are from one
        renewal to the next, where these are even.
        """
        every = math.lcm(*(clock.every for clock in flat.distinct)) if flat.distinct else 1
        own = ticks_between_renewals(flat, [signal.port]) if each_renewal and every > 1 else None
        renewals = every // own if own and every % own == 0 else 1
        every //= renewals
        wait = ticks_to_renewal(flat, [signal.port], tick) if every > 1 else 0
        period = flat.base * every
        return cls(every, period, wait, renewals, (period, ((tick + wait) % every) * flat.base))

    @property
    def is_renewed_once(self) -> bool:
        """Whether the wire is renewed at the beginning of the period of all clocks, and then alone."""
        return not self.wait and self.renewals == 1
