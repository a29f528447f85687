"""Samples of a sweep side by side in the lanes of vectors, as far as their runs allow it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError
from ...fmus.calls import FmuInstance
from ..flat import EVERY, Announcer, ClockSets, FlatDiagram, TickPattern, kinds_of, ticks_after, times_of
from ..lanes import LaneCode, LaneEnd, LaneRuns, LaneStart, LaneVectors, NoLanesError, compile_lanes, make_room
from ..results import Run, Stopped, machine_memory
from ..simulation import START_EXCHANGES, StopConditions, newton_options
from .bound_run import BoundRun, Progress
from .outcome import SampleOutcome
from .plan import Plan
from .samples import Sample
from .variation import Numbers
from .vector_start import StartSearch, VectorStart
from .worker import Worker

DIFFER = (
    "Side by side in vector lanes: values differ from those of single runs by rounding, which some motions magnify."
)
LEFT = (
    "Not side by side in vector lanes: the run could not continue in its lane, as where an algebraic loop has no "
    "determined solution, and was made again by itself."
)
_MOST_SUBSTEPS = 10_000
_MOST_KINDS = 32
"""Sets of clocks that act together at some tick: the code has a function for each."""
_BYTES = 2**20
"""Of the rows of a chunk, at most: C keeps them in the processor's cache."""
_FIRST, _WISHED = 64, 0.05
"""Ticks of the first chunk, and seconds that one takes, half or double: Ctrl-C has its turn after it."""


class LaneWorker(Worker):
    """Runs samples of a sweep side by side; those whose runs can't go so are run one after the other.

    A run that fails in its lane is run again by itself, so that its error names the failure.
    """

    def __init__(self, plan: Plan):
        super().__init__(plan)
        self.width = plan.lanes
        self._found: dict[Any, _Lanes | str] = {}

    def can_compile(self, sample: Sample) -> bool:
        """Whether a sample's run goes from tick to tick in C; its code is prepared, and not run."""
        if not super().can_compile(sample):
            return False
        numbers = self._variation.find(self.plan.parameters_of(sample))
        bound = self._bind(numbers)
        if bound is not None:
            self._lanes(numbers, bound)
        return True

    def run_all(self, samples: Iterable[Sample], progress: Progress = lambda t: None) -> Iterator[SampleOutcome]:
        """Yield the outcomes of some samples; see `run`."""
        alike: dict[Any, list[tuple[Sample, Numbers]]] = {}
        for sample in samples:
            try:
                numbers = self._variation.find(self.plan.parameters_of(sample))
            except LoopwrightError:  # its run says what it is
                yield self.run(sample, progress)
                continue
            alike.setdefault(numbers.key, []).append((sample, numbers))
        for group in alike.values():
            for k in range(0, len(group), self.width):
                yield from self._run_alike(group[k : k + self.width], progress)

    def _run_alike(self, group: Sequence[tuple[Sample, Numbers]], progress: Progress) -> Iterator[SampleOutcome]:
        """Yield the outcomes of samples that share their functions."""
        numbers = group[0][1]
        bound = self._bind(numbers) if self._repeats else None
        found = self._alone if bound is None else self._lanes(numbers, bound)
        if bound is None or isinstance(found, str):
            for sample, _ in group:
                yield _note(self.run(sample, progress), f"Not side by side in vector lanes: {found}.")
            return
        started = perf_counter()
        alone, left = list[tuple[Sample, str | None]](), list[Sample]()
        vectors, places = found.start_together([own for _, own in group])
        together = [([group[place][0] for place in places], vectors)] if vectors is not None else []
        ready: dict[tuple[float, ...], list[tuple[Sample, LaneStart]]] = {}
        for sample, own in (pair for place, pair in enumerate(group) if place not in places):
            try:
                start = found.start(own)
            except NoLanesError as reason:
                alone.append((sample, f"Not side by side in vector lanes: {reason}."))
            except LoopwrightError:
                alone.append((sample, None))
            else:
                if start is None:
                    alone.append((sample, None))
                else:
                    ready.setdefault(start.steps, []).append((sample, start))
        together += [
            ([sample for sample, _ in runs], LaneVectors.of(found.code, [start for _, start in runs]))
            for runs in ready.values()
        ]
        for samples, vectors in together:
            for sample, run in zip(samples, found.run(vectors, progress, started), strict=True):
                if run is None:
                    left.append(sample)
                else:
                    yield self._judge(sample, lambda run=run: run)  # type: ignore[misc]
        for sample, note in alone:
            outcome = self.run(sample, progress)
            yield outcome if note is None else _note(outcome, note)
        for sample in left:
            outcome = self.run(sample, progress)
            yield outcome if outcome.failure is not None else _note(outcome, LEFT)

    def _lanes(self, numbers: Numbers, bound: BoundRun) -> _Lanes | str:
        """Return the lanes of bound runs, or why there are none."""
        found = self._found.get(numbers.key)
        if isinstance(found, str) or (found is not None and found.bound is bound):
            return found
        try:
            agrees = self._options.start_exchange == START_EXCHANGES[0]
            made = _Lanes(bound, self.plan.lanes, str(self._options.solver).lower(), agrees=agrees)
        except NoLanesError as reason:
            self._found[numbers.key] = text = str(reason)
            return text
        self._found = {key: old for key, old in self._found.items() if isinstance(old, str) or key in self._bound}
        self._found[numbers.key] = made
        return made


class _Lanes:
    """The lanes of the runs of one bound diagram."""

    def __init__(self, bound: BoundRun, count: int, method: str, *, agrees: bool):
        self.bound, engine, flat = bound, bound.engine, bound.flat
        if not bound.is_compiled:
            reason = next(iter(engine.messages), "compile=True was not asked for")
            raise NoLanesError(f"they don't go from tick to tick in C ({reason.rstrip('.')})")
        if bound.end is not None:
            raise NoLanesError("their duration is no whole number of ticks")
        acting = kinds_of(flat, every=engine.every_tick)
        visited = [EVERY] if engine.every_tick else [*flat.visited]
        self._ticks = ticks_after(visited, 0, bound.count, bound.count) if bound.count else np.zeros(0, dtype=np.int64)
        self._kinds = _number(flat, acting, self._ticks)
        while (missing := self._ticks[self._kinds < 0]).size:  # such as the last one, at which no clock may act
            if len(acting) == _MOST_KINDS:
                raise NoLanesError(f"more than {_MOST_KINDS} sets of clocks act together")
            acting.append(flat.acting(int(missing[0])))
            self._kinds = _number(flat, acting, self._ticks)
        ends = np.concatenate([[0], self._ticks])
        self._times, self._widths = times_of(flat, ends), times_of(flat, np.diff(ends))
        entries = bound.recorder.entries
        self._columns = np.arange(engine.workspace.log.size) if entries is None else entries
        needed = 3 * 8 * count * (len(self._ticks) // bound.recorder.every + 2) * len(self._columns)
        if needed > 0.3 * machine_memory():
            raise NoLanesError(f"the samples of {count} runs at a time would take {needed / 2**30:.0f} GiB")
        search = StartSearch(bound) if agrees else None
        source, here = None if search is None else search.source, engine.workspace.here.x
        loops = {clocks: newton_options(flat, clocks, here) for clocks in acting if flat.active_loops(clocks)}
        self.code: LaneCode = compile_lanes(flat, acting, count, source, method if flat.continuous.size else "", loops)
        width, every = max(1, len(self._columns)), bound.recorder.every
        self._chunk = max(1, min(len(self._ticks), every * _BYTES // (8 * width * count)))
        self._span = min(_FIRST, self._chunk)
        self._room = make_room(self._chunk // every + 1, width, count)
        self._stops = StopConditions(flat, engine.workspace.log, str)
        self._start: VectorStart | None = None
        if search is not None and self.code.starts is not None:
            with suppress(NoLanesError):  # of the FMUs' own numbers; each start raises its own
                start = VectorStart(search, self.code, self._columns, self._stops.entries)
                for path, step in start.steps.items():
                    self._refuse_fine(path, step)
                self._start = start

    def start_together(self, group: Sequence[Numbers]) -> tuple[LaneVectors | None, list[int]]:
        """Return runs at their first tick, and which of a group these are; the others are started one by one."""
        if self._start is None or not len(self._ticks):
            return None, []
        return self._start.find(group)

    def start(self, numbers: Numbers) -> LaneStart | None:
        """Return a run's numbers at its first tick; None if it ends there. NoLanesError: it can't go with others."""
        bound = self.bound
        engine, workspace = bound.engine, bound.engine.workspace
        bound.recorder.begin_again()
        bound.begin(numbers)
        try:
            engine.take_first_tick(None, bound.recorder)
        finally:
            bound.recorder.finish()
        row = workspace.log[self._columns]
        if engine.position.stopped is not None or not len(self._ticks):
            return None
        if engine.continuous is not None:
            self._refuse_between_ticks(engine.continuous.sources)
        plants, steps = dict[str, np.ndarray](), list[float]()
        for path, plant in self.code.plants.items():
            instance = engine.plants[path]
            assert isinstance(instance, FmuInstance)
            plants[path], step = plant.read(instance)
            self._refuse_fine(path, step)
            steps.append(step)
        here = workspace.here
        vectors = here.x.copy(), here.w.copy(), workspace.z.copy(), here.p.copy()
        return LaneStart(*vectors, plants, tuple(steps), row, bound.take_messages())

    def _refuse_between_ticks(self, sources: Iterable[tuple[str, Announcer]]) -> None:
        """Raise NoLanesError for a source that is not smooth between ticks, where a run's steps would be its own."""
        base, end = self.bound.flat.base, self._times[-1]
        for path, source in sources:
            t, seen = source.next_instant(0.0), 0
            while t < end:
                k = round(t * base.denominator / base.numerator)
                if abs(t - k * base.numerator / base.denominator) > 4 * np.spacing(t) or getattr(source, "late", {}):
                    raise NoLanesError(f"{path} is not smooth at t = {t:g} s, between ticks")
                t, seen = source.next_instant(t), seen + 1
                if seen > len(self._ticks):
                    raise NoLanesError(f"{path} is not smooth at instants between ticks")

    def _refuse_fine(self, path: str, step: float) -> None:
        if self._widths.max() > _MOST_SUBSTEPS * step:
            raise NoLanesError(f"{path} integrates with {step:g} s, more than {_MOST_SUBSTEPS} substeps in a tick")

    def run(self, vectors: LaneVectors, progress: Progress, started: float) -> Iterator[Run | None]:
        """Yield the runs; None for one that has failed."""
        bound, n = self.bound, len(self._columns)
        runs = LaneRuns(
            self.code, vectors, columns=self._columns, every=bound.recorder.every, stops=self._stops.entries
        )
        kept = [[row[None]] for row in np.ascontiguousarray(vectors.row.T[: vectors.count])]
        room = self._room
        k, total = 0, len(self._ticks)
        while k < total and runs.is_going:
            end, begun = min(k + self._span, total), perf_counter()
            rows = runs.run(self._times[k : end + 1], self._widths[k:end], self._kinds[k:end], room)
            for parts, lane in zip(kept, np.ascontiguousarray(room[:rows, :n].transpose(2, 0, 1)), strict=False):
                parts.append(lane)
            took = perf_counter() - begun
            if took < _WISHED:
                self._span = min(2 * self._span, self._chunk)
            elif took > 2 * _WISHED:
                self._span = max(1, self._span // 2)
            k = end
            progress(float(self._times[k]))
        for messages, parts, end_of in zip(vectors.messages, kept, runs.ends(), strict=True):
            yield None if end_of.failed else self._make_run(parts, end_of, started, (*messages, DIFFER))

    def _make_run(self, parts: Sequence[np.ndarray], end: LaneEnd, started: float, messages: Sequence[str]) -> Run:
        """Return a run from its rows, of which those after its end are left out."""
        every = self.bound.recorder.every
        last = end.stopped or len(self._ticks)
        count = 1 + last // every
        data = np.concatenate(parts)[:count]
        t = self._times[: last + 1 : every]
        if last % every:  # the last sample is kept in any case
            data, t = np.concatenate([data, end.last[None]]), np.append(t, self._times[last])
        stopped = Stopped(float(self._times[last]), self._stops.paths[end.by]) if end.stopped else None
        residual = None
        if self.bound.recorder.has_residual:  # it is the last entry that is kept
            data, residual = data[:, :-1], data[:, -1].copy()
        return self.bound.make_run(t.copy(), data, stopped, started, messages, residual)


def _number(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], ticks: np.ndarray) -> np.ndarray:
    """Return which set of clocks acts at each of some ticks; −1 for another one."""
    return ClockSets(flat.distinct, {clocks: k for k, clocks in enumerate(acting)}).at(ticks)


def _note(outcome: SampleOutcome, text: str) -> SampleOutcome:
    return replace(outcome, messages=(*outcome.messages, text))
