"""From tick to tick in C with continuous states between them, and by Python where something is out of the ordinary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import CompilerError, LoopwrightError, SimulationError
from ...fmus.calls import FmuInstance
from ..compiled import (
    BackgroundCode,
    CompiledHybrid,
    Fired,
    HandedOver,
    HybridCode,
    HybridOutcome,
    HybridReason,
    Span,
    compile_hybrid,
    find_exchange_obstacle,
    find_hybrid_obstacle,
    hybrid_sources,
    interpret_hybrid,
)
from ..coupling import Plant, PlantSteps
from ..flat import EVERY, ClockSets, is_exact, kinds_of, ticks_after
from ..results import Recorder
from .compiled_hand_over import (
    active_method,
    bind_hybrid,
    changes_method,
    end_steps,
    end_tick,
    find_edges,
    hand_over_domains,
    is_held,
    let_act,
    methods_of,
    name_methods,
    planned_steps,
    plants_for_c,
    prepare,
    restore_plans,
    take_back_domains,
    tell_fired,
)
from .compiled_ticks import (
    FIRST,
    LARGEST_CHUNK,
    WISHED,
    LaterCode,
    find_obstacle_at_ticks,
    tell_failure_once,
)
from .continuous import Continuous
from .ticks import take_tick
from .workspace import Workspace

_KEPT = 5000  # events of which the limits may ask


class HybridTicks:
    """The ticks of a run with continuous states, gone through in C.

    Parameters
    ----------
    workspace : Workspace
        The run's numbers.
    continuous : Continuous
        Its solver and events.
    plants : mapping of str to FmuInstance
        The plants by path, bound.
    steps : PlantSteps
        Their steps, as Python takes them.
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
        plants: Mapping[str, FmuInstance],
        steps: PlantSteps,
        stops: Sequence[int],
        *,
        every: bool,
        machine: bool = False,
        fuse: bool = False,
    ):
        flat = self._flat = workspace.flat
        self._workspace, self._continuous, self._plants, self._steps = workspace, continuous, plants, steps
        self._stops = stops
        self._methods = methods_of(continuous)
        self._stiff = any(method.name == "Radau" for method in self._methods)
        self._acting = kinds_of(flat, every=every)
        self._code = (
            interpret_hybrid(flat, self._acting, stiff=self._stiff)
            if machine
            else compile_hybrid(flat, self._acting, stiff=self._stiff, fuse=fuse)
        )
        self._clocks = flat.visited if plants else flat.distinct
        self._sampled = every or not self._clocks or EVERY in self._clocks
        lands = continuous.fixed or bool(plants) or continuous.lands
        self._lands = lands or not self._sampled
        self._loop: CompiledHybrid | None = None
        self._recorder: Recorder | None = None
        self._chunk = FIRST
        self.start: float | None = None
        """Time in s after a tick that interpreted steps have come to, if C begins there."""
        self._fired: list[Fired] = []
        self._handed: HandedOver | None = None

    @property
    def solver(self) -> str:
        """The methods in words."""
        return name_methods(self._methods)

    def reaches(self, last: int) -> bool:
        """Whether times up to a tick are quotients of integers that a float64 holds."""
        return is_exact(self._flat, last)

    def hand_over(self, code: HybridCode) -> None:
        """Let generated code of the same functions go on; C must not run meanwhile."""
        self._code.hand_over(code)
        if self._loop is not None:
            self._loop.take_steps(code.steps)

    def make_later(self) -> LaterCode[HybridCode] | None:
        """Return generated code of these functions that is made while they are interpreted."""
        write = partial(hybrid_sources, self._flat, self._acting, stiff=self._stiff)
        return LaterCode(BackgroundCode(self._flat, write, prepare(self._plants)))

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
            self._fired = []
            loop.begin_anew()
        t, self.start = self._time_of(k) if self.start is None else self.start, None
        while self._sampled and self._time_of(k + 1) <= t:
            k += 1
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
            if is_held(self._continuous):
                following = int(rest[0])
                asked = HybridOutcome(0, 0, HybridReason.ASK_BETWEEN, 0, 0, 0, t)
                ended = self._take_interval(loop, k, following, last, asked, recorder)
                if ended is not None:
                    return ended
                k, rest, t = following, rest[1:], self._time_of(following)
                if arrived(k):
                    return None
                continue
            span, lands = self._span(k, rest, last, t)
            found = loop.run(span, rows)
            recorder.took(found.rows, loop.skip)
            self._tell(loop)
            t = found.t
            if self._handed is not None:
                loop.limit_budget(perf_counter() - started)
                self._handed.tell()
                if self._handed.has_news():
                    self._take_back(loop)
                    self._hand_over(loop, t)
            done, rest = rest[: found.ticks], rest[found.ticks :]
            if found.ticks:
                k = int(done[-1])
                landed = np.flatnonzero(lands[: found.ticks])
                in_step = found.reason is HybridReason.FMU_FAILED
                over = landed.size and arrived(int(done[landed[-1]]), in_step)
                if over and found.reason is not HybridReason.ENDED:
                    return None
            if found.reason is HybridReason.ENDED:
                return t
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

    def _span(self, k: int, ticks: np.ndarray, last: int, t: float) -> tuple[Span, np.ndarray]:
        """Return the ticks of a call, from tick ``k`` on, where the states have come to t; and which are landed on."""
        base = self._flat.base
        edges = find_edges(self._continuous, t, self._time_of(int(ticks[-1])))
        while edges is None:
            ticks = ticks[: max(1, len(ticks) // 2)]
            edges = find_edges(self._continuous, t, self._time_of(int(ticks[-1])), limited=len(ticks) > 1)
        kinds = self._kinds.at(ticks)
        lands = np.ones(len(ticks), dtype=np.uint8)
        if not self._lands:
            lands[:] = ticks == last
            for clock in self._clocks:
                lands |= clock.among(ticks).astype(np.uint8)
        end = int(ticks[-1])
        beyond = min([*(clock.after(end) for clock in self._clocks), last]) if not lands[-1] else end
        ends = np.concatenate([[k], ticks])
        n, d = base.numerator, base.denominator
        return Span(ends * n / d, np.diff(ends) * n / d, kinds, lands, self._time_of(beyond), *edges), lands

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
                    self._steps.go(k, following, last=following == last)
            elif found.reason in (HybridReason.FMU_FAILED, HybridReason.FMU_FLAGS):
                self._judge(found, self._time_of(k), float(flat.base * (following - k)))
            elif found.reason is HybridReason.OUTSIDE_FAILED and self._handed is not None:
                self._handed.judge()
        except SimulationError as error:
            raise error.at(t=end) from error.__cause__
        if ended is None:
            if found.reason is HybridReason.ASK_REST:
                end_tick(workspace, continuous, loop, end, flat.acting(following))
            else:
                take_tick(workspace, continuous, self._plants, end, flat.acting(following))
            self._steps.hold(following)
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

    def _judge(self, found: HybridOutcome, now: float, h: float) -> None:
        """Go on from the call of an FMU that the loop could not go beyond."""
        status = found.status if found.reason is HybridReason.FMU_FAILED else 0
        assert self._loop is not None
        end_steps(self._loop.ticks, [*self._plants.values()], found.plant, found.stage, status, now, h)

    # --- between Python and C ----------------------------------------------------------------------------------------

    def _bind(self, recorder: Recorder) -> CompiledHybrid:
        if self._loop is None or recorder is not self._recorder:
            self._loop, self._handed = bind_hybrid(
                self._code, self._workspace, self._continuous, self._plants.values(), self._steps, recorder,
                self._stops, self._methods,
            )  # fmt: skip
            self._recorder = recorder
            self._kinds = ClockSets(self._flat.distinct, self._loop.kinds, other=0)
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
            loop.hand_over_recent(hand_over_domains(self._continuous.domains, loop.watch))

    def _take_back(self, loop: CompiledHybrid) -> None:
        """Let Python go on from where C has come to."""
        restore_plans(self._continuous, self._methods, loop.planned)
        if self._handed is not None and self._handed.take_back():
            self._continuous.follow()
        if loop.watch is not None:
            assert self._continuous.domains is not None
            take_back_domains(self._continuous.domains, loop.watch, self._fired)
            self._fired = []

    def _tell(self, loop: CompiledHybrid) -> None:
        """Tell the events that have fired."""
        fired = loop.take_fired()
        self._fired = [*self._fired, *fired][-_KEPT:]
        tell_fired(self._continuous, fired)


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
    plants: Mapping[str, Plant],
    steps: PlantSteps,
    stops: Sequence[int],
    *,
    every: bool,
    coupled: bool,
    asked: bool = True,
    machine: bool = False,
    fuse: bool = False,
) -> tuple[HybridTicks | None, tuple[str, ...]]:
    """Return the ticks of a run with continuous states in C, None where they can't be had, and messages about them.

    Parameters
    ----------
    coupled : bool
        Whether another coupling than "jacobi" is asked for.
    asked : bool
        Whether the user asks for C, by ``compile=True``; else a compiler that fails is told once, and nothing else.
    fuse : bool, default False
        Compile them for the processor of this machine.
    """
    native = plants_for_c(plants)
    reason = find_hybrid_obstacle(workspace.flat, continuous.solver.name)
    if reason is None and continuous.exchanged is not None:
        blocks = continuous.exchanged.blocks
        reason = find_exchange_obstacle(blocks)
        if machine and any(getattr(block, "native_host", None) is not None for block in blocks.values()):
            return None, ()  # Python sets traps of such a library back after every call, C after several
    reason = reason or find_obstacle_at_ticks(workspace.flat, plants, native, steps, coupled=coupled)
    if reason is None:
        try:
            found = HybridTicks(workspace, continuous, native, steps, stops, every=every, machine=machine, fuse=fuse)
        except (LoopwrightError, OSError) as error:
            if machine:
                return None, ()
            if not asked:
                return None, tell_failure_once(error)
            if not isinstance(error, CompilerError):
                raise
            reason = str(error)
        else:
            if machine:
                return found, ()
            told = (
                f"Compiled: {found.solver} runs in C as solver={continuous.solver.name!r}, by the same rules as "
                "interpreted; values differ from those of an interpreted run by rounding and within the tolerances."
            )
            fused = (
                "Fused: ticks and rates are compiled for this processor; values differ by rounding, which some motions "
                "magnify."
            )
            return found, (*((told,) if continuous.where.size and asked else ()), *((fused,) if fuse else ()))
    if not asked:
        return None, ()
    return None, (f"Interpreted, though compile=True asks for C: {reason.rstrip('.')}.",)
