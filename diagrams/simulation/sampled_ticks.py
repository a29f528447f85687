"""The ticks of a run without continuous states: in C, and by Python where something is out of the ordinary."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import SimulationError
from ...fmus.calls import FmuInstance
from ..compiled import (
    CompiledLoop,
    DiagramCode,
    FusedPlant,
    Outcome,
    ReturnReason,
    compile_fused,
)
from ..flat import (
    EVERY,
    FlatDiagram,
    ticks_after,
    times_of,
)
from ..results import Recorder
from .failed_blocks import forget_trials
from .plants_in_c import PlantsInC
from .ticks_in_c import WISHED, TicksInC
from .workspace import Workspace

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu

_WINDOW, _FEW = 2**14, 16
"""Ticks whose times are computed at a time, at most; so many are computed without arrays, whose set-up takes longer."""
_RK4 = 1  # the integrator of exported FMUs that is compiled into a fused loop
_FOR_PYTHON = (ReturnReason.NOT_OK, ReturnReason.FMU_FAILED, ReturnReason.FMU_FLAGS)
"""Reasons for which Python looks at a tick."""
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


class SampledTicks(TicksInC[CompiledLoop]):
    """The ticks of a run without continuous states."""

    def __init__(
        self,
        workspace: Workspace,
        plants: PlantsInC,
        stops: Sequence[int],
        *,
        every: bool,
        machine: bool = False,
        fuse: bool = False,  # compile ticks and plants of our own together
    ):
        super().__init__(workspace, None, plants, stops, every=every, machine=machine, fuse=fuse)
        self._every = every
        self._first: _Window | None = None
        self._last = 0

    def _find_code(self, *, machine: bool, fuse: bool) -> DiagramCode:
        if not fuse:
            return super()._find_code(machine=machine, fuse=False)
        return compile_fused(self._flat, self._acting, _find_fused(self._flat, self._plants))

    @property
    def messages(self) -> tuple[str, ...]:  # noqa: D102 - as in the base
        return self._code.notes + (() if self._code.exact else (_SIGNS,))

    def hand_over(self, code: DiagramCode) -> None:  # noqa: D102 - as in the base
        self._code, self._loop = code, None

    def run(  # noqa: D102 - as in the base
        self,
        k: int,
        last: int,
        recorder: Recorder,
        *,
        arrived: Callable[..., bool],
        progress: Callable[[float], Any],
    ) -> None:
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
            room = recorder.skip + (len(rows) - 1) * recorder.every + 1
            stop = min(at + self._chunk, at + room, len(window.kinds))
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
            if found.reason in _FOR_PYTHON:
                following = int(window.ticks[at])
                self._take_tick(k, following, last, found, recorder)
                k, at = following, at + 1
                if arrived(k):
                    return True
            elif (took := perf_counter() - started) > 2 * WISHED or found.reason is ReturnReason.HALTED:
                self._chunk = max(1, self._chunk // 2)
            elif took < WISHED:
                self._go_longer()
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
            numbers = [self._numbers.get(flat.acting(tick), len(self._numbers)) for tick in few]
            widths = [(b - a) * n / d for a, b in pairwise([k, *few])]
            times = [tick * n / d for tick in (k, *few)]
            return _Window(k, few, np.array(times), np.array(widths), np.array(numbers, dtype=np.int32))
        ticks = ticks_after((EVERY,) if self._every else flat.visited, k, last, _WINDOW)
        ends = np.concatenate([[k], ticks])
        return _Window(k, ticks, times_of(flat, ends), times_of(flat, np.diff(ends)), self._kinds.at(ticks))

    def _bind_loop(self, recorder: Recorder) -> CompiledLoop:
        return self._bind_ticks(recorder)

    def _take_tick(self, before: int, k: int, last: int, found: Outcome, recorder: Recorder) -> None:
        """Go through a tick at which the loop has returned: from the call on that it could not go beyond."""
        workspace, base = self._workspace, self._flat.base
        t = k * base.numerator / base.denominator
        assert self._loop is not None
        try:
            if found.reason is ReturnReason.NOT_OK:
                self._plants.arrive(k, last)
                forget_trials(self._flat)  # an interrupt of a block of Python is raised
            else:
                self._plants.continue_steps(self._loop, found, before, k, last)
        except SimulationError as error:
            raise error.at(t=t) from error.__cause__
        workspace.here.t[0] = t
        workspace.tick(self._flat.acting(k))
        self._plants.steps.hold(k)
        recorder.row(t, workspace.log)


def _find_fused(flat: FlatDiagram, plants: PlantsInC) -> dict[str, FusedPlant]:
    """Return by path how a fused loop steps each plant: by the equations of its FMU, or by the FMU's functions."""
    from ...fmus.fmu_block import Fmu  # only such a run needs the block

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
    return found


def _is_plain(block: Fmu) -> bool:
    """Whether a step of an FMU is one of classical Runge-Kutta steps between inputs and outputs."""
    declared = block.description.variables.get("integrator")
    integrator = block.start.get("integrator", None if declared is None else declared.start)
    ports = [*block.input_variables.values(), *block.output_variables.values()]
    return integrator == _RK4 and all(v.causality in ("input", "output") for v in ports)
