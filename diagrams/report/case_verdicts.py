"""Verdicts on the requirements of a case, from the numbers of its report."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...blocks.core import LoopwrightError, UnknownNameError, close_names, near, print_unit
from ..frequency import Number
from ..linearization import find_signal
from ..requirements import (
    SENSES,
    Limit,
    Reason,
    RequirementResult,
    Requirements,
    Review,
    StepLimits,
    StepSize,
    Verdict,
    is_doubtful,
    judge,
    judge_interval,
)
from ..studies import CaseState, StudyCase, is_zero, words_of
from ..wiring import join
from .case import Case
from .points import STEP
from .sections.contacts import ReportedContacts
from .sections.injection import REFUTED
from .sections.measured_loops import MEASURED, MeasuredLoop
from .sections.step_responses import APART, key_of_step, unit_at
from .sections.worst_case import MissingWorstCase, ReportedWorstCase
from .stability import Stability, free_motions, why_unstable
from .variant import Cut, Variant

STABLE = Limit(-math.inf, 0.0)
MANY = 10.0
"""Multiple of a measurement's uncertainty by which it has to be off to refute a linear model."""

LEAST_POLE = 1e-9
"""Size of a pole, relative to the largest, below which it sets no frequency."""
ALIKE = 1e-3
"""Difference of two complementary sensitivities, relative to the largest, up to which their steps are alike."""

HAS_NONE = (
    "the wire is renewed several times in the period of all clocks, so that S and T change frequencies there and have "
    "no value at a single one; limit ms, disk_margin, gain_margin_high or phase_margin_deg, which the loop has"
)
"""Reason why a periodically time-varying loop lacks a number, with a next step."""

NO_LOOP = "No wire on a loop has a name or a margin: is a feedback wire missing? Name a wire of the loop, .named(…)"
SEVERAL_ENTRIES = (
    "No loop has it, as a wire with several entries has a disk margin only. "
    "Limit disk_margin, or name a wire of one entry"
)


def check_names(case: Case, asked: Requirements, measured: Collection[str] = ()) -> None:
    """Refuse names in requirements that the diagram does not have."""
    names = (name for all_names in case.names_of_loops().values() for name in all_names)
    known = {*names, *case.extra_loops(), *measured}
    for name in asked.loops:
        if name not in known:
            error = UnknownNameError(
                f"found requirements on a loop {name!r}; expected a loop of the report. {near(name, known)}",
                block=case.diagram.name,
            )
            raise asked.error_at(error, f"loops.{name}")
    variants = {**dict.fromkeys(case.variants), **({MEASURED: None} if measured else {})}
    for key in asked.further_variants:
        if key not in variants:
            error = UnknownNameError(
                f"found requirements on a variant {key!r}; expected one of the report. {near(key, variants)}",
                block=case.diagram.name,
            )
            owners = (f"loops.{name}" for name, of in asked.loops.items() if key in of.variants)
            owner = "" if key in asked.variants else next(owners) + "."
            raise asked.error_at(error, f"{owner}variants")
    flat = case.diagram.flatten(None if case.diagram.has_clock else STEP)
    for limits in asked.steps:
        for end, wire in (("input", limits.input), ("output", limits.output)):
            try:
                if wire:
                    find_signal(flat, wire)
            except LoopwrightError as error:
                several = len(asked.steps) > 1 or asked.step is not None
                raise asked.error_at(error, f"step.{end}" if not several else f"step, {end}") from None


def review(
    case: Case,
    asked: Requirements,
    numbers: Mapping[str, Number],
    measured: Sequence[MeasuredLoop] = (),
    worst_case: ReportedWorstCase | MissingWorstCase | None = None,
    contacts: ReportedContacts | None = None,
    absent: Mapping[str, str] | None = None,
) -> Review:
    """Return the verdicts on requirements; ``absent`` has the reasons why numbers are missing, by path."""
    felt = () if contacts is None else contacts.results(numbers)
    outcomes = {} if worst_case is None else worst_case.outcomes()
    searched = () if worst_case is None else worst_case.results()
    plain = (_plain(path, limit, numbers, outcomes) for path, limit in asked.numbers.items())
    return Review(
        (
            *_results(case, asked, numbers, absent or {}),
            *plain,
            *_measured(case, asked, numbers, measured),
            *searched,
            *felt,
        ),
        free_motions(case.judged()),
    )


def reason_of(absent: Mapping[str, str], path: str) -> str:
    """Return the reason why numbers below a path are missing; that of the longest part of it that has one."""
    parts = path.split(".")
    return next((absent[p] for n in range(len(parts), 0, -1) if (p := ".".join(parts[:n])) in absent), "")


def _results(
    case: Case, asked: Requirements, numbers: Mapping[str, Number], absent: Mapping[str, str]
) -> Iterator[RequirementResult]:
    judged = list(case.judged())
    if case.actual is None:
        yield RequirementResult("stable", "", "", STABLE, Verdict.UNDECIDED, Reason.NOT_ANALYSED)
    wires = case.loop_wires()
    loops = {**case.names_of_loops(), **{key: (key,) for key in case.extra_loops()}}
    for v in judged:
        state, seen = _State.of(v), set[str]()
        if asked.stable:
            yield _stable(v, state, numbers)
        for key, names in loops.items():
            if not (v.is_actual or asked.judges(names, v.key)):
                continue
            own = asked.limits_named(names, v.key)
            for name, limit in asked.limits_of(names, v.key).items():
                found = _worst(numbers, f"inner.{key}.{v.key}", name, limit)
                if found is None and name not in own:
                    if _has_channels(numbers, f"inner.{key}"):
                        continue  # a general limit of single loops
                    if key in wires and v.loops_elsewhere(wires[key], _wires_judged(case, asked, numbers, v, name)):
                        continue  # its loops are judged at other wires
                is_periodic = _is_periodic(numbers, f"inner.{key}.{v.key}")
                reason, said = (Reason.PERIODIC, HAS_NONE) if is_periodic else (Reason.NO_NUMBER, "")
                detail = (said or reason_of(absent, f"inner.{key}.{v.key}")) if found is None else ""
                result = RequirementResult(name, key, v.key, limit, Verdict.UNDECIDED, reason, detail=detail)
                result = _with(state, result, found, _refuted(numbers, key, v.key))
                yield _at_other_cuts(case, v, result) if key in wires else result
                seen.add(name)
            step = asked.step_of(names, v.key)
            if step is not None and key in wires:
                others = _wires_stepped(case, asked, numbers, v, step)
                if step is not asked.step_named(names, v.key) and v.loops_elsewhere(wires[key], others):
                    continue  # a general limit, judged at other wires of the loop
                for result in _step(case, v, state, key, step, numbers, absent):
                    yield _stepped_elsewhere(case, v, key, result)
                seen |= {f"step.{name}" for name in step.limits}
        if v.is_actual:
            yield from _nowhere(asked, v, state, seen, bool(loops))
        for step in asked.steps:
            yield from _step(case, v, state, key_of_step(step), step, numbers, absent, loop="")


def _nowhere(
    asked: Requirements, v: Variant, state: _State, seen: Collection[str], has_loops: bool
) -> Iterator[RequirementResult]:
    """Yield the general limits that no loop was judged by: what is required and found nowhere is not met."""
    step = {} if asked.step is None else asked.step.limits
    for name, limit in {**asked.limits, **{f"step.{name}": limit for name, limit in step.items()}}.items():
        if name not in seen:
            detail = SEVERAL_ENTRIES if has_loops else NO_LOOP
            result = RequirementResult(name, "", v.key, limit, Verdict.UNDECIDED, Reason.NO_NUMBER, detail=detail)
            yield _with(state, result, None)


def _wires_judged(
    case: Case, asked: Requirements, numbers: Mapping[str, Number], v: Variant, name: str
) -> Iterator[str]:
    """Yield the wires at which a variant's loop has a number that is limited there."""
    for key, wire, names in _judged_loops(case, asked, v):
        limit = asked.limits_of(names, v.key).get(name)
        if limit is not None and _worst(numbers, f"inner.{key}.{v.key}", name, limit) is not None:
            yield wire


def _wires_stepped(
    case: Case, asked: Requirements, numbers: Mapping[str, Number], v: Variant, step: StepLimits
) -> Iterator[str]:
    """Yield the wires at which a variant has a response to a step whose numbers are limited there, too."""
    for key, wire, names in _judged_loops(case, asked, v):
        own = asked.step_of(names, v.key)
        if own is not None and all(
            name in own.limits and f"steps.{key}.{v.key}.{name}" in numbers for name in step.limits
        ):
            yield wire


def _judged_loops(case: Case, asked: Requirements, v: Variant) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield the loops at wires that are judged in a variant: their keys, wires and names."""
    wires = case.loop_wires()
    for key, names in case.names_of_loops().items():
        if v.is_actual or asked.judges(names, v.key):
            yield key, wires[key], names


def _measured(
    case: Case, asked: Requirements, numbers: Mapping[str, Number], measured: Sequence[MeasuredLoop]
) -> Iterator[RequirementResult]:
    """Yield the verdicts on margins of measured loops: the whole interval has to be within the limits."""
    named, actual = case.names_of_loops(), case.actual
    dt = actual.model.dt if actual is not None and not actual.problem else 0.0
    for of in measured:
        names = tuple(dict.fromkeys((of.key, *named.get(of.key, ()), of.wire)))
        intervals, own = of.intervals(dt), asked.limits_of_variant(names, MEASURED)
        for name, limit in asked.limits_of(names, MEASURED).items():
            result = RequirementResult(name, of.key, MEASURED, limit, Verdict.UNDECIDED, Reason.NO_NUMBER)
            if name not in intervals:
                if name in own:
                    yield result
                continue  # a general limit of the model's numbers
            at, path = intervals[name], of.path(name)
            verdict, reason, distance = judge_interval(at.value, at.low, at.high, limit)
            if verdict is Verdict.PASSED and of.uncertainty is None:
                verdict, reason = Verdict.UNDECIDED, Reason.NO_UNCERTAINTY
            said = f"{at.low:.4g} … {at.high:.4g}" if reason is Reason.WITHIN_TOLERANCE else ""
            result = replace(result, verdict=verdict, reason=reason, distance=distance, detail=said)
            yield replace(result, path=path, number=numbers[path]) if path in numbers else result


@dataclass(frozen=True)
class _State:
    """What keeps a variant's numbers from a verdict by comparison: a reason, its verdict, and more in words."""

    verdict: Verdict | None = None
    reason: Reason = Reason.COMPARED
    detail: str = ""

    @classmethod
    def of(cls, v: Variant) -> _State:
        if v.problem:
            return cls(Verdict.UNDECIDED, Reason.NOT_ANALYSED, v.problem)
        try:
            stability = Stability.of(v)
        except LoopwrightError as error:
            return cls(Verdict.UNDECIDED, Reason.NOT_ANALYSED, error.message)
        if stability is Stability.UNSTABLE:
            return cls(Verdict.FAILED, Reason.UNSTABLE, why_unstable(v))
        return cls(Verdict.UNDECIDED, Reason.MOVING, v.moves_most) if _moves(v) else cls()


def _moves(v: Variant) -> bool:
    """Return whether a variant's operating point is no equilibrium, and what moves acts on anything else."""
    return not v.rests and not v.moving_alone


def _stable(v: Variant, state: _State, numbers: Mapping[str, Number]) -> RequirementResult:
    path = f"poles.{v.key}.slowest"
    number = numbers.get(path)
    result = RequirementResult("stable", "", v.key, STABLE, Verdict.UNDECIDED, Reason.NO_NUMBER)
    if state.reason is Reason.NOT_ANALYSED:
        return replace(result, reason=state.reason, detail=state.detail)
    stability = Stability.of(v)
    distance = math.nan if number is None else STABLE.distance(number.value)
    result = replace(result, distance=distance, path=path if number is not None else "", number=number)
    if stability is Stability.UNSTABLE:
        return replace(result, verdict=Verdict.FAILED, reason=Reason.UNSTABLE, detail=state.detail)
    if stability is Stability.ON_THE_LIMIT:
        return replace(result, verdict=Verdict.UNDECIDED, reason=Reason.ON_THE_LIMIT)
    if number is not None and is_doubtful(number):
        return replace(result, reason=Reason.FINDINGS)
    if state.verdict is not None:
        return replace(result, verdict=state.verdict, reason=state.reason, detail=state.detail)
    if number is not None:
        return replace(result, verdict=Verdict.PASSED, reason=Reason.COMPARED)
    is_left_out = len(v.model.poles) > 0 and "poles" not in {name.split(".")[0] for name in numbers}
    return replace(result, detail="Its chapter was left out: add 'poles' to only=") if is_left_out else result


def _with(
    state: _State, result: RequirementResult, found: tuple[str, Number] | None, refuted: bool = False
) -> RequirementResult:
    """Return a result with the verdict on the number that was found, if nothing keeps it from one."""
    if state.verdict is Verdict.FAILED or (state.verdict is not None and found is None):
        return replace(result, verdict=state.verdict, reason=state.reason, detail=state.detail)
    if found is None:
        return result
    path, number = found
    verdict, reason, distance = judge(number, result.limit)
    result = replace(result, verdict=verdict, reason=reason, distance=distance, path=path, number=number)
    if verdict is Verdict.PASSED and state.verdict is not None:
        return replace(result, verdict=state.verdict, reason=state.reason, detail=state.detail)
    if refuted and verdict is not Verdict.UNDECIDED:
        return replace(result, verdict=Verdict.UNDECIDED, reason=Reason.REFUTED)
    return result


def _at_other_cuts(case: Case, v: Variant, result: RequirementResult) -> RequirementResult:
    """Return a result that is open where other cuts of its wire have other verdicts, and the plant may be there."""
    place = case.loop_places[result.loop]
    if not place.others or result.reason is not Reason.COMPARED or result.number is None:
        return result
    found = [(inputs, v.number_ahead(result.quantity, wire, inputs)) for wire, inputs in place.others]
    there = [(inputs, number) for inputs, number in found if number is not None]
    if all(judge(number, result.limit)[0] is result.verdict for _, number in there):
        return result
    unit = print_unit(result.unit) if result.unit else ""
    every = [(tuple(join(*to) for to in place.to), result.number), *there]
    said = ", ".join(f"{number.value:.4g}{unit} at {words_of(inputs)}" for inputs, number in every)
    return replace(result, verdict=Verdict.UNDECIDED, reason=Reason.SEVERAL_CUTS, detail=said)


def _stepped_elsewhere(case: Case, v: Variant, key: str, result: RequirementResult) -> RequirementResult:
    """Return a result on a step at a wire that is open where the step at other cuts of the wire has another answer."""
    place = case.loop_places[key]
    if not place.others or result.reason is not Reason.COMPARED:
        return result
    try:
        loops = [(inputs, v.loop_ahead(wire, inputs)) for wire, inputs in place.others]
        here = v.fullest_loop(place.name)[2]
        s = v.model.poles
        rates = np.abs(np.log(s[np.abs(s) > LEAST_POLE]) / here.dt if here.dt else s)
        rates = rates[rates > LEAST_POLE * np.max(rates, initial=0.0)]
        top = np.pi / here.dt if here.dt else 10.0 * np.max(rates, initial=1.0)
        w = np.geomspace(min(0.1 * np.min(rates, initial=1.0), 0.1 * top), top, 200)
        points = np.exp(1j * w * here.dt) if here.dt else 1j * w
        own = here(points) / (1.0 + here(points))
        apart = [
            words_of(inputs)
            for inputs, L in loops
            if not is_zero(L) and np.max(np.abs(L(points) / (1.0 + L(points)) - own)) > ALIKE * np.max(np.abs(own))
        ]
    except LoopwrightError as error:
        apart = [error.what_was_found]
    if not apart:
        return result
    said = f"the answer to a step differs at {', '.join(apart)}"
    return replace(result, verdict=Verdict.UNDECIDED, reason=Reason.SEVERAL_CUTS, detail=said)


def _worst(numbers: Mapping[str, Number], start: str, name: str, limit: Limit) -> tuple[str, Number] | None:
    """Return the number of a loop in a variant that is worst for a limit, with its path.

    Of a wire that is renewed several times in the period only the numbers with all loops closed count.
    """
    below = [path for path in numbers if path.startswith(f"{start}.")]
    cut = [path for path in below if path.startswith(f"{start}.{Cut.SLOW_OPEN}.")]
    places = [path for path in below if path not in cut and path.rpartition(".")[2] == name]
    own = [path for path in places if not {"control"}.intersection(path[len(start) :].split("."))]
    own = [path for path in own if not _is_crossing(path[len(start) + 1 :])]
    if not own:
        return None
    decided = sorted(own, key=lambda path: (not math.isnan(numbers[path].value), limit.distance(numbers[path].value)))
    return decided[0], numbers[decided[0]]


def _is_crossing(rest: str) -> bool:
    return rest.partition(".")[0].rstrip("0123456789") in ("gain_crossover_", "phase_crossover_")


def _has_channels(numbers: Mapping[str, Number], start: str) -> bool:
    """Return whether a loop has several channels, of which there is a disk margin alone."""
    mine = [path for path in numbers if path.startswith(f"{start}.")]
    return bool(mine) and not any(path.rpartition(".")[2] == "phase_margin_deg" for path in mine)


def _is_periodic(numbers: Mapping[str, Number], start: str) -> bool:
    """Return whether the margins of a loop are those of a wire that is renewed several times in the period."""
    return f"{start}.{Cut.PERIODIC}.stable" in numbers


def _refuted(numbers: Mapping[str, Number], key: str, variant: str) -> bool:
    found = [numbers.get(f"injection.{key}.{variant}.{name}") for name in ("deviation", "uncertainty")]
    worst, own = (math.nan if number is None else number.value for number in found)
    return worst - MANY * own > REFUTED


def _step(
    case: Case,
    v: Variant,
    state: _State,
    key: str,
    step: StepLimits,
    numbers: Mapping[str, Number],
    absent: Mapping[str, str],
    loop: str | None = None,
) -> Iterator[RequirementResult]:
    settled, length = (numbers.get(f"steps.{key}.{v.key}.{name}") for name in ("settled", "length"))
    for name, limit in step.limits.items():
        path = f"steps.{key}.{v.key}.{name}"
        number = numbers.get(path)
        where = key if loop is None else loop
        result = RequirementResult(f"step.{name}", where, v.key, limit, Verdict.UNDECIDED, Reason.NOT_MEASURED)
        if name == "peak" and number is None:
            result = replace(result, unit=unit_at(v.diagram, step.output or step.input or case.loop_wires()[key]))
        if loop == "":
            result = replace(result, place=f"{step.input} → {step.output}" if step.output else step.input)
        if number is None:
            result = replace(result, detail=reason_of(absent, f"steps.{key}.{v.key}"))
        result = _with(state, result, None if number is None else (path, number))
        result = replace(result, size=numbers.get(f"steps.{key}.{v.key}.size"))
        if (since := numbers.get(f"steps.{key}.{v.key}.diverges")) is not None:
            detail = f"from t = {since.value:.4g} s after the step, where it leaves the linear model's response"
            result = replace(result, verdict=Verdict.FAILED, reason=Reason.DIVERGES, detail=detail)
        elif number is not None and settled is not None and not settled.value and length is not None:
            result = _not_settled(result, number, length)
            cycle, period = (numbers.get(f"steps.{key}.{v.key}.limit_cycle{end}") for end in ("", "_period"))
            if result.reason is Reason.NOT_SETTLED and cycle is not None and period is not None:
                unit = "" if cycle.unit == "1" else f" {cycle.unit}"
                size = f"± {cycle.value:.3g}{unit}"
                detail = f"by {size} with a period of {period.value:.3g} s, in a record of {result.detail}"
                result = replace(result, reason=Reason.OSCILLATES, detail=detail)
        is_chosen = step.size is None and (result.size is None or result.size.confirmed_by == StepSize.CHOSEN)
        yield _at_no_size(result, numbers, f"steps.{key}.{v.key}", name) if is_chosen else result


def _at_no_size(result: RequirementResult, numbers: Mapping[str, Number], start: str, name: str) -> RequirementResult:
    """Return a result on a step of no given size: it is open where run and linear model differ about the limit."""
    difference, linear = numbers.get(f"{start}.difference"), numbers.get(f"{start}.linear.{name}")
    if difference is None or linear is None or difference.value <= APART or result.reason is not Reason.COMPARED:
        return result
    if judge(linear, result.limit)[0] is result.verdict:
        return result
    detail = f"{linear.value:.4g} there, and they differ by {difference.value:.2g} of the largest change"
    return replace(result, verdict=Verdict.UNDECIDED, reason=Reason.SIZE_NOT_GIVEN, detail=detail)


def _not_settled(result: RequirementResult, number: Number, length: Number) -> RequirementResult:
    """Return a result on a response that moves at the end of its record: its numbers so far are least values."""
    if result.reason is Reason.UNSTABLE:
        return result
    least = length.value if math.isinf(number.value) else number.value - number.tolerance
    if least > result.limit.high:
        return result
    return replace(result, verdict=Verdict.UNDECIDED, reason=Reason.NOT_SETTLED, detail=f"{length.value:.4g} s")


def _plain(
    path: str, limit: Limit, numbers: Mapping[str, Number], outcomes: Mapping[str, StudyCase]
) -> RequirementResult:
    result = RequirementResult(path, "", "", limit, Verdict.UNDECIDED, Reason.NO_NUMBER)
    if path in numbers:
        return _with(_State(), result, (path, numbers[path]))
    start, _, name = path.rpartition(".")
    of = outcomes.get(start) if name in SENSES else None
    if of is not None and of.state is CaseState.UNSTABLE:
        return replace(result, verdict=Verdict.FAILED, reason=Reason.UNSTABLE)
    if of is not None and of.state is CaseState.FAILED:
        return replace(result, reason=Reason.NOT_ANALYSED, detail=of.reason)
    close = close_names(path, numbers)
    return replace(result, detail=near(path, numbers)) if close else result


def weakest(numbers: Mapping[str, Number], variants: Iterable[str]) -> tuple[str, Number] | None:
    """Return the smallest disk margin of some variants with its path, or else the smallest modulus margin; or None."""
    keys = set(variants)
    for name in ("disk_margin", "modulus_margin"):
        found = {}
        for path, number in numbers.items():
            first, *rest, last = path.split(".")
            if first == "inner" and len(rest) > 1 and rest[1] in keys and last == name and "control" not in rest:
                found[path] = number
        found = {path: number for path, number in found.items() if not math.isnan(number.value)}
        if found:
            path = min(found, key=lambda p: found[p].value)
            return path, found[path]
    return None
