"""Responses of the running diagram to steps, next to those of its linear model, and the effort that they take."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError
from ...flat import WiredDiagram
from ...frequency import Confirmation, Number
from ...linearization import find_signal
from ...measure import LEAST, StepResponse
from ...requirements import STEP_UNITS
from ...results import is_at_rest, measure_step
from .. import figures
from ..case import Case
from ..error_sentences import say
from ..pages import Plot, Section, Table, TableForm, Texts
from ..stability import Stability
from .step_runs import AGREEMENT, ROUNDING, TICK_ERROR, StepRun, StepTest, deviation, excesses_of, run_step, step_tests

TEXTS = Texts(__package__, "steps")
TITLE = "Step and disturbance responses"
SOLVER_ERROR = 1e-7
"""Error of a response that a solver had a part in, relative to its largest change; 100 times its relative tolerance."""
TAIL = 0.4
"""Part of a record at its end in which an oscillation is looked for."""
LEAST_CROSSINGS = 6
"""Crossings of its mean that an oscillation has there at least."""
SUSTAINED = 0.2
"""Difference of its amplitudes in the halves of that part, relative to the larger one, up to which it is kept."""
ALIKE = 1e-4
"""Difference of two responses, relative to their size, that no figure shows."""
NAMES: Mapping[str, str] = {
    "overshoot": "overshoot",
    "settling": "settling time, 2 %",
    "rise": "rise time, 10 to 90 %",
    "peak": "largest change",
}

RESPONSES = TableForm(
    "Step responses",
    {"step": "step", "variant": "variant", "number": "words", "co-simulation": "found", "linear": "linear"},
)
EFFORT = TableForm(
    "Effort",
    {"step": "step", "variant": "variant", "signal": "signal", "before": "before", "largest change": "change"},
    terms={"before": "before_step"},
)
AT_REST = TableForm(
    "Oscillation at rest",
    {"after a step at": "step", "variant": "variant", "converter": "converter", "amplitude": "amplitude"},
    terms={"amplitude": "oscillation"},
)


@dataclass(frozen=True)
class ReportedStep:
    """A step that was tried: its numbers by the ends of their paths, the rows of tables, and remarks."""

    run: StepRun
    numbers: Mapping[str, Number]
    responses: Sequence[Mapping[str, Any]]
    effort: Sequence[Mapping[str, Any]]
    resting: Sequence[Mapping[str, Any]]
    remarks: Sequence[str]


def steps(case: Case) -> Section | None:
    """Return the section with the responses to steps of the diagram as it is, and of the variants that are judged."""
    text, absent, made = list[str](), dict[str, str](), list[ReportedStep]()
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
                ran = run_step(case, v, test)
            except LoopwrightError as error:
                text.append(TEXTS.line("failed", variant=v.title, wire=test.wire, message=say(error)))
                absent[f"{test.key}.{v.key}"] = say(error)
                continue
            if ran is None:
                absent[f"{test.key}.{v.key}"] = TEXTS.line("no_single", wire=test.wire)
                continue
            made.append(_report(ran))
            text += made[-1].remarks
    if not made:
        return Section("steps", TITLE, tuple(dict.fromkeys(text)), absent=absent) if text else None
    resting = [row for of in made for row in of.resting]
    meaning = (*TEXTS.paragraphs("responses"), *((TEXTS.line("resting"),) if resting else ()))
    numbers = {f"{of.run.key}.{name}": number for of in made for name, number in of.numbers.items()}
    tables = _tables(made, resting)
    plots, overview = _figures(case, [of.run for of in made])
    whole = (*meaning, *dict.fromkeys(text))
    return Section("steps", TITLE, whole, tuple(tables), plots, numbers, overview=overview, absent=absent)


def _tables(made: Sequence[ReportedStep], resting: Sequence[Mapping[str, Any]]) -> Iterator[Table]:
    """Yield the tables of responses, of effort, and of what oscillates at rest; the latter where there is something."""
    yield RESPONSES.fill(row for of in made for row in of.responses)
    effort = [row for of in made for row in of.effort]
    if effort:
        yield EFFORT.fill(effort)
    if resting:
        yield AT_REST.fill(resting)


def _figures(case: Case, runs: Sequence[StepRun]) -> tuple[tuple[Plot, ...], tuple[Plot, ...]]:
    """Return the figures of the responses, and the small ones of the diagram as it is."""
    # tests that differ in their limits alone are one figure
    found: dict[StepTest, dict[str, StepResponse]] = {}
    for ran in runs:
        found.setdefault(replace(ran.test, limits=None), {})[ran.variant.key] = ran.got
    same = _find_same_curves(found)
    plots = tuple(
        _plot(case, test, curves, [str(other) for other in same if same[other] == test])
        for test, curves in found.items()
        if test not in same
    )
    return plots, tuple(plot for test, curves in found.items() for plot in _overview(case, test, curves))


def _report(ran: StepRun) -> ReportedStep:
    """Return the numbers of a step's response, and what there is to say of it."""
    got, test, v = ran.got, ran.test, ran.variant
    at = {"step": str(test), "variant": v.title}
    own = _numbers(ran) | _diverging(ran)
    if test.limits is not None:
        port = ".".join(find_signal(v.diagram.flatten_like(v.point), test.wire).port)
        own["size"] = Number(got.size, unit_at(v.diagram, port), 0.0, ran.origin.value, given=True)
    if not own["settled"].value and ran.diverges is None:
        own |= _oscillation(ran)
    responses = [
        {**at, "words": words, "found": own[name], "linear": own.get(f"linear.{name}")}
        for name, words in NAMES.items()
        if name != "peak"
    ]
    effort, more = list[dict[str, Any]](), dict[str, Number]()
    for name, before, change, off in _effort(ran):
        unit = unit_at(v.diagram, name)
        more[f"effort.{name.replace('.', '_')}"] = changed = Number(change, unit, off, _how(got))
        at_first = Number(before, unit, 1e-9 * abs(before), "the run before the step", given=True)
        effort.append({**at, "signal": name, "before": at_first, "change": changed})
    more |= {f"{name.replace('.', '_')}.oscillation": number for name, number in ran.oscillations.items()}
    resting = [{**at, "converter": name, "amplitude": number} for name, number in ran.oscillations.items()]
    return ReportedStep(ran, {**own, **more}, responses, effort, resting, list(_remarks(ran, own)))


def _remarks(ran: StepRun, own: Mapping[str, Number]) -> Iterator[str]:
    """Yield what a reader should know of a response: that it grows, meets limits or quanta, or has not ended."""
    got, test, said = ran.got, ran.test, {"variant": ran.variant.title, "wire": ran.test.wire}
    if ran.diverges is not None:
        yield TEXTS.line("diverges", variant=ran.variant.title, wire=str(test), since=ran.diverges)
    saturated = _limits_reached(ran.variant.diagram, got)
    if saturated:
        yield TEXTS.line("saturated", **said, blocks=saturated)
    yield from _said_of_quanta(ran, saturated)
    if got.unread and _keeps_steps(got):
        yield TEXTS.line("unread", **said, plants=got.unread)
    if got.prediction is None:
        yield TEXTS.line("unpredicted", **said)
    if not own["settled"].value and ran.diverges is None:
        yield TEXTS.line("unsettled", **said, length=own["length"].value)
    if got.moved > 1e-6:
        yield TEXTS.line("moved", **said, moved=got.moved)


def _said_of_quanta(ran: StepRun, saturated: Sequence[str]) -> Iterator[str]:
    """Yield what quanta do to a step: it was made larger, is small against them, or reaches limits ahead of them."""
    size, usual = ran.got.size, ran.usual
    if ran.quantum is None:
        return
    said = {
        "variant": ran.variant.title,
        "wire": ran.test.wire,
        "size": size,
        "block": ran.quantum.converter,
        "many": LEAST,
    }
    if abs(size) < (1.0 - 1e-9) * ran.least:
        yield TEXTS.line("coarse", **said, quanta=LEAST * abs(size) / ran.least, least=ran.least)
    elif usual is not None and saturated and size > usual:
        yield TEXTS.line("no_range", **said, blocks=saturated)
    elif usual is not None and size > usual:
        yield TEXTS.line("enlarged", **said, usual=usual)


def _limits_reached(diagram: WiredDiagram, got: StepResponse) -> list[str]:
    """Return the saturations that cut something off during a response."""
    reached = []
    for path in (name.rpartition(".")[0] for name in excesses_of(diagram)):
        own = [i for i, label in enumerate(got.outputs) if label.partition("[")[0] == f"{path}.excess"]
        if own and np.any(np.abs(got.y[:, own]) > 0.0):
            reached.append(path)
    return reached


def _effort(ran: StepRun) -> Iterator[tuple[str, float, float, float]]:
    """Yield signals with their values before the step, their largest changes, and the errors of these."""
    got, test, slowest = ran.got, ran.test, ran.slowest
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


def _numbers(ran: StepRun) -> dict[str, Number]:
    """Return the numbers of a response by the ends of their paths."""
    got, test, v, slowest = ran.got, ran.test, ran.variant, ran.slowest
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
        found["difference"] = Number(deviation(got), "1", 1e-9, "co-simulation and linear model, sample by sample")
    return found


def _diverging(ran: StepRun) -> dict[str, Number]:
    """Return the numbers of a response that grows without end, in place of those of its record; none of another."""
    if ran.diverges is None:
        return {}
    how = Confirmation("the nonlinear co-simulation, with and without the step: the response grows without end")
    units = {**STEP_UNITS, "peak": unit_at(ran.variant.diagram, ran.test.output or ran.test.wire)}
    found = {name: Number(math.inf, units.get(name, "1"), 0.0, how) for name in ("overshoot", "settling", "peak")}
    step = float(np.max(np.diff(ran.got.t), initial=0.0))
    return found | {"diverges": Number(ran.diverges, "s", step, how)}


def _oscillation(ran: StepRun) -> dict[str, Number]:
    """Return amplitude and period of an oscillation that a response keeps to the end of its record; none without one.

    It is what the linear model doesn't have, in the last part of the record: as large in the first half of that as in
    the second, and around its mean several times.
    """
    got, test = ran.got, ran.test
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
    unit = unit_at(ran.variant.diagram, test.output or test.wire)
    return {
        "limit_cycle": Number(amplitude, unit, error, _how(got)),
        "limit_cycle_period": Number(period, "s", 4.0 * step / (len(crossings) - 1), _how(got)),
    }


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
    off = deviation(got)
    agrees = f"the linear model {'agrees' if off <= AGREEMENT else 'does not agree'} to {100 * AGREEMENT:g} %"
    return run.and_by(f"the linear model differs by {off:.2g} of the largest change", agrees)


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
