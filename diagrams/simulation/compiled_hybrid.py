"""From tick to tick in C with continuous states between them, and by Python where something is out of the ordinary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import CompilerError, LoopwrightError, SimulationError
from ..compiled import (
    USES_SLOPE,
    BackgroundCode,
    CompiledHybrid,
    HandedOver,
    HybridCode,
    HybridOutcome,
    HybridReason,
    Span,
    compile_hybrid,
    find_code_obstacle,
    find_exchange_obstacle,
    hybrid_sources,
    interpret_hybrid,
)
from ..flat import EVERY, ClockSets, FlatDiagram, is_exact, kinds_of, ticks_after
from ..results import Recorder
from .compiled_hand_over import (
    active_method,
    bind_hybrid,
    changes_method,
    describe_methods,
    end_tick,
    find_edges,
    hand_over_domains,
    let_act,
    methods_of,
    pile_up,
    planned_steps,
    restore_plans,
    take_back_domains,
    tell_fired,
)
from .compiled_plants import PlantsInC
from .compiled_ticks import FIRST, LARGEST_CHUNK, WISHED, LaterCode, tell_missing_once
from .continuous import Continuous
from .diagnosis import forget_trials
from .ticks import take_tick
from .workspace import Workspace


class HybridTicks:
    """The ticks of a run with continuous states, gone through in C.

    Parameters
    ----------
    workspace : Workspace
        The run's numbers.
    continuous : Continuous
        Its solver and events.
    plants : PlantsInC
        The plants, bound.
    stops : sequence of int
        Entries of the log that end the run where they are true.
    every : bool
        Visit every tick, not only those at which something acts.
    machine : bool, default False
        Let the virtual machine evaluate the functions.
    fuse : bool, default False
        Compile for the processor of this machine.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    """

    def __init__(
        self,
        workspace: Workspace,
        continuous: Continuous,
        plants: PlantsInC,
        stops: Sequence[int],
        *,
        every: bool,
        machine: bool = False,
        fuse: bool = False,
    ):
        flat = self._flat = workspace.flat
        self._workspace, self._continuous, self._plants = workspace, continuous, plants
        self._stops = stops
        self._methods = methods_of(continuous)
        self._acting, self._stiff = kinds_of(flat, every=every), is_stiff(continuous)
        self._code = find_code(flat, continuous, every=every, machine=machine, fuse=fuse)
        self._clocks = flat.visited if plants.entries else flat.distinct
        self._sampled = every or not self._clocks or EVERY in self._clocks
        lands = continuous.fixed or bool(plants.entries) or continuous.lands
        self._lands = lands or not self._sampled
        self._loop: CompiledHybrid | None = None
        self._recorder: Recorder | None = None
        self._chunk = FIRST
        self._handed: HandedOver | None = None

    def reaches(self, last: int) -> bool:
        """Whether times up to a tick are quotients of integers that a float64 holds."""
        return is_exact(self._flat, last)

    def hand_over(self, code: HybridCode) -> None:
        """Let generated code of the same functions go on; C must not run meanwhile."""
        self._code.hand_over(code)
        if self._loop is not None:
            self._loop.take_steps(code.steps)

    def make_later(self) -> LaterCode[HybridCode]:
        """Return generated code of these functions that is made while they are interpreted."""
        write = partial(hybrid_sources, self._flat, self._acting, stiff=self._stiff)
        return LaterCode(BackgroundCode(self._flat, write, self._plants.prepare()))

    # --- going on ----------------------------------------------------------------------------------------------------

    def run(
        self,
        k: int,
        last: int,
        recorder: Recorder,
        *,
        arrived: Callable[..., bool],
        progress: Callable[[float], Any],
    ) -> float | None:
        """Run the ticks after tick ``k`` up to ``last`` and record them; see `CompiledTicks.run`.

        Returns
        -------
        float or None
            Time in s at which a stop condition has ended the run between two ticks.
        """
        loop = self._bind(recorder)
        if k == 0:  # of a run before nothing is left
            loop.begin_anew()
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
        while rest.size or (rest := ticks_after(visited, k, last, self._chunk)).size:
            rows = recorder.room(t)
            loop.skip = recorder.skip
            started = perf_counter()
            kinds = self._kinds.at(rest)
            known = int(np.append(np.flatnonzero(kinds < 0), len(kinds))[0])
            if not known:  # sets of clocks that are too rare to have code of their own
                following = int(rest[0])
                asked = HybridOutcome(0, 0, HybridReason.ASK_BETWEEN, 0, 0, 0, t)
                ended = self._take_interval(loop, k, following, last, asked, recorder)
                if ended is not None:
                    return ended
                k, rest, t = following, rest[1:], self._time_of(following)
                if arrived(k):
                    return None
                continue
            span, lands = self._span(k, rest[:known], kinds, last, t)
            found = loop.run(span, rows)
            recorder.took(found.rows, loop.skip)
            self._tell(loop)
            if loop.ticks.calls_python:
                forget_trials(self._flat)  # an interrupt of a block of Python is raised
            t = found.t
            loop.limit_budget(perf_counter() - started)
            if self._handed is not None:
                self._handed.tell()
                if self._handed.has_news():
                    self._take_back(loop)
                    self._hand_over(loop, t)
            done, rest = rest[: found.ticks], rest[found.ticks :]
            if found.ticks:
                k = int(done[-1])
                self._plants.arrive(k, last)
                landed = np.flatnonzero(lands[: found.ticks])
                in_step = found.reason is HybridReason.FMU_FAILED
                over = landed.size and arrived(int(done[landed[-1]]), in_step)
                if over and found.reason is not HybridReason.ENDED:
                    return None
            failure = loop.take_failure()
            if failure is not None and found.reason is not HybridReason.OUTSIDE_FAILED:
                raise self._continuous.explain_failure(failure)
            if found.reason is HybridReason.ENDED:
                return t
            if found.reason is HybridReason.PILED_UP:
                self._take_back(loop)
                raise pile_up(self._continuous, loop, t)
            if found.reason is HybridReason.LOOK:
                self._take_back(loop)
                if changes_method(self._workspace, self._continuous, t, loop.looked_at()):
                    self._hand_over(loop, t)
            if found.reason in _ACTING and self._let_act(loop, found, recorder):
                return t
            if found.reason in _ASKING:
                following = int(rest[0])
                ended = self._take_interval(loop, k, following, last, found, recorder)
                if ended is not None:
                    return ended
                k, rest, t = following, rest[1:], self._time_of(following)
                if arrived(k):
                    return None
            elif perf_counter() - started < WISHED and found.ticks == len(span.widths):
                self._chunk = min(2 * self._chunk, LARGEST_CHUNK)
            progress(t)
        return None

    def _time_of(self, k: int) -> float:
        base = self._flat.base
        return k * base.numerator / base.denominator

    def _span(self, k: int, ticks: np.ndarray, kinds: np.ndarray, last: int, t: float) -> tuple[Span, np.ndarray]:
        """Return the ticks of a call, from tick ``k`` on, where the states have come to t; and which are landed on.

        ``kinds`` are the sets of clocks that act at them.
        """
        base = self._flat.base
        edges = find_edges(self._continuous, t, self._time_of(int(ticks[-1])))
        while edges is None:
            ticks = ticks[: max(1, len(ticks) // 2)]
            edges = find_edges(self._continuous, t, self._time_of(int(ticks[-1])), limited=len(ticks) > 1)
        lands = np.ones(len(ticks), dtype=np.uint8)
        if not self._lands:
            lands[:] = ticks == last
            for clock in self._clocks:
                lands |= clock.among(ticks).astype(np.uint8)
        end = int(ticks[-1])
        beyond = min([*(clock.after(end) for clock in self._clocks), last]) if not lands[-1] else end
        ends = np.concatenate([[k], ticks])
        n, d = base.numerator, base.denominator
        kinds = kinds[: len(ticks)]
        steps, then = self._plants.table(ticks, last), self._time_of(beyond)
        return Span(ends * n / d, np.diff(ends) * n / d, kinds, lands, then, *edges, steps), lands

    # --- by Python ---------------------------------------------------------------------------------------------------

    def _take_interval(
        self, loop: CompiledHybrid, k: int, following: int, last: int, found: HybridOutcome, recorder: Recorder
    ) -> float | None:
        """Go on to the next tick from the point at which the loop has returned; see `run`."""
        workspace, continuous, flat = self._workspace, self._continuous, self._flat
        self._take_back(loop)
        end, ended = self._time_of(following), None
        try:
            if found.reason is HybridReason.ASK_BETWEEN:

                def sample(t: float) -> bool:
                    recorder.row(t, workspace.log)
                    return continuous.is_stopped()

                ended = continuous.advance(found.t, end, (), sample)
                if ended is None:
                    self._plants.go(k, following, last)
            elif found.reason in (HybridReason.FMU_FAILED, HybridReason.FMU_FLAGS):
                self._plants.go_on(loop.ticks, found, k, following, last)
            elif found.reason is HybridReason.OUTSIDE_FAILED:
                assert self._handed is not None
                self._handed.judge()
            else:
                self._plants.arrive(following, last)
        except SimulationError as error:
            raise error.at(t=end) from error.__cause__
        if ended is None:
            if found.reason is HybridReason.ASK_REST:
                end_tick(workspace, continuous, loop, end, flat.acting(following))
            else:
                take_tick(workspace, continuous, self._plants.entries, end, flat.acting(following))
            self._plants.steps.hold(following)
            recorder.row(end, workspace.log)
        self._hand_over(loop, end if ended is None else ended)
        return ended

    def _let_act(self, loop: CompiledHybrid, found: HybridOutcome, recorder: Recorder) -> bool:
        """Let events beside blocks from outside act at an instant between ticks; return whether the run ends there."""
        self._take_back(loop)
        fired = None
        if found.reason is HybridReason.ASK_FIRE:
            assert loop.watch is not None
            fired = loop.watch.located.astype(bool)
        ended = let_act(self._workspace, self._continuous, found.t, loop.left, fired)
        if ended:
            recorder.row(found.t, self._workspace.log)
        self._hand_over(loop, found.t)
        return ended

    # --- between Python and C ----------------------------------------------------------------------------------------

    def _bind(self, recorder: Recorder) -> CompiledHybrid:
        if self._loop is None or recorder is not self._recorder:
            self._loop, self._handed = bind_hybrid(
                self._code, self._workspace, self._continuous, self._plants, recorder, self._stops,
                self._methods,
            )  # fmt: skip
            self._recorder = recorder
            self._kinds = ClockSets(self._flat.distinct, self._loop.kinds)
        return self._loop

    def _hand_over(self, loop: CompiledHybrid, t: float) -> None:
        """Let C go on from an instant that Python has come to."""
        loop.begin(t)
        if self._handed is not None:
            self._handed.hand_over()
            loop.set_tolerances(methods_of(self._continuous))
        loop.plan(planned_steps(self._continuous, self._methods))
        loop.active = active_method(self._continuous, self._methods)
        if loop.watch is not None:
            assert self._continuous.domains is not None
            hand_over_domains(self._continuous.domains, loop, loop.watch)
            loop.sliding = self._continuous.sliding.save()

    def _take_back(self, loop: CompiledHybrid) -> None:
        """Let Python go on from where C has come to."""
        restore_plans(self._continuous, self._methods, loop.planned)
        if self._handed is not None and self._handed.take_back():
            self._continuous.follow()
        if loop.watch is not None:
            assert self._continuous.domains is not None
            take_back_domains(self._continuous.domains, loop, loop.watch)
            self._continuous.sliding.restore(loop.sliding)

    def _tell(self, loop: CompiledHybrid) -> None:
        """Tell the events that have fired."""
        tell_fired(self._continuous, loop.take_fired())
        for t, event in () if loop.watch is None else loop.watch.take_slid():
            self._workspace.messages += self._continuous.sliding.tell(self._flat.events[event], t)


def find_code(
    flat: FlatDiagram, continuous: Continuous, *, every: bool, machine: bool, fuse: bool = False
) -> HybridCode:
    """Return the functions of a run for the virtual machine, or compiled; see `HybridTicks`."""
    acting, stiff = kinds_of(flat, every=every), is_stiff(continuous)
    if machine:
        return interpret_hybrid(flat, acting, stiff=stiff)
    return compile_hybrid(flat, acting, stiff=stiff, fuse=fuse)


def is_stiff(continuous: Continuous) -> bool:
    """Whether the solver needs the derivative of the rates."""
    return any(method.name in USES_SLOPE for method in methods_of(continuous))


_ASKING = frozenset(
    {
        HybridReason.ASK_BETWEEN,
        HybridReason.ASK_TICK,
        HybridReason.FMU_FAILED,
        HybridReason.FMU_FLAGS,
        HybridReason.NOT_OK,
        HybridReason.ASK_REST,
        HybridReason.OUTSIDE_FAILED,
    }
)
_ACTING = frozenset({HybridReason.ASK_SETTLE, HybridReason.ASK_FIRE})


def make_hybrid(
    workspace: Workspace,
    continuous: Continuous,
    plants: PlantsInC,
    stops: Sequence[int],
    *,
    every: bool,
    machine: bool = False,
    fuse: bool = False,
) -> tuple[HybridTicks | None, tuple[str, ...]]:
    """Return the ticks of a run with continuous states in C, None where they can't be had, and messages about them.

    Parameters
    ----------
    plants : PlantsInC
        The plants, bound.
    machine : bool, default False
        Let the virtual machine evaluate the functions; then nothing is said but that the library can't be had.
    fuse : bool, default False
        Compile them for the processor of this machine.
    """
    flat = workspace.flat
    reason = None if machine else find_code_obstacle(flat)
    if reason is None and continuous.exchanged is not None:
        reason = find_exchange_obstacle(continuous.exchanged.blocks)
    if plants.are_coupled:
        reason = reason or (
            "coupling= asks for another one than 'jacobi': Python takes FMUs and continuous states to the next tick"
        )
    if reason is None:
        try:
            found = HybridTicks(workspace, continuous, plants, stops, every=every, machine=machine, fuse=fuse)
        except (LoopwrightError, OSError) as error:
            if machine:
                return None, tell_missing_once(error)
            if not isinstance(error, CompilerError):
                raise
            reason = str(error)
        else:
            if machine:
                return found, ()
            told = (
                f"Compiled: {describe_methods(methods_of(continuous), continuous.solver.name)}, by the same rules as "
                "interpreted; values differ from those of an interpreted run by rounding and within the tolerances."
            )
            fused = (
                "Fused: ticks and rates are compiled for this processor; values differ by rounding, which some motions "
                "magnify."
            )
            return found, (*((told,) if continuous.where.size else ()), *((fused,) if fuse else ()))
    if machine:
        return None, ()
    return None, (f"Interpreted, though compile=True asks for C: {reason.rstrip('.')}.",)
