"""Steps that a report tries in the running diagram: at which wires, how large, for how long, and what came of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ....blocks import Saturation
from ....blocks.core import LoopwrightError, NonFiniteError, PeriodicLoopError, Source
from ...flat import WiredDiagram
from ...frequency import Number, realize
from ...linearization import find_signal
from ...measure import (
    Converter,
    DivergenceError,
    Quantum,
    StepResponse,
    columns_of,
    find_converters,
    find_least_step,
    find_rest,
    remaining_oscillation,
    step_response,
)
from ...requirements import Requirements, StepLimits, StepSize
from ...results import OperatingPoint
from ..case import Case
from ..variant import Variant, in_s
from ..wires_on_loops import blocks_on_loops

TIME_CONSTANTS = 10.0
"""Length of a run, in time constants of the loop's slowest pole."""
BEYOND = 3.0
"""Length of a run at least, in times of the limits of its settling and its rise."""
SAMPLES = (100, 20000)
"""Fewest and most samples of a run."""
ROUNDING = 1e-12
"""Size of rounding errors, relative to the largest signal."""
TICK_ERROR = 1e-9
"""Error of a response that was computed at ticks alone, relative to its largest change."""
AGREEMENT = 0.01
"""Difference of co-simulation and linear model, relative to the largest change, up to which they agree."""
APART = 0.05
"""Difference of them, relative to the largest change, from which on a response depends on the size of its step."""
SIZE = 100.0
"""Size of a step, in amplitudes of the injection check, where none is given."""
SMALLER = 0.1
"""Factor by which a step of no given size is made smaller while its response is not that of the linear model."""
TIMES_SMALLER = 4
"""Most times that a step is made smaller."""
OUTSIDE = 2.0
"""Size of an answer in parts of the linear model's, or of the step, above which it is outside."""
BEYOND_ALL = 1e3
"""Size of an answer, in parts of the linear model's, that is called growth without end."""
RISES = 3.0
"""Least growth of such an answer in four times the time: a ramp's is 4."""
FURTHER = (4.0, 16.0)
"""Lengths, in those of the record, for which such an answer is followed to see whether it grows without end."""
TIMES_SHORTER = 20
"""Most times that a record is halved so that it ends before a response has grown without end."""
ROOM = 1.5
"""Length of the record of a response that diverges, in times at which it leaves the linear model's."""
SLOWEST = 1e-6
"""Poles slower than that, relative to the fastest, are taken as integrators that nothing feeds back."""


@dataclass(frozen=True)
class StepTest:
    """A step that is tried: its key in the report, the wires, and its limits where there are some."""

    key: str
    wire: str
    output: str = ""
    limits: StepLimits | None = None

    def __str__(self) -> str:
        return f"{self.wire} → {self.output}" if self.output else self.wire


def step_tests(case: Case, v: Variant) -> Iterator[StepTest]:
    """Yield the steps that are tried in a variant: at the wire of each loop, and those that are required besides."""
    asked = case.requirements
    names = case.names_of_loops()
    for key, wire in case.loop_wires().items():
        yield StepTest(key, wire, "", None if asked is None else asked.step_of(names[key], v.key))
    for key, limits in required_steps(case, asked, v).items():
        yield StepTest(key, limits.input, limits.output, limits)


def required_steps(case: Case, asked: Requirements | None, v: Variant) -> dict[str, StepLimits]:
    """Return the steps between wires that are required, by their keys, which name the wires.

    Further ones at the same wires are numbered, as one at a loop's own wire that has limits of its own: each is a run.
    """
    if asked is None:
        return {}
    of_loops = {key for key, names in case.names_of_loops().items() if asked.step_of(names, v.key) is not None}
    found: dict[str, StepLimits] = {}
    for limits in asked.steps:
        ends = [limits.input, limits.output] if limits.output else [limits.input]
        first = "_to_".join(end.replace(".", "_") for end in ends)
        key, number = first, 1
        while key in found or key in of_loops:
            number += 1
            key = f"{first}_{number}"
        found[key] = limits
    return found


@dataclass(frozen=True)
class StepRun:
    """A step that was tried in a variant, with its response.

    ``slowest``: rate of the slowest mode in 1/s; None without one.
    ``diverges``: time in s since the step from which on the response leaves the linear model's; None of one that ends.
    ``least``: height of the step that moves the answer by some quanta of ``quantum``; 0 without converters.
    ``usual``: height that the step would have without converters; None where its height was given.
    ``oscillations``: by converter, what is left of its input's motion at the end of the record, in quanta.
    ``origin``: why the step has its height.
    """

    test: StepTest
    variant: Variant
    got: StepResponse
    slowest: float | None
    diverges: float | None
    least: float
    quantum: Quantum | None
    usual: float | None
    oscillations: Mapping[str, Number]
    origin: StepSize

    @property
    def key(self) -> str:
        """Its part of dotted paths."""
        return f"{self.test.key}.{self.variant.key}"


def run_step(case: Case, v: Variant, test: StepTest) -> StepRun | None:
    """Return the response of the running diagram to a step; None at a wire with several entries, which has no step."""
    try:
        plan = case.excitation(v, test.wire)
        poles = _poles(v, test)
        if poles is None:
            return None
    except LoopwrightError:
        if test.limits is None:
            return None
        raise
    limits = test.limits
    dt = v.model.dt or 0.0
    s = poles[np.abs(poles.real) > SLOWEST * np.max(np.abs(poles), initial=0.0)]
    slowest = float(np.min(np.abs(s.real))) if s.size else None
    length = TIME_CONSTANTS / slowest if slowest else 1.0
    if limits is not None:
        ends = [limits.limits[name].high for name in ("settling", "rise") if name in limits.limits]
        length = max([length, *(BEYOND * end for end in ends if math.isfinite(end))])
    if dt:
        length = float(np.clip(length, SAMPLES[0] * dt, SAMPLES[1] * dt))
    if limits is not None and limits.length is not None:
        length = limits.length
    diagram, point, usual = plan.variant.diagram, plan.variant.point, SIZE * plan.amplitude
    given, origin = _find_size(v, test)
    height, quantum = _least_step(diagram, point, test, length)
    size = max(usual, height) if given is None else given
    if limits is None or limits.length is None:
        length = max(length, _rest(diagram, point, test, size, slowest, length))
        length = min(length, SAMPLES[1] * dt) if dt else length
    outputs = [*([test.output] if test.output else []), *_commands(v.diagram, test.wire), *excesses_of(v.diagram)]
    converters = find_converters(v.diagram.flatten_like(v.point))
    fed = list(dict.fromkeys(converter.signal for converter in converters))

    def respond(size: float, length: float = length) -> StepResponse:
        return step_response(
            diagram, test.wire, size=size, length=length, at=point, outputs=[*outputs, *fed], stairs=v.stairs
        )

    diverges: float | None = None
    try:
        got = respond(size)
    except (DivergenceError, NonFiniteError):
        if given is None and size > usual:
            got = respond(usual)
        else:
            got, diverges = _follow_diverging(lambda length: respond(size, length), test, length)
    except LoopwrightError:
        if given is not None or size <= usual:
            raise
        got = respond(usual)  # the diagram's range is smaller than the quanta ask for
    if diverges is None and given is not None:
        what_is_done = f"step at {test!s}, {v.title}, for longer: it has left the linear model's"
        if _grows_on(got, test, lambda length: respond(size, length), length, lambda: case.notify(what_is_done)):
            got, diverges = _follow_diverging(lambda length: respond(size, length), test, length)
    if given is None and diverges is None:
        got = _small_response(got, respond, height)
    kept = sum(len(find_signal(diagram.flatten_like(point), name).labels) for name in outputs)
    got, left = _without_converters(got, converters, plan.variant, kept)
    return StepRun(test, v, got, slowest, diverges, height, quantum, usual if given is None else None, left, origin)


def _find_size(v: Variant, test: StepTest) -> tuple[float | None, StepSize]:
    """Return the height of a required step with its origin; None where it is to be chosen."""
    if test.limits is None:
        return None, StepSize.CHOSEN
    if test.limits.size is not None:
        return test.limits.size, StepSize.GIVEN
    signal = find_signal(v.diagram.flatten_like(v.point), test.wire)
    source = v.diagram.blocks.get(signal.port[0])  # None at the output of a delay that a variant adds
    own = source.own_step(v.point.t) if isinstance(source, Source) and signal.entries == (0,) else 0.0
    return (own, StepSize.SOURCE) if own else (None, StepSize.CHOSEN)


def _least_step(
    diagram: WiredDiagram, point: OperatingPoint, test: StepTest, length: float
) -> tuple[float, Quantum | None]:
    """Return the height of a step that is large compared with quanta, with the quantum; 0 where none is known."""
    try:
        found = find_least_step(diagram, point, test.wire, test.output or test.wire, length)
    except LoopwrightError:  # no linear model: the run may be had all the same
        found = None
    return (0.0, None) if found is None else found


def _rest(
    diagram: WiredDiagram, point: OperatingPoint, test: StepTest, size: float, slowest: float | None, length: float
) -> float:
    """Return the time after a step from which the linear model rests within a quantum; 0 where it is not known."""
    try:
        return find_rest(diagram, point, test.wire, size, slowest, length) if slowest else 0.0
    except LoopwrightError:  # no linear model
        return 0.0


def _grows_on(
    got: StepResponse,
    test: StepTest,
    respond: Callable[[float], StepResponse],
    length: float,
    notify: Callable[[], None],
) -> bool:
    """Return whether an answer that ends away from the linear model's grows without end."""
    # it is followed for longer then; it does if it gets `BEYOND_ALL` times as large as the linear model's, or grows as
    # a ramp does at least
    if got.prediction is None:
        return False
    linear = float(np.max(np.abs(got.answer(bool(test.output), linear=True))))
    off = got.answer(bool(test.output)) - got.answer(bool(test.output), linear=True)
    if not linear or not np.max(np.abs(off[-max(1, len(off) // 20) :])) > AGREEMENT * linear:
        return False
    size = _size_at_end(got, test)
    for times in FURTHER:
        if size > BEYOND_ALL * linear:
            return True
        notify()
        try:
            further = _size_at_end(respond(times * length), test)
        except (DivergenceError, NonFiniteError):
            return True
        if further < RISES * size:
            return False
        size = further
    return size > OUTSIDE * linear


def _size_at_end(got: StepResponse, test: StepTest) -> float:
    answer = got.answer(bool(test.output))
    return float(np.max(np.abs(answer[-max(1, len(answer) // 20) :])))


def _follow_diverging(
    respond: Callable[[float], StepResponse], test: StepTest, length: float
) -> tuple[StepResponse, float]:
    """Return the beginning of a response that grows without end, and the time in s since the step at which it leaves.

    It is the time from which on the answer is not the linear model's any more, by `APART` of that; without a linear
    model that from which on it is more than `OUTSIDE` times the step.
    """
    for _ in range(TIMES_SHORTER):
        try:
            got = respond(length)
        except (DivergenceError, NonFiniteError):
            length *= 0.5
            continue
        since = _find_departure(got, test)
        if ROOM * since < 0.9 * length:
            got = respond(max(ROOM * since, 1e-3 * length))
        return got, since
    got = respond(length)
    return got, _find_departure(got, test)


def _find_departure(got: StepResponse, test: StepTest) -> float:
    answer = got.answer(bool(test.output))
    if got.prediction is None:
        off, room = np.abs(answer), OUTSIDE
    else:
        linear = got.answer(bool(test.output), linear=True)
        off, room = np.abs(answer - linear), APART * float(np.max(np.abs(linear)))
    near = np.flatnonzero(off <= room)
    last = min(int(near[-1]) + 1 if near.size else 0, len(off) - 1)
    return float(got.t[last] - got.t[int(np.argmax(got.d != 0.0))])


def _small_response(got: StepResponse, respond: Callable[[float], StepResponse], least: float) -> StepResponse:
    """Return a response to a smaller step, of at least a height, if it is nearer to the linear model; else the same."""
    # a step that reaches limits of the diagram says little about the loop: 1 % of 1 + the signal's size is much where
    # signals are small in SI units
    for _ in range(TIMES_SMALLER):
        if got.prediction is None or deviation(got) <= APART or SMALLER * abs(got.size) < least:
            break
        smaller = respond(SMALLER * got.size)
        if smaller.prediction is None or not deviation(smaller) < deviation(got):
            break
        got = smaller
    return got


def _without_converters(
    got: StepResponse, converters: list[Converter], v: Variant, kept: int
) -> tuple[StepResponse, dict[str, Number]]:
    """Return a response without the last signals, which feed converters, and what is left of these at its end."""
    flat = v.diagram.flatten_like(v.point)
    names, found = got.outputs[kept:], dict[str, Number]()
    for converter in converters if got.prediction is not None else ():
        columns = [kept + i for i in columns_of(names, converter, flat)]
        assert got.prediction is not None
        amplitude = remaining_oscillation(
            got.y[:, columns], got.prediction[:, [1 + i for i in columns]], converter.size
        )
        how = "the nonlinear co-simulation at the end of the step's record"
        found[converter.name] = Number(amplitude, "quanta", TICK_ERROR * (1.0 + amplitude), how)

    def first(values: Any) -> Any:
        return None if values is None else values[..., : 1 + kept]

    ends = {name: first(getattr(got, name)) for name in ("prediction", "final", "later", "between", "steady")}
    return replace(got, outputs=got.outputs[:kept], y=got.y[:, :kept], before=got.before[:kept], **ends), found


def _poles(v: Variant, test: StepTest) -> np.ndarray | None:
    """Return the poles that decide how long a response lasts, in 1/s; None at a wire with several entries."""
    if test.output:
        return in_s(v.poles, v.model.dt)
    if len(find_signal(v.diagram.flatten_like(v.point), test.wire).entries) > 1:
        return None
    try:
        L = v.loop(test.wire)
    except PeriodicLoopError:
        return in_s(v.poles, v.model.dt)
    r = realize(L)
    poles = r.eigenvalues()
    return in_s(1 + poles if r.dt else poles, r.dt)


def _commands(diagram: WiredDiagram, wire: str) -> list[str]:
    """Return the signals that drive FMUs, or go from sampled subsystems to continuous blocks."""
    table = diagram.structure
    names = {(w.block, w.port): name for name, w in diagram.names.items() if w.index is None}
    found: dict[str, None] = {}
    inside = blocks_on_loops(diagram)
    for (block, _), w in table.wires.items():
        if w.block not in inside:
            continue
        source = table.clock(table.subsystem_of[w.block])
        sampled = source is not None and table.clock(table.subsystem_of[block]) is None
        if table.blocks[block].stepped or (sampled and not table.blocks[w.block].stepped):
            found[names.get((w.block, w.port), f"{w.block}.{w.port}")] = None
    return [name for name in found if name != wire]


def excesses_of(diagram: WiredDiagram) -> list[str]:
    """Return the outputs of saturations that are not 0 where these cut something off."""
    return [f"{path}.excess" for path, block in sorted(diagram.blocks.items()) if isinstance(block, Saturation)]


def deviation(got: StepResponse) -> float:
    """Return the largest difference of co-simulation and linear model, relative to the largest change of its signal.

    Entries of one signal share their largest change: one that hardly moves next to the others has no scale.
    A signal that moves by rounding only does not count.
    """
    assert got.prediction is not None  # callers look
    both = np.column_stack([got.v, got.y])
    signals = ["", *(name.partition("[")[0] for name in got.outputs)]
    sizes, off = np.max(np.abs(both), axis=0), np.max(np.abs(both - got.prediction), axis=0)
    before = np.abs([got.wire_before, *got.before])
    least = ROUNDING * max(np.max(before, initial=0.0), np.max(sizes, initial=0.0))
    found = 0.0
    for signal in set(signals):
        own = [i for i, name in enumerate(signals) if name == signal]
        size = float(np.max(sizes[own]))
        found = max(found, float(np.max(off[own])) / size) if size > least else found
    return found
