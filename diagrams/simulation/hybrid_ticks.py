"""The ticks of a run with continuous states, which a method integrates between them in C."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..compiled import (
    CompiledHybrid,
    DiagramCode,
    ModelExchangeHandOver,
    Outcome,
    ReturnReason,
    Sign,
    Span,
)
from ..flat import EVERY, NONE, TickPattern, ticks_after, times_of
from ..results import Recorder
from .bound_loops import bind_hybrid
from .broken_off import explain, explain_library, pile_up
from .continuous import Continuous, EdgesAhead, find_edges
from .failed_blocks import forget_trials
from .plants_in_c import PlantsInC
from .ticks_in_c import WISHED, TicksInC


class HybridTicks(TicksInC[CompiledHybrid]):
    """The ticks of a run with continuous states."""

    def __init__(
        self,
        continuous: Continuous,
        plants: PlantsInC,
        stops: Sequence[int],
        *,
        every: bool,
        machine: bool = False,
        fuse: bool = False,
    ):
        super().__init__(continuous.workspace, continuous, plants, stops, every=every, machine=machine, fuse=fuse)
        flat, self._continuous, self._is_fused = continuous.flat, continuous, fuse
        plants.turn = self._turn
        self._clocks = flat.visited if plants.entries else flat.distinct
        self._sampled = every or not self._clocks or EVERY in self._clocks
        lands = continuous.fixed or bool(plants.entries) or continuous.lands
        self._lands = lands or not self._sampled
        self._handed: ModelExchangeHandOver | None = None

    @property
    def messages(self) -> tuple[str, ...]:  # noqa: D102 - as in the base
        continuous = self._continuous
        compiled = (
            f"Compiled: {continuous.describe_methods()}, by the same rules as "
            "interpreted; values differ from those of an interpreted run by rounding and within the tolerances."
        )
        fused = (
            "Fused: ticks and rates are compiled for this processor; values differ by rounding, which some motions "
            "magnify."
        )
        return *((compiled,) if continuous.where.size else ()), *((fused,) if self._is_fused else ())

    def hand_over(self, code: DiagramCode) -> None:  # noqa: D102 - as in the base
        self._code.hand_over(code)
        if self._loop is not None:
            self._loop.take_steps(code.steps)

    # --- continuing ------------------------------------------------------------------------------------------------

    def run(  # noqa: D102 - as in the base
        self,
        k: int,
        last: int,
        recorder: Recorder,
        *,
        arrived: Callable[..., bool],
        progress: Callable[[float], Any],
    ) -> float | None:
        loop = self._bind(recorder)
        if k == 0:  # of a run before nothing is left
            loop.begin_again()
        t = self._time_of(k)
        self._hand_over(loop, t)
        try:
            return self._run(loop, k, t, last, recorder, arrived, progress)
        finally:
            self._take_back(loop)

    def _run(
        self,
        loop: CompiledHybrid,
        k: int,
        t: float,
        last: int,
        recorder: Recorder,
        arrived: Callable[..., bool],
        progress: Callable[[float], Any],
    ) -> float | None:
        visited, rest = (EVERY,) if self._sampled else self._clocks, np.zeros(0, dtype=np.int64)
        stays = False  # whether the plants have come to the next tick, by Python
        edges = EdgesAhead(self._continuous)
        while rest.size or (rest := ticks_after(visited, k, last, 1 if loop.coupled else self._chunk)).size:
            started = perf_counter()
            span, lands = self._span(k, rest, last, t, edges)
            begun = perf_counter()
            found = self._call(loop, span._replace(stays=stays), recorder)
            stays, t = False, found.t
            loop.limit_budget(perf_counter() - begun)  # of steps in C: shorter calls don't shorten what Python does
            done, rest = rest[: found.ticks], rest[found.ticks :]
            if found.ticks:
                k = int(done[-1])
                self._plants.arrive(k, last)
                landed = np.flatnonzero(lands[: found.ticks])
                in_step = found.reason is ReturnReason.FMU_FAILED
                over = landed.size and arrived(int(done[landed[-1]]), in_step)
                if over and found.reason is not ReturnReason.ENDED:
                    return None
            if found.reason is ReturnReason.ENDED:
                return t
            if found.reason in (ReturnReason.FMU_FAILED, ReturnReason.FMU_FLAGS):
                following = int(rest[0])
                self._step_plants(loop, found, k, following, last)
                if self._plants.ended is not None:
                    recorder.row(self._plants.ended, self._workspace.log)
                    return self._plants.ended
                stays = True
            elif perf_counter() - started < WISHED and found.ticks == len(span.widths):
                self._go_longer()
            progress(t)
        return None

    def _step_plants(self, loop: CompiledHybrid, found: Outcome, k: int, following: int, last: int) -> None:
        """Let Python continue with the steps of the plants."""
        try:
            self._plants.continue_steps(loop.ticks, found, k, following, last)
        except SimulationError as error:
            raise error.at(t=self._time_of(following)) from error.__cause__

    def take_first(self, t: float, acting: frozenset[TickPattern], recorder: Recorder) -> None:
        """Go through the tick with which a run begins, at t in s, with the events there, and record it."""
        loop = self._bind(recorder)
        loop.begin_again()
        self._land(loop, t, loop.kinds.get(acting, len(loop.kinds)), recorder)

    def end_between_ticks(self, k: int, end: float, recorder: Recorder) -> float | None:
        """Continue from tick ``k`` to the end of the run in s, before the next tick, and record it; see `run`."""
        loop, t = self._bind(recorder), self._time_of(k)
        ended = None if self._plants.are_coupled else self.go_between(t, end)
        if ended is None:
            ended = self._plants.end_at(end, k)
        if ended is not None:
            recorder.row(ended, self._workspace.log)
            return ended
        self._land(loop, end, loop.kinds[NONE], recorder)
        return None

    def _land(self, loop: CompiledHybrid, t: float, kind: int, recorder: Recorder) -> None:
        """Go through a tick where the run is, with the events there, and record it; no plant steps to it."""
        ends, width, kinds = np.array([t, t]), np.zeros(1), np.array([kind], dtype=np.int32)
        self._hand_over(loop, t)
        try:
            edges = find_edges(self._continuous, t, t, limited=False)
            assert edges is not None
            span = Span(ends, width, kinds, np.ones(1, dtype=np.uint8), t, *edges, self._plants.no_steps(), stays=True)
            self._call(loop, span, recorder)
        finally:
            self._take_back(loop)

    def go_between(self, t: float, end: float) -> float | None:
        """Continue from t to an instant, before any tick there; return where a stop condition ended the run."""
        # Within a step of the plants the loop waits for this, see `PlantsInC`; nothing is recorded.
        loop, none = self._loop, np.zeros((1, 0))
        assert loop is not None
        self._hand_over(loop, t)
        kinds, lands = np.zeros(1, dtype=np.int32), np.ones(1, dtype=np.uint8)
        skip, loop.skip = loop.skip, 1
        try:
            while True:
                ends, edges = np.array([t, end]), find_edges(self._continuous, t, end, limited=False)
                assert edges is not None
                found = loop.run_between(Span(ends, np.diff(ends), kinds, lands, end, *edges), none)
                self._look_at(loop, found)
                t = found.t
                if found.reason in (ReturnReason.ENDED, ReturnReason.DONE):
                    return t if found.reason is ReturnReason.ENDED else None
        finally:
            loop.skip = skip
            self._take_back(loop)

    def _call(self, loop: CompiledHybrid, span: Span, recorder: Recorder) -> Outcome:
        """Let C continue, and take note of what has happened; see `_look_at`."""
        rows = recorder.room(float(span.times[0]))
        loop.skip = recorder.skip
        found = loop.run(span, rows)
        recorder.took(found.rows, loop.skip)
        self._look_at(loop, found)
        return found

    def _look_at(self, loop: CompiledHybrid, found: Outcome) -> None:
        """Take note of what has happened."""
        loop.ticks.check()
        self._report()
        failure = loop.take_failure()
        if failure is not None and found.reason is not ReturnReason.OUTSIDE_FAILED:
            raise explain_library(self._continuous, failure)
        if found.reason is ReturnReason.BROKEN_OFF:
            raise explain(self._continuous, loop.broken_off())
        if loop.ticks.calls_python:
            forget_trials(self._flat)  # an interrupt of a block of Python is raised
        if found.reason is ReturnReason.OUTSIDE_FAILED:
            assert self._handed is not None
            self._handed.judge()
        if found.reason is ReturnReason.PILED_UP:
            self._take_back(loop)
            raise pile_up(self._continuous, loop, found.t)
        if self._handed is not None and self._handed.has_news():
            self._take_back(loop)
            self._hand_over(loop, found.t)
        if found.reason is ReturnReason.LOOK:
            self._take_back(loop)
            self._choose_method(found.t, *loop.take_sign())
            self._hand_over(loop, found.t)

    def _choose_method(self, t: float, sign: Sign, h: float) -> None:
        """Decide, after a sign at steps of h in s, whether another method continues from t."""
        continuous, workspace = self._continuous, self._workspace
        continuous.stand_in(math.inf, math.inf)
        x = workspace.here.x[continuous.where]
        workspace.messages += continuous.method.decide(t, x, h, stuck=sign is Sign.STUCK)

    def _time_of(self, k: int) -> float:
        return float(k * self._flat.base)

    def _span(self, k: int, ticks: np.ndarray, last: int, t: float, ahead: EdgesAhead) -> tuple[Span, np.ndarray]:
        """Return the ticks of a call, from tick ``k`` on, where the states have come to t; and which are landed on."""
        edges = ahead.until(t, self._time_of(int(ticks[-1])), limited=len(ticks) > 1)
        while edges is None:
            ticks = ticks[: max(1, len(ticks) // 2)]
            edges = ahead.until(t, self._time_of(int(ticks[-1])), limited=len(ticks) > 1)
        lands = np.ones(len(ticks), dtype=np.uint8)
        if not self._lands:
            lands[:] = ticks == last
            for clock in self._clocks:
                lands |= clock.among(ticks).astype(np.uint8)
        end = int(ticks[-1])
        beyond = min([*(clock.after(end) for clock in self._clocks), last]) if not lands[-1] else end
        ends = np.concatenate([[k], ticks])
        steps, then = self._plants.table(ticks, last), self._time_of(beyond)
        times, widths = times_of(self._flat, ends), times_of(self._flat, np.diff(ends))
        return Span(times, widths, self._kinds.at(ticks), lands, then, *edges, steps), lands

    # --- between Python and C ----------------------------------------------------------------------------------------

    def _bind_loop(self, recorder: Recorder) -> CompiledHybrid:
        continuous, plants = self._continuous, self._plants
        blocks, own = continuous.exchanged, continuous.own_events
        # Blocks in model exchange and their own events come together, or neither is there.
        self._handed = (
            None
            if blocks is None or own is None
            else ModelExchangeHandOver(
                self._flat,
                blocks.blocks,
                blocks.evaluators,
                lambda event: continuous.report_own_event(*event),
                own.count,
            )
        )
        native = None if self._handed is None else self._handed.native
        return bind_hybrid(
            continuous,
            self._code,
            self._bind_ticks(recorder, native),
            exchange=native,
            plants=bool(plants.entries),
            drain=self._report,
            coupled=plants.are_coupled,
        )

    @contextmanager
    def _turn(self, end: float) -> Iterator[None]:
        """Let Python take the plants, and the continuous states within their step, to a time in s, while C waits."""
        assert self._loop is not None
        self._take_back(self._loop)
        yield
        self._hand_over(self._loop, end)

    def _hand_over(self, loop: CompiledHybrid, t: float) -> None:
        """Let C continue from an instant that Python has come to."""
        continuous, method = self._continuous, self._continuous.method
        loop.begin(t)
        if self._handed is not None:
            self._handed.hand_over()
            loop.set_tolerances(continuous.methods)
        loop.plan([*method.planned.values()])
        loop.active = method.names.index(method.active) if continuous.where.size else 0
        if continuous.domains is not None:
            loop.hand_over_domains(continuous.domains)

    def _take_back(self, loop: CompiledHybrid) -> None:
        """Let Python continue from where C has come to."""
        continuous, method = self._continuous, self._continuous.method
        method.planned = dict(zip(method.names, loop.planned, strict=True))
        if self._handed is not None and self._handed.take_back():
            continuous.follow()
        if continuous.domains is not None:
            loop.take_back_domains(continuous.domains)

    def _report(self) -> None:
        """Report what has happened in C: events that have fired, and those of blocks in model exchange."""
        loop, continuous = self._loop, self._continuous
        assert loop is not None
        for fired in loop.take_fired():
            continuous.report_event(fired.t, fired.event, fired.before, fired.after)
        if self._handed is not None:
            self._handed.report()
        for t, event in () if loop.watch is None else loop.watch.take_slid():
            assert continuous.domains is not None
            self._workspace.messages += continuous.domains.report_sliding(t, event)
