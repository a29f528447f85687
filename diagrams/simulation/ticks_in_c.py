"""The ticks of a run in C: what runs with continuous states and without them share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

from ...blocks.core import SimulationError
from ..compiled import (
    BackgroundCode,
    CompiledHybrid,
    CompiledLoop,
    DiagramCode,
    NativeModelExchange,
    code_sources,
    compile_code,
    functions_between,
    interpret_code,
)
from ..flat import ClockSets, FlatDiagram, TickPattern, kinds_of
from ..results import Recorder
from .bound_loops import bind_ticks
from .continuous import Continuous
from .plants_in_c import PlantsInC
from .workspace import Workspace

FIRST, LARGEST_CHUNK = 64, 2**15
"""Ticks of a chunk: the first one, and at most, so that lists of them stay in the processor's cache."""
WISHED = 0.05
"""Seconds that a chunk takes, half or double; Ctrl-C and the progress bar have their turn after it."""

Loop = TypeVar("Loop", CompiledLoop, CompiledHybrid)


class TicksInC(ABC, Generic[Loop]):
    """The ticks of a run: their code, and the loop in C that is bound to it and to the run's numbers."""

    def __init__(
        self,
        workspace: Workspace,
        continuous: Continuous | None,
        plants: PlantsInC,
        stops: Sequence[int],  # entries of the log that end the run where they are true
        *,
        every: bool,  # visit every tick, not only those at which something acts
        machine: bool,  # the virtual machine evaluates the functions, and no compiler is needed
        fuse: bool,  # compile for the processor of this machine
    ):
        flat = self._flat = workspace.flat
        self._workspace, self._plants, self._stops = workspace, plants, stops
        self._acting, self._between = functions_of(flat, continuous, every=every)
        self._code = self._find_code(machine=machine, fuse=fuse and not machine)
        self._numbers = {clocks: kind for kind, clocks in enumerate(self._code.ticks)}
        self._kinds = ClockSets(flat.distinct, self._numbers, len(self._numbers))
        self._loop: Loop | None = None
        self._recorder: Recorder | None = None
        self._chunk = FIRST

    def _find_code(self, *, machine: bool, fuse: bool) -> DiagramCode:
        return find_code(self._flat, self._acting, self._between, machine=machine, fuse=fuse)

    @property
    @abstractmethod
    def messages(self) -> tuple[str, ...]:
        """How far results may differ from those of an interpreted run; empty where every bit is the same."""

    def make_later(self) -> BackgroundCode:
        """Return generated code of the same functions that is made while they are interpreted."""
        write = partial(code_sources, self._flat, self._acting, self._between)
        return BackgroundCode(self._flat, write, self._plants.prepare())

    @abstractmethod
    def hand_over(self, code: DiagramCode) -> None:
        """Let generated code of the same functions continue; C must not run meanwhile."""

    @abstractmethod
    def run(
        self,
        k: int,
        last: int,
        recorder: Recorder,
        *,
        arrived: Callable[..., bool],  # takes a tick, and whether plants are in the next step; returns: the run ends
        progress: Callable[[float], Any],
    ) -> float | None:
        """Run the ticks after tick ``k`` up to ``last`` and record them.

        Returns the time in s at which a stop condition ended the run between two ticks; None without that.
        """

    def prepare(self, recorder: Recorder) -> None:
        """Bind the loop before its first tick."""
        self._bind(recorder)

    def _bind(self, recorder: Recorder) -> Loop:
        if self._loop is None or recorder is not self._recorder:
            self._loop, self._recorder = self._bind_loop(recorder), recorder
        return self._loop

    @abstractmethod
    def _bind_loop(self, recorder: Recorder) -> Loop:
        """Return the loop, bound to the samples that a recorder keeps."""

    def _bind_ticks(self, recorder: Recorder, exchange: NativeModelExchange | None = None) -> CompiledLoop:
        entries = recorder.entries
        return bind_ticks(
            self._workspace,
            self._code,
            [*self._plants.entries.values()],
            columns=entries,
            width=self._workspace.log.size if entries is None else len(entries),
            every=recorder.every,
            stops=self._stops,
            exchange=exchange,
            held=self._plants.held,
            inputs=self._plants.inputs,
            rest=self._take_rare_tick,
        )

    def _take_rare_tick(self) -> int:
        """Evaluate a tick for C at which clocks act together too seldom for generated code; return 1 where it fails."""
        acting = self._flat.acting(round(float(self._workspace.here.t[0]) / self._flat.base))
        try:
            self._workspace.evaluate(acting)
        except SimulationError:  # raised where the loop breaks off
            return 1
        if isinstance(self._loop, CompiledHybrid):
            self._loop.note_taken(self._flat.taken_at(acting))
        return 0

    def _go_longer(self) -> None:
        """Let the next chunks have more ticks, as this one was short in time."""
        self._chunk = min(2 * self._chunk, LARGEST_CHUNK)


def functions_of(
    flat: FlatDiagram, continuous: Continuous | None, *, every: bool
) -> tuple[list[frozenset[TickPattern]], tuple[str, ...]]:
    """Return the functions of a run: the sets of clocks of its ticks, and the names of those between them."""
    between = () if continuous is None else functions_between(flat, stiff=continuous.is_stiff)
    return kinds_of(flat, every=every), between


def find_code(
    flat: FlatDiagram,
    acting: list[frozenset[TickPattern]],
    between: tuple[str, ...],
    *,
    machine: bool,
    fuse: bool = False,
) -> DiagramCode:
    """Return the functions of a run for the virtual machine, or compiled."""
    return interpret_code(flat, acting, between) if machine else compile_code(flat, acting, between, fuse=fuse)
