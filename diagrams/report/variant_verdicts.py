"""Verdicts on the requirements of one variant: its stability, its loops' numbers, and its responses to steps."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...blocks.core import LoopwrightError, print_unit
from ..frequency import Number
from ..requirements import (
    Limit,
    Reason,
    RequirementResult,
    Requirements,
    StepLimits,
    StepSize,
    Verdict,
    is_doubtful,
    judge,
)
from ..studies import is_zero, words_of
from ..wiring import join
from .case import Case
from .sections.injection import is_refuted
from .sections.step_responses import unit_at
from .sections.step_runs import APART, required_steps
from .stability import Stability, why_unstable
from .variant import Cut, Variant

STABLE = Limit(-math.inf, 0.0)
LEAST_POLE = 1e-9
"""Size of a pole, relative to the largest, below which it sets no frequency."""
ALIKE = 1e-3
"""Difference of two complementary sensitivities, relative to the largest, up to which their steps are alike."""
CROSSINGS = ("gain_crossover_", "phase_crossover_")
"""Beginnings of the parts of dotted paths that have the numbers of single crossings."""

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


def reason_of(absent: Mapping[str, str], path: str) -> str:
    """Return the reason why numbers below a path are missing; that of the longest part of it that has one."""
    parts = path.split(".")
    return next((absent[p] for n in range(len(parts), 0, -1) if (p := ".".join(parts[:n])) in absent), "")


def numbers_below(numbers: Mapping[str, Number], start: str) -> dict[str, Number]:
    """Return the numbers whose dotted paths begin with a part, by the rest of their paths."""
    return {path[len(start) + 1 :]: number for path, number in numbers.items() if path.startswith(f"{start}.")}


@dataclass(frozen=True)
class Obstacle:
    """What keeps a variant's numbers from a verdict by comparison; its closed loop is unstable, say."""

    verdict: Verdict
    reason: Reason
    detail: str = ""

    def apply(self, result: RequirementResult) -> RequirementResult:
        """Return a result with its verdict."""
        return replace(result, verdict=self.verdict, reason=self.reason, detail=self.detail)


class VariantReview:
    """Verdicts on what is required of a variant, from the numbers of a report.

    ``numbers`` are all of the report by their dotted paths, ``absent`` the reasons why others are missing.
    """

    def __init__(
        self, case: Case, asked: Requirements, numbers: Mapping[str, Number], absent: Mapping[str, str], v: Variant
    ):
        self.case, self.asked, self.numbers, self.absent, self.v = case, asked, numbers, absent, v
        self.wires = case.loop_wires()
        self.stability: Stability | None = None  # None of one that can't be analysed
        self.obstacle = self._find_obstacle()

    def _find_obstacle(self) -> Obstacle | None:
        v = self.v
        if v.problem:
            return Obstacle(Verdict.UNDECIDED, Reason.NOT_ANALYSED, v.problem)
        try:
            self.stability = Stability.of(v)
        except LoopwrightError as error:
            return Obstacle(Verdict.UNDECIDED, Reason.NOT_ANALYSED, error.message)
        if self.stability is Stability.UNSTABLE:
            return Obstacle(Verdict.FAILED, Reason.UNSTABLE, why_unstable(v))
        moves = not v.rests and not v.moving_alone
        return Obstacle(Verdict.UNDECIDED, Reason.MOVING, v.moves_most) if moves else None

    def results(self) -> Iterator[RequirementResult]:
        """Yield the verdicts: of stability, of each loop and the step at its wire, and of the steps between wires."""
        asked, v, seen = self.asked, self.v, set[str]()
        if asked.stable:
            yield self._stable()
        loops = {**self.case.names_of_loops(), **{key: (key,) for key in self.case.extra_loops()}}
        for key, names in loops.items():
            if v.is_actual or asked.judges(names, v.key):
                for result in (*self._loop(key, names), *self._step_of_loop(key, names)):
                    seen.add(result.quantity)
                    yield result
        if v.is_actual:
            yield from self._nowhere(seen, bool(loops))
        for key, step in required_steps(self.case, asked, v).items():
            yield from self._step(key, step, loop="")

    # --- stability ----------------------------------------------------------------------------------------------------

    def _stable(self) -> RequirementResult:
        v, obstacle = self.v, self.obstacle
        path = f"poles.{v.key}.slowest"
        number = self.numbers.get(path)
        result = RequirementResult("stable", "", v.key, STABLE)
        if obstacle is not None and self.stability is None:
            return obstacle.apply(result)
        if number is not None:
            result = replace(result, distance=STABLE.distance(number.value), path=path, number=number)
        if obstacle is not None and self.stability is Stability.UNSTABLE:
            return obstacle.apply(result)
        if self.stability is Stability.ON_THE_LIMIT:
            return result.undecided(Reason.ON_THE_LIMIT)
        if number is not None and is_doubtful(number):
            return result.undecided(Reason.FINDINGS)
        if obstacle is not None:
            return obstacle.apply(result)
        if number is not None:
            return replace(result, verdict=Verdict.PASSED, reason=Reason.COMPARED)
        is_left_out = len(v.model.poles) > 0 and not numbers_below(self.numbers, "poles")
        return replace(result, detail="Its chapter was left out: add 'poles' to only=") if is_left_out else result

    # --- numbers of loops ---------------------------------------------------------------------------------------------

    def _loop(self, key: str, names: tuple[str, ...]) -> Iterator[RequirementResult]:
        """Yield the verdicts on the margins of a loop."""
        asked, v = self.asked, self.v
        start = f"inner.{key}.{v.key}"
        own, mine = asked.limits_named(names, v.key), numbers_below(self.numbers, start)
        for name, limit in asked.limits_of(names, v.key).items():
            rest = _find_worst(mine, name, limit)
            if name not in own:
                if rest is None and self._has_channels(key):
                    continue  # a general limit of single loops
                if key in self.wires and v.loops_elsewhere(self.wires[key], self._wires_judged(name)):
                    continue  # its loops are judged at other wires
            result = RequirementResult(name, key, v.key, limit)
            if rest is None:
                is_periodic = f"{Cut.PERIODIC}.stable" in mine
                why = HAS_NONE if is_periodic else reason_of(self.absent, start)
                result = result.undecided(Reason.PERIODIC if is_periodic else Reason.NO_NUMBER, why)
            result = self._judge(result, "" if rest is None else f"{start}.{rest}", refuted=self._is_refuted(key))
            yield self._compare_other_cuts(result) if key in self.wires else result

    def _judge(self, result: RequirementResult, path: str, *, refuted: bool = False) -> RequirementResult:
        """Return a result with the verdict on the number with this path, if nothing keeps it from one; "" is none."""
        obstacle = self.obstacle
        if obstacle is not None and (obstacle.verdict is Verdict.FAILED or not path):
            return obstacle.apply(result)
        if not path:
            return result
        result = result.judged(self.numbers[path], path)
        if result.verdict is Verdict.PASSED and obstacle is not None:
            return obstacle.apply(result)
        return result.undecided(Reason.REFUTED) if refuted and result.verdict is not Verdict.UNDECIDED else result

    def _nowhere(self, seen: Collection[str], has_loops: bool) -> Iterator[RequirementResult]:
        """Yield the general limits that no loop was judged by: what is required and found nowhere is not met."""
        step = {} if self.asked.step is None else self.asked.step.limits
        for name, limit in {**self.asked.limits, **{f"step.{name}": limit for name, limit in step.items()}}.items():
            if name not in seen:
                result = RequirementResult(
                    name, "", self.v.key, limit, detail=SEVERAL_ENTRIES if has_loops else NO_LOOP
                )
                yield self._judge(result, "")

    def _judged_loops(self) -> Iterator[tuple[str, str, tuple[str, ...]]]:
        """Yield the loops at wires that are judged: their keys, wires and names."""
        for key, names in self.case.names_of_loops().items():
            if self.v.is_actual or self.asked.judges(names, self.v.key):
                yield key, self.wires[key], names

    def _wires_judged(self, name: str) -> Iterator[str]:
        """Yield the wires at which the loop has a number that is limited there."""
        for key, wire, names in self._judged_loops():
            limit = self.asked.limits_of(names, self.v.key).get(name)
            mine = numbers_below(self.numbers, f"inner.{key}.{self.v.key}")
            if limit is not None and _find_worst(mine, name, limit) is not None:
                yield wire

    def _has_channels(self, key: str) -> bool:
        """Whether a loop has several channels, of which there is a disk margin alone."""
        mine = numbers_below(self.numbers, f"inner.{key}")
        return bool(mine) and not any(path.rpartition(".")[2] == "phase_margin_deg" for path in mine)

    def _is_refuted(self, key: str) -> bool:
        """Whether the injection check contradicts the linear model of a loop."""
        start = f"injection.{key}.{self.v.key}"
        found = [self.numbers.get(f"{start}.{name}") for name in ("deviation", "uncertainty")]
        worst, own = (math.nan if number is None else number.value for number in found)
        return is_refuted(worst, own)

    def _compare_other_cuts(self, result: RequirementResult) -> RequirementResult:
        """Return a result that is open where other cuts of its wire have other verdicts, and the plant may be there."""
        place = self.case.loop_places[result.loop]
        if not place.others or result.reason is not Reason.COMPARED or result.number is None:
            return result
        found = [(inputs, self.v.number_ahead(result.quantity, wire, inputs)) for wire, inputs in place.others]
        there = [(inputs, number) for inputs, number in found if number is not None]
        if all(judge(number, result.limit)[0] is result.verdict for _, number in there):
            return result
        unit = print_unit(result.unit) if result.unit else ""
        every = [(tuple(join(*to) for to in place.to), result.number), *there]
        said = ", ".join(f"{number.value:.4g}{unit} at {words_of(inputs)}" for inputs, number in every)
        return result.undecided(Reason.SEVERAL_CUTS, said)

    # --- steps --------------------------------------------------------------------------------------------------------

    def _step_of_loop(self, key: str, names: tuple[str, ...]) -> Iterator[RequirementResult]:
        """Yield the verdicts on the response to a step at a loop's own wire."""
        step = self.asked.step_of(names, self.v.key)
        if step is None or key not in self.wires:
            return
        is_general, wire = step is not self.asked.step_named(names, self.v.key), self.wires[key]
        if is_general and self.v.acts_between_ticks(wire) and self.v.loops_elsewhere(wire, self._wires_stepped(step)):
            return  # a general limit, judged at other wires of the loop
        for result in self._step(key, step, loop=key):
            yield self._compare_other_steps(result)

    def _wires_stepped(self, step: StepLimits) -> Iterator[str]:
        """Yield the wires at which there is a response to a step whose numbers are limited there, too."""
        for key, wire, names in self._judged_loops():
            own, mine = self.asked.step_of(names, self.v.key), self._numbers_of_step(key)
            if own is not None and all(name in own.limits and name in mine for name in step.limits):
                yield wire

    def _numbers_of_step(self, key: str) -> dict[str, Number]:
        return numbers_below(self.numbers, f"steps.{key}.{self.v.key}")

    def _step(self, key: str, step: StepLimits, loop: str) -> Iterator[RequirementResult]:
        """Yield the verdicts on a response to a step; its ``loop`` is empty where it leads from one wire to another."""
        start, mine = f"steps.{key}.{self.v.key}", self._numbers_of_step(key)
        place = "" if loop else f"{step.input} → {step.output}" if step.output else step.input
        for name, limit in step.limits.items():
            result = RequirementResult(f"step.{name}", loop, self.v.key, limit, reason=Reason.NOT_MEASURED, place=place)
            if name not in mine:
                if name == "peak":
                    wire = step.output or step.input or self.wires[key]
                    result = replace(result, unit=unit_at(self.v.diagram, wire))
                result = replace(result, detail=reason_of(self.absent, start))
            result = self._judge(result, f"{start}.{name}" if name in mine else "")
            result = _with_the_record(replace(result, size=mine.get("size")), mine, name)
            is_chosen = step.size is None and (result.size is None or result.size.confirmed_by == StepSize.CHOSEN)
            yield _with_the_linear_model(result, mine, name) if is_chosen else result

    def _compare_other_steps(self, result: RequirementResult) -> RequirementResult:
        """Return a result on a step at a wire that is open where the step at other cuts of it has another answer."""
        v, place = self.v, self.case.loop_places[result.loop]
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
        said = f"the answer to a step differs at {', '.join(apart)}"
        return result.undecided(Reason.SEVERAL_CUTS, said) if apart else result


def _find_worst(mine: Mapping[str, Number], name: str, limit: Limit) -> str | None:
    """Return the path of the number of a loop that is worst for a limit.

    Of a wire that is renewed several times in the period only the numbers with all loops closed count.
    """
    found = []
    for path in mine:
        first, *rest = path.split(".")
        is_crossing = first.rstrip("0123456789") in CROSSINGS
        if (
            ([first, *rest])[-1] == name
            and not is_crossing
            and first != Cut.SLOW_OPEN
            and "control" not in (first, *rest)
        ):
            found.append(path)
    return min(
        found, key=lambda path: (not math.isnan(mine[path].value), limit.distance(mine[path].value)), default=None
    )


def _with_the_record(result: RequirementResult, mine: Mapping[str, Number], name: str) -> RequirementResult:
    """Return a result on a step; one that diverges fails, and one that moves at its record's end is open."""
    if "diverges" in mine:
        since = mine["diverges"].value
        said = f"from t = {since:.4g} s after the step, where it leaves the linear model's response"
        return result.failed(Reason.DIVERGES, said)
    if not {name, "settled", "length"} <= mine.keys() or mine["settled"].value or result.reason is Reason.UNSTABLE:
        return result
    # the numbers so far are least values
    number, length = mine[name], mine["length"]
    least = length.value if math.isinf(number.value) else number.value - number.tolerance
    if not least > result.limit.high:  # NaN too: what has no value yet may come to one
        result = result.undecided(Reason.NOT_SETTLED, f"{length.value:.4g} s")
    if result.reason is Reason.NOT_SETTLED and {"limit_cycle", "limit_cycle_period"} <= mine.keys():
        cycle, period = mine["limit_cycle"], mine["limit_cycle_period"]
        unit = "" if cycle.unit == "1" else f" {cycle.unit}"
        said = f"by ± {cycle.value:.3g}{unit} with a period of {period.value:.3g} s, in a record of {result.detail}"
        return replace(result, reason=Reason.OSCILLATES, detail=said)
    return result


def _with_the_linear_model(result: RequirementResult, mine: Mapping[str, Number], name: str) -> RequirementResult:
    """Return a result on a step of no given size: it is open where run and linear model differ about the limit."""
    difference, linear = mine.get("difference"), mine.get(f"linear.{name}")
    if difference is None or linear is None or difference.value <= APART or result.reason is not Reason.COMPARED:
        return result
    if judge(linear, result.limit)[0] is result.verdict:
        return result
    said = f"{linear.value:.4g} there, and they differ by {difference.value:.2g} of the largest change"
    return result.undecided(Reason.SIZE_NOT_GIVEN, said)
