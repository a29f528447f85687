"""Responses of the running diagram to steps, next to those of its linear model, and the effort that they take."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ....blocks import Saturation
from ....blocks.core import LoopwrightError, NonFiniteError, PeriodicLoopError, Source
from ...flat import WiredDiagram
from ...frequency import Confirmation, Number, realize
from ...linearization import find_signal
from ...measure import (
    LEAST,
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
from ...requirements import STEP_UNITS, StepLimits, StepSize
from ...results import OperatingPoint, is_at_rest, measure_step
from .. import figures
from ..case import Case
from ..error_sentences import say
from ..pages import Plot, Section, Table, Texts
from ..stability import Stability
from ..variant import Variant, in_s
from ..wires_on_loops import blocks_on_loops

TEXTS = Texts(__package__, "steps")
TITLE = "Step and disturbance responses"
TIME_CONSTANTS = 10.0
"""Length of a run, in time constants of the loop's slowest pole."""
BEYOND = 3.0
"""Length of a run at least, in times of the limits of its settling and its rise."""
SAMPLES = (100, 20000)
"""Fewest and most samples of a run."""
ROUNDING = 1e-12
"""Size of rounding errors, relative to the largest signal."""
SOLVER_ERROR = 1e-7
"""Error of a response that a solver had a part in, relative to its largest change; 100 times its relative tolerance."""
TICK_ERROR = 1e-9
"""That of one that was computed at ticks alone."""
AGREEMENT = 0.01
"""Difference of co-simulation and linear model, relative to the largest change, up to which they agree."""
APART = 0.05
"""Difference of them, relative to the largest change, from which on a response depends on the size of its step."""
SIZE = 100.0
"""Size of a step, in amplitudes of the injection check, where none is given."""
SMALLER = 0.1
"""Factor by which a step of no given size is made smaller while its response is not that of the linear model."""
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
TAIL = 0.4
"""Part of a record at its end in which an oscillation is looked for."""
LEAST_CROSSINGS = 6
"""Crossings of its mean that an oscillation has there at least."""
SUSTAINED = 0.2
"""Difference of its amplitudes in the halves of that part, relative to the larger one, up to which it is kept."""
TIMES_SMALLER = 4
"""Most times that it is."""
ALIKE = 1e-4
"""Difference of two responses, relative to their size, that no figure shows."""
SLOWEST = 1e-6
"""Poles slower than that, relative to the fastest, are taken as integrators that nothing feeds back."""
NAMES: Mapping[str, str] = {
    "overshoot": "overshoot",
    "settling": "settling time, 2 %",
    "rise": "rise time, 10 to 90 %",
    "peak": "largest change",
}


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
    for limits in () if asked is None else asked.steps:
        yield StepTest(key_of_step(limits), limits.input, limits.output, limits)


def key_of_step(limits: StepLimits) -> str:
    """Return the key of a required step that names its wires."""
    ends = [limits.input, limits.output] if limits.output else [limits.input]
    return "_to_".join(end.replace(".", "_") for end in ends)


def steps(case: Case) -> Section | None:
    """Return the section with the responses to steps of the diagram as it is, and of the variants that are judged."""
    numbers: dict[str, Number] = {}
    rows: list[tuple[Any, ...]] = []
    effort: list[tuple[Any, ...]] = []
    resting: list[tuple[Any, ...]] = []
    text: list[str] = []
    found: dict[StepTest, dict[str, StepResponse]] = {}
    absent: dict[str, str] = {}
    for v in case.judged():
        if v.problem:
            continue
        # a step of an unstable diagram grows, whatever its size: there is nothing to measure
        if Stability.of(v) is Stability.UNSTABLE:
            text.append(TEXTS.line("unstable", variant=v.title))
            continue
        for test in step_tests(case, v):
            case.notify(f"step at {test!s}, {v.title}")
            try:
                ran = _run(case, v, test)
            except LoopwrightError as error:
                text.append(TEXTS.line("failed", variant=v.title, wire=test.wire, message=say(error)))
                absent[f"{test.key}.{v.key}"] = say(error)
                continue
            if ran is None:
                absent[f"{test.key}.{v.key}"] = TEXTS.line("no_single", wire=test.wire)
                continue
            got, slowest, quantized, diverges = ran
            where = f"{test.key}.{v.key}"
            own = _numbers(got, test, v, slowest) | _diverging(got, test, v, diverges)
            if test.limits is not None:
                port = ".".join(find_signal(v.diagram.flatten_like(v.point), test.wire).port)
                own["size"] = Number(got.size, unit_at(v.diagram, port), 0.0, quantized.size.value, given=True)
            if not own["settled"].value and diverges is None:
                own |= _oscillation(got, test, v)
            numbers |= {f"{where}.{name}": number for name, number in own.items()}
            for name, said in NAMES.items():
                linear = own.get(f"linear.{name}")
                if name != "peak":
                    rows.append((str(test), v.title, said, own[name], linear))
            saturated = _limits_reached(v.diagram, got)
            for name, before, change, off in _effort(got, test, slowest):
                key = f"effort.{name.replace('.', '_')}"
                unit = unit_at(v.diagram, name)
                numbers[f"{where}.{key}"] = Number(change, unit, off, _how(got))
                at_first = Number(before, unit, 1e-9 * abs(before), "the run before the step", given=True)
                effort.append((str(test), v.title, name, at_first, numbers[f"{where}.{key}"]))
            if diverges is not None:
                text.append(TEXTS.line("diverges", variant=v.title, wire=str(test), since=diverges))
            text += [TEXTS.line("saturated", variant=v.title, wire=test.wire, blocks=saturated)] if saturated else []
            text += _said_of_quanta(v, test, got, quantized, saturated)
            for name, number in quantized.oscillations.items():
                numbers[f"{where}.{name.replace('.', '_')}.oscillation"] = number
                resting.append((str(test), v.title, name, number))
            if got.unread and _keeps_steps(got):
                text.append(TEXTS.line("unread", variant=v.title, wire=test.wire, plants=got.unread))
            if got.prediction is None:
                text.append(TEXTS.line("unpredicted", variant=v.title, wire=test.wire))
            if not own["settled"].value and diverges is None:
                text.append(TEXTS.line("unsettled", variant=v.title, wire=test.wire, length=own["length"].value))
            if got.moved > 1e-6:
                text.append(TEXTS.line("moved", variant=v.title, wire=test.wire, moved=got.moved))
            # tests that differ in their limits alone are one figure
            found.setdefault(replace(test, limits=None), {})[v.key] = got
    if not found:
        return Section("steps", TITLE, tuple(dict.fromkeys(text)), absent=absent) if text else None
    tables = [Table("Step responses", ("step", "variant", "number", "co-simulation", "linear"), tuple(rows))]
    if effort:
        tables.append(
            Table(
                "Effort",
                ("step", "variant", "signal", "before", "largest change"),
                tuple(effort),
                terms={"before": "before_step"},
            )
        )
    if resting:
        tables.append(
            Table(
                "Oscillation at rest",
                ("after a step at", "variant", "converter", "amplitude"),
                tuple(resting),
                terms={"amplitude": "oscillation"},
            )
        )
        text.insert(0, TEXTS.line("resting"))
    same = _find_same_curves(found)
    plots = [
        _plot(case, test, curves, [str(other) for other in same if same[other] == test])
        for test, curves in found.items()
        if test not in same
    ]
    overview = tuple(plot for test, curves in found.items() for plot in _overview(case, test, curves))
    whole = (*TEXTS.paragraphs("responses"), *dict.fromkeys(text))
    return Section("steps", TITLE, whole, tuple(tables), tuple(plots), numbers, overview=overview, absent=absent)


@dataclass(frozen=True)
class Quantized:
    """What the converters and encoders of a diagram have to do with a step.

    ``least``: height of the step that moves the answer by `LEAST` quanta; 0 without converters.
    ``usual``: height that the step would have without converters; None where its height was given.
    ``oscillations``: by converter, what is left of its input's motion at the end of the record, in quanta.
    """

    least: float = 0.0
    quantum: Quantum | None = None
    usual: float | None = None
    oscillations: Mapping[str, Number] = field(default_factory=dict)
    size: StepSize = StepSize.CHOSEN


def _said_of_quanta(
    v: Variant, test: StepTest, got: StepResponse, quantized: Quantized, saturated: list[str]
) -> Iterator[str]:
    """Yield what quanta do to a step: it was made larger, is small against them, or reaches limits ahead of them."""
    least, quantum, usual = quantized.least, quantized.quantum, quantized.usual
    if quantum is None:
        return
    said = {"variant": v.title, "wire": test.wire, "size": got.size, "block": quantum.converter, "many": LEAST}
    if abs(got.size) < (1.0 - 1e-9) * least:
        yield TEXTS.line("coarse", **said, quanta=LEAST * abs(got.size) / least, least=least)
    elif usual is not None and saturated and got.size > usual:
        yield TEXTS.line("no_range", **said, blocks=saturated)
    elif usual is not None and got.size > usual:
        yield TEXTS.line("enlarged", **said, usual=usual)


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


def _run(case: Case, v: Variant, test: StepTest) -> tuple[StepResponse, float | None, Quantized, float | None] | None:
    """Return a response, the rate of its slowest mode in 1/s, None if it has none, and what converters do to it.

    The last entry is the time in s from which it diverges, None where it does not.

    None at a wire with several entries, which has no single step.
    """
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
    given, chosen = _find_size(v, test)
    height, quantum = _least_step(diagram, point, test, length)
    size = max(usual, height) if given is None else given
    if limits is None or limits.length is None:
        length = max(length, _rest(diagram, point, test, size, slowest, length))
        length = min(length, SAMPLES[1] * dt) if dt else length
    outputs = [*([test.output] if test.output else []), *_commands(v.diagram, test.wire), *_excesses(v.diagram)]
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
    return got, slowest, Quantized(height, quantum, usual if given is None else None, left, chosen), diverges


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


def _oscillation(got: StepResponse, test: StepTest, v: Variant) -> dict[str, Number]:
    """Return amplitude and period of an oscillation that a response keeps to the end of its record; none without one.

    It is what the linear model doesn't have, in the last part of the record: as large in the first half of that as in
    the second, and around its mean several times.
    """
    answer = got.answer(bool(test.output))
    if got.prediction is not None:
        answer = answer - got.answer(bool(test.output), linear=True)
    tail = slice(int((1.0 - TAIL) * len(answer)), None)
    t, y = got.t[tail], answer[tail] - 0.5 * (np.max(answer[tail]) + np.min(answer[tail]))
    crossings = np.flatnonzero((y[:-1] < 0.0) != (y[1:] < 0.0))
    halves = [float(np.ptp(half)) for half in np.array_split(y, 2)]
    if len(crossings) < LEAST_CROSSINGS or not min(halves) > (1.0 - SUSTAINED) * max(halves):
        return {}
    amplitude, step = 0.5 * max(halves) * abs(got.size), float(np.max(np.diff(t)))
    period = 2.0 * float(t[crossings[-1]] - t[crossings[0]]) / (len(crossings) - 1)
    error = SUSTAINED * amplitude
    unit = unit_at(v.diagram, test.output or test.wire)
    return {
        "limit_cycle": Number(amplitude, unit, error, _how(got)),
        "limit_cycle_period": Number(period, "s", 4.0 * step / (len(crossings) - 1), _how(got)),
    }


def _diverging(got: StepResponse, test: StepTest, v: Variant, diverges: float | None) -> dict[str, Number]:
    """Return the numbers of a response that grows without end, in place of those of its record; none of another."""
    if diverges is None:
        return {}
    how = Confirmation("the nonlinear co-simulation, with and without the step: the response grows without end")
    units = {**STEP_UNITS, "peak": unit_at(v.diagram, test.output or test.wire)}
    found = {name: Number(math.inf, units.get(name, "1"), 0.0, how) for name in ("overshoot", "settling", "peak")}
    step = float(np.max(np.diff(got.t), initial=0.0))
    return found | {"diverges": Number(diverges, "s", step, how)}


def _small_response(got: StepResponse, respond: Callable[[float], StepResponse], least: float) -> StepResponse:
    """Return a response to a smaller step, of at least a height, if it is nearer to the linear model; else the same."""
    # a step that reaches limits of the diagram says little about the loop: 1 % of 1 + the signal's size is much where
    # signals are small in SI units
    for _ in range(TIMES_SMALLER):
        if got.prediction is None or _deviation(got) <= APART or SMALLER * abs(got.size) < least:
            break
        smaller = respond(SMALLER * got.size)
        if smaller.prediction is None or not _deviation(smaller) < _deviation(got):
            break
        got = smaller
    return got


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


def _excesses(diagram: WiredDiagram) -> list[str]:
    return [f"{path}.excess" for path, block in sorted(diagram.blocks.items()) if isinstance(block, Saturation)]


def _limits_reached(diagram: WiredDiagram, got: StepResponse) -> list[str]:
    """Return the saturations that cut something off during a response."""
    reached = []
    for path in (name.rpartition(".")[0] for name in _excesses(diagram)):
        own = [i for i, label in enumerate(got.outputs) if label.partition("[")[0] == f"{path}.excess"]
        if own and np.any(np.abs(got.y[:, own]) > 0.0):
            reached.append(path)
    return reached


def _effort(got: StepResponse, test: StepTest, slowest: float | None) -> Iterator[tuple[str, float, float, float]]:
    """Yield signals with their values before the step, their largest changes, and the errors of these."""
    if not test.output:
        change, error = _largest(got, 0, slowest)
        yield test.wire, _rounded(got.wire_before, 1.0), change, error
    for i, name in enumerate(got.outputs):
        plain = name.partition("[")[0]
        if plain.rpartition(".")[2] != "excess":
            largest = float(np.max(np.abs(got.before)))
            change, error = _largest(got, 1 + i, slowest)
            change = _rounded(change, max(largest, float(np.max(np.abs(got.y)))))
            yield name, _rounded(float(got.before[i]), largest), change, error


def _largest(got: StepResponse, column: int, slowest: float | None) -> tuple[float, float]:
    """Return the largest change of v (column 0) or of an output, and its error, with the rounding of two runs."""
    r, before = (got.v, got.wire_before) if column == 0 else (got.y[:, column - 1], got.before[column - 1])
    value, tolerance = measure_step(
        got.t, r, held=got.is_steady(column), expected=got.expected(column), slowest=slowest, accuracy=_accuracy(got)
    )["peak"]
    return value, tolerance + ROUNDING * abs(float(before))


def _accuracy(got: StepResponse) -> float:
    return SOLVER_ERROR if got.solved else TICK_ERROR


def unit_at(diagram: WiredDiagram, name: str) -> str:
    """Return the unit of a signal, "1" where it is not known or its entries differ."""
    plain = name.partition("[")[0]
    wire = diagram.names.get(plain)
    block, _, port = plain.rpartition(".")
    unit = diagram.checked.units.get((block, port) if wire is None else (wire.block, wire.port))
    return unit if isinstance(unit, str) and unit else "1"


def _rounded(value: float, size: float) -> float:
    """Return a value, 0 where it is rounding compared with values of a size."""
    return 0.0 if abs(value) <= ROUNDING * max(size, 1e-300) else value


def _numbers(got: StepResponse, test: StepTest, v: Variant, slowest: float | None) -> dict[str, Number]:
    """Return the numbers of a response by the ends of their paths."""
    output = bool(test.output)
    begins = int(np.argmax(got.d != 0.0))
    t = got.t[begins:] - got.t[begins]
    column = int(output)
    expected = got.expected(column, got.size if output else -got.size, begins)
    options: dict[str, Any] = {"held": got.is_steady(column), "expected": expected, "accuracy": _accuracy(got)}
    how = _how(got)
    units = {**STEP_UNITS, "peak": unit_at(v.diagram, test.output or test.wire)}
    found = {}
    answer = got.answer(output)[begins:]
    settled = is_at_rest(t, answer, expected, slowest)
    measured = measure_step(t, answer, slowest=slowest, **options)
    found["length"] = Number(float(t[-1]), "s", 0.0, "given: the last sample", given=True)
    found["settled"] = Number(float(settled), "1", 0.0, how)
    for name, (value, tolerance) in measured.items():
        factor = abs(got.size) if name == "peak" else 1.0
        found[name] = Number(factor * value, units.get(name, "1"), factor * tolerance, how)
    if expected is not None:
        known = measure_step(t, expected.response, **options | {"accuracy": TICK_ERROR})
        unknown = tuple(finding for finding in v.model.findings if finding.leaves_error_unknown)
        for name, (value, tolerance) in known.items():
            factor = abs(got.size) if name == "peak" else 1.0
            said = "the linear model's matrix, sample by sample"
            found[f"linear.{name}"] = Number(
                factor * value, units.get(name, "1"), factor * tolerance, said, findings=unknown
            )
        found["difference"] = Number(_deviation(got), "1", 1e-9, "co-simulation and linear model, sample by sample")
    return found


def _deviation(got: StepResponse) -> float:
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


def _how(got: StepResponse) -> Confirmation:
    run = Confirmation(
        f"the nonlinear co-simulation, {len(got.t)} samples, with and without the step",
        "the nonlinear co-simulation, with and without the step",
    )
    if got.unread:
        plants = ", ".join(got.unread)
        run = run.and_by(
            f"read at the communication points of {plants} alone: the tolerance has what the linear model does between "
            "them"
            if _keeps_steps(got)
            else f"with shorter communication steps of {plants}, which moves on between its own",
            at_steps_only=_keeps_steps(got),
        )
    if got.prediction is None:
        return run
    deviation = _deviation(got)
    agrees = f"the linear model {'agrees' if deviation <= AGREEMENT else 'does not agree'} to {100 * AGREEMENT:g} %"
    return run.and_by(f"the linear model differs by {deviation:.2g} of the largest change", agrees)


def _keeps_steps(got: StepResponse) -> bool:
    """Return whether a response has no instants but its samples."""
    return float(got.t[1] - got.t[0]) > 0.75 * got.dt


def _find_same_curves(found: Mapping[StepTest, Mapping[str, StepResponse]]) -> dict[StepTest, StepTest]:
    """Return the steps whose responses look as an earlier one's, with that one: a loop may have several names."""
    same: dict[StepTest, StepTest] = {}
    for test, curves in found.items():
        earlier = (other for other in found if other not in same and bool(other.output) == bool(test.output))
        for other in earlier:
            if other == test:
                break
            if found[other].keys() == curves.keys() and all(
                _is_alike(found[other][k], curves[k], test) for k in curves
            ):
                same[test] = other
                break
    return same


def _is_alike(one: StepResponse, other: StepResponse, test: StepTest) -> bool:
    """Return whether two responses differ by less than a line's width, per unit of the step."""
    if len(one.t) != len(other.t) or one.held != other.held or (one.prediction is None) != (other.prediction is None):
        return False
    pairs = [(of.answer(bool(test.output)), of.t - of.t[int(np.argmax(of.d != 0.0))]) for of in (one, other)]
    size = max(1.0, *(float(np.max(np.abs(y))) for y, _ in pairs))
    time = float(np.max(np.abs(pairs[0][1]))) or 1.0
    return bool(
        np.max(np.abs(pairs[0][0] - pairs[1][0])) <= ALIKE * size
        and np.max(np.abs(pairs[0][1] - pairs[1][1])) <= ALIKE * time
    )


def _plot(case: Case, test: StepTest, curves: Mapping[str, StepResponse], others: list[str]) -> Plot:
    said = " and ".join([str(test), *others])
    titles = {key: case.variants[key].title for key in curves}
    caption = TEXTS.line("figure_to", said=said) if test.output else TEXTS.line("figure", said=said)
    looks, to_output = case.looks, bool(test.output)
    return Plot(
        f"steps_{test.key}", caption, lambda: figures.step_responses(curves, titles, looks, to_output=to_output)
    )


def _overview(case: Case, test: StepTest, curves: Mapping[str, StepResponse]) -> Iterator[Plot]:
    """Yield the small figure of the diagram as it is."""
    actual = {key: got for key, got in curves.items() if case.variants[key].is_actual}
    if actual:
        yield figures.overview_step(test.key, str(test), actual, case.looks, to_output=bool(test.output))
