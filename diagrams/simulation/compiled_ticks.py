"""From tick to tick in C, and by Python where something is out of the ordinary."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import LoopwrightError, SimulationError
from ...fmus.calls import FmuInstance
from ..compiled import (
    BackgroundCode,
    CompiledLoop,
    DiagramCode,
    FusedPlant,
    Outcome,
    ReturnReason,
    bind_call,
    code_sources,
    compile_code,
    compile_fused,
    interpret_code,
)
from ..flat import (
    EVERY,
    ClockSets,
    FlatDiagram,
    TickPattern,
    kinds_of,
    ticks_after,
    times_of,
)
from ..results import Recorder
from .compiled_hand_over import bind_loop
from .compiled_plants import PlantsInC
from .failed_blocks import forget_trials
from .workspace import Workspace

if TYPE_CHECKING:
    from ...fmus.running import Fmu

FIRST, LARGEST_CHUNK = 64, 2**15
"""Ticks of a chunk: the first one, and at most, so that lists of them stay in the processor's cache."""
WISHED = 0.05
"""Seconds that a chunk takes, half or double; Ctrl-C and the progress bar have their turn after it."""
_WINDOW, _FEW = 2**14, 16
"""Ticks whose times are computed at a time, at most; so many are computed without arrays, whose set-up takes longer."""
_RK4 = 1  # the integrator of exported FMUs that is compiled into a fused loop
_SIGNS = (
    "Compiled: it has tables or large matrix products, in which signs of zeros may differ from those of an interpreted "
    "run."
)


@dataclass(frozen=True, eq=False)
class _Window:
    """Some ticks after tick ``before``: the time of that and of each in s, their lengths in s, and their kinds."""

    before: int
    ticks: Sequence[int] | np.ndarray
    times: np.ndarray
    widths: np.ndarray
    kinds: np.ndarray
    unknown: Sequence[int] | np.ndarray
    """Places of the ticks at which clocks act together for which there is no code."""

    def known(self, start: int, stop: int) -> int:
        """Return the end of the ticks from a place on for which there is code, at most ``stop``."""
        stop = min(stop, len(self.kinds))
        if not len(self.unknown):
            return stop
        next_one = int(np.searchsorted(self.unknown, start))
        return stop if next_one == len(self.unknown) else min(stop, int(self.unknown[next_one]))


class CompiledTicks:
    """The ticks of a run, gone through in C."""

    def __init__(
        self,
        workspace: Workspace,
        plants: PlantsInC,
        stops: Sequence[int],  # entries of the log that end the run where they are true
        *,
        every: bool,  # visit every tick, not only those at which a subsystem acts
        machine: bool = False,  # the virtual machine evaluates the functions, and no compiler is needed
        fuse: bool = False,  # compile ticks and plants of our own together, for the processor of this machine
    ):
        flat = self._flat = workspace.flat
        self._workspace, self._plants, self._every, self._stops = workspace, plants, every, stops
        acting = kinds_of(flat, every=every)
        if machine:
            self._code = interpret_code(flat, acting)
        else:
            self._code = _fuse(flat, plants, acting) if fuse else compile_code(flat, acting)
        self._loop: CompiledLoop | None = None
        self._recorder: Recorder | None = None
        self._numbers = {clocks: kind for kind, clocks in enumerate(self._code.ticks)}
        self._kinds = ClockSets(flat.distinct, self._numbers)
        self._chunk = FIRST
        self._first: _Window | None = None
        self._last = 0

    @property
    def messages(self) -> tuple[str, ...]:
        """How far results may differ from those of an interpreted run; empty where every bit is the same."""
        return self._code.notes + (() if self._code.exact else (_SIGNS,))

    def hand_over(self, code: DiagramCode) -> None:
        """Let generated code of the same ticks continue; C must not run meanwhile."""
        self._code, self._loop = code, None

    def make_later(self) -> BackgroundCode:
        """Return generated code of these ticks that is made while they are interpreted."""
        write = partial(code_sources, self._flat, [*self._code.ticks])
        return BackgroundCode(self._flat, write, self._plants.prepare())

    def run(
        self,
        k: int,
        last: int,
        recorder: Recorder,
        *,
        arrived: Callable[..., bool],  # takes a tick, and whether plants are in the next step; returns: the run ends
        progress: Callable[[float], Any],
    ) -> None:
        """Run the ticks after tick ``k`` up to ``last`` and record them."""
        for window in self._windows(k, last):
            if self._run_window(window, last, recorder, arrived, progress):
                return

    def _run_window(
        self,
        window: _Window,
        last: int,
        recorder: Recorder,
        arrived: Callable[..., bool],
        progress: Callable[[float], Any],
    ) -> bool:
        """Run some ticks; return whether the run ends there."""
        at, k = 0, window.before
        table = self._plants.table(np.asarray(window.ticks), last)
        while at < len(window.kinds):
            loop = self._bind(recorder)  # generated code may have come
            rows = recorder.room(float(window.times[at]))
            loop.skip = recorder.skip
            stop = window.known(at, min(at + self._chunk, at + recorder.skip + (len(rows) - 1) * recorder.every + 1))
            started = perf_counter()
            steps = None if table is None else table.part(at, stop)
            found = loop.run(window.times[at : stop + 1], window.widths[at:stop], window.kinds[at:stop], rows, steps)
            recorder.took(found.rows, loop.skip)
            loop.check()
            at += found.ticks
            if found.ticks:
                k = int(window.ticks[at - 1])
                self._plants.arrive(k, last)
                if arrived(k, found.reason is ReturnReason.FMU_FAILED):
                    return True
            if found.reason is ReturnReason.HALTED and found.ticks:
                self._chunk = max(1, self._chunk // 2)
            elif at < stop or not found.ticks:  # Python looks at this tick
                following = int(window.ticks[at])
                self._take_tick(k, following, last, found, recorder)
                k, at = following, at + 1
                if arrived(k):
                    return True
            elif (took := perf_counter() - started) < WISHED:
                self._chunk = min(2 * self._chunk, LARGEST_CHUNK)
            elif took > 2 * WISHED:
                self._chunk = max(1, self._chunk // 2)
            progress(float(window.times[at]))
        return False

    def _windows(self, k: int, last: int) -> Iterator[_Window]:
        """Yield the ticks after tick ``k`` up to ``last``; the first ones are kept for the next run."""
        if self._first is None or (self._first.before, self._last) != (k, last):
            self._first, self._last = self._window(k, last), last
        yield self._first
        k = int(self._first.ticks[-1])
        while k < last:
            window = self._window(k, last)
            yield window
            k = int(window.ticks[-1])

    def _window(self, k: int, last: int) -> _Window:
        flat = self._flat
        n, d = flat.base.numerator, flat.base.denominator
        if last - k <= _FEW:
            few = [*flat.ticks(k, last, every=self._every)]
            numbers = [self._numbers.get(flat.acting(tick), -1) for tick in few]
            widths = [(b - a) * n / d for a, b in pairwise([k, *few])]
            missing = [i for i, number in enumerate(numbers) if number < 0]
            times = [tick * n / d for tick in (k, *few)]
            return _Window(k, few, np.array(times), np.array(widths), np.array(numbers, dtype=np.int32), missing)
        ticks = ticks_after((EVERY,) if self._every else flat.visited, k, last, _WINDOW)
        ends = np.concatenate([[k], ticks])
        kinds = self._kinds.at(ticks)
        unknown = np.flatnonzero(kinds < 0)
        return _Window(k, ticks, times_of(flat, ends), times_of(flat, np.diff(ends)), kinds, unknown)

    def prepare(self, recorder: Recorder) -> None:
        """Bind the loop before its first tick."""
        self._bind(recorder)

    def _bind(self, recorder: Recorder) -> CompiledLoop:
        if self._loop is None or recorder is not self._recorder:
            self._recorder = recorder
            self._loop = bind_loop(self._workspace, self._plants, self._code, recorder, self._stops)
        return self._loop

    def _take_tick(self, before: int, k: int, last: int, found: Outcome, recorder: Recorder) -> None:
        """Go through a tick at which the loop has returned: from the call on that it could not go beyond."""
        workspace, base = self._workspace, self._flat.base
        t = k * base.numerator / base.denominator
        try:
            if found.reason is ReturnReason.NOT_OK:
                self._plants.arrive(k, last)
                forget_trials(self._flat)  # an interrupt of a block of Python is raised
            elif found.reason in (ReturnReason.FMU_FAILED, ReturnReason.FMU_FLAGS):
                assert self._loop is not None
                self._plants.continue_steps(self._loop, found, before, k, last)
            else:
                self._plants.go(before, k, last)
        except SimulationError as error:
            raise error.at(t=t) from error.__cause__
        workspace.here.t[0] = t
        workspace.tick(self._flat.acting(k))
        self._plants.steps.hold(k)
        recorder.row(t, workspace.log)


def bind_evaluations(
    workspace: Workspace, find_code: Callable[[], DiagramCode]
) -> dict[frozenset[TickPattern], Callable[[], None]]:
    """Return the evaluations of ticks in C, with the bits of interpreted ones; empty where they can't be had."""
    # The functions of a large diagram take seconds to trace as a whole, and calls of its blocks need none of them.
    flat, here = workspace.flat, workspace.here
    if flat.loops.slices or flat.in_model_exchange:
        return {}
    try:
        code = find_code()
    except LoopwrightError:  # the start is then evaluated by Python; `Engine` reports the obstacle
        return {}
    results = [workspace.x_next, workspace.z, workspace.log, workspace.ok]
    vectors = [here.t, here.x, here.w, here.p]
    return {clocks: bind_call(tick, vectors, results) for clocks, tick in code.ticks.items()} if code.exact else {}


def _fuse(flat: FlatDiagram, plants: PlantsInC, acting: Sequence[frozenset[TickPattern]]) -> DiagramCode:
    from ...fmus.running import Fmu  # only such a run needs the block

    found = {}
    for path, plant in plants.entries.items():
        step = plant.native if isinstance(plant, FmuInstance) else None
        if step is None:
            found[path] = FusedPlant(None, (), ())
            continue
        block = flat.table.blocks[path]
        assert isinstance(block, Fmu)
        file = block.description.file if _is_plain(block) else None
        to, of = (() if ports is None else ports.read_references() for ports in (step.inputs, step.outputs))
        found[path] = FusedPlant(file, to, of)
    return compile_fused(flat, acting, found)


def _is_plain(block: Fmu) -> bool:
    """Whether a step of an FMU is one of classical Runge-Kutta steps between inputs and outputs."""
    declared = block.description.variables.get("integrator")
    integrator = block.start.get("integrator", None if declared is None else declared.start)
    ports = [*block.input_variables.values(), *block.output_variables.values()]
    return integrator == _RK4 and all(v.causality in ("input", "output") for v in ports)
