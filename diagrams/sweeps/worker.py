"""The worker that runs samples of a sweep, one after the other, each with its own numbers."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, SimulationError
from ..results import RecordedSignals, Run
from ..simulation import simulate
from .bound_run import BoundRun, Progress
from .outcome import Failure, SampleOutcome
from .plan import Plan
from .reductions import Reduction
from .samples import Sample
from .variation import Numbers, Variation

_BOUND = 4
"""Diagrams of different structure that a worker keeps bound at a time."""


class Worker:
    """Runs samples of a sweep, one after the other; used in a ``with`` statement."""

    width = 1
    """Samples that it is best given at a time."""

    def __init__(self, plan: Plan):
        self.plan, self._options = plan, plan.run_options
        self._variation = Variation(plan.diagram)
        self._bound: OrderedDict[Any, BoundRun] = OrderedDict()
        self._known_units: tuple[RecordedSignals, dict[str, str]] | None = None
        self._alone = plan.obstacle
        """Why each run needs its own set-up, as a clause, where it does."""
        self._repeats = not self._alone

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with ExitStack() as stack:
            for bound in self._bound.values():
                stack.push(bound.__exit__)
            self._bound.clear()

    def can_compile(self, sample: Sample) -> bool:
        """Whether a sample's run goes from tick to tick in C; it is prepared, and not run."""
        try:
            bound = self._bind(self._variation.find(self.plan.parameters_of(sample))) if self._repeats else None
        except LoopwrightError:  # of this sample; its run will raise it
            return False
        return bound is not None and bound.is_compiled

    def run_all(self, samples: Iterable[Sample], progress: Progress = lambda t: None) -> Iterator[SampleOutcome]:
        """Yield the outcomes of some samples; see `run`."""
        for sample in samples:
            yield self.run(sample, progress)

    def run(self, sample: Sample, progress: Progress = lambda t: None) -> SampleOutcome:
        """Run a sample; a run that fails is an outcome, too. An exception that ``progress`` raises ends the run."""
        return self._judge(sample, lambda: self._simulate(self.plan.parameters_of(sample), progress))

    def _judge(self, sample: Sample, make: Callable[[], Run]) -> SampleOutcome:
        """Return the outcome of a sample whose run is made here, whether it fails or not."""
        try:
            return self._outcome(sample, make())
        except LoopwrightError as error:
            run = error.run if isinstance(error, SimulationError) else None
            reached = float(run.t[-1]) if run is not None and len(run.t) else math.nan
            kind, block, port = type(error).__name__, error.block or "", error.port or ""
            failure = Failure(sample.index, kind, str(error), reached, block, port)
            if run is None or not len(run.t):
                return SampleOutcome(sample.index, failure=failure)
            return self._with_samples(SampleOutcome(sample.index, failure=failure), run)

    # --- its runs ----------------------------------------------------------------------------------------------------

    def _simulate(self, parameters: Mapping[str, Any], progress: Progress) -> Run:
        numbers = self._variation.find(parameters)
        bound = self._bind(numbers) if self._repeats else None
        if bound is None or not bound.fits(numbers):
            return simulate(numbers.make_diagram(), self.plan.duration, self._options, progress=False)
        try:
            return bound.run(numbers, progress)
        finally:
            if bound.is_broken:
                del self._bound[numbers.key]
                bound.__exit__(None, None, None)

    def _bind(self, numbers: Numbers) -> BoundRun | None:
        """Return the bound runs of a diagram; None where each run needs its own set-up."""
        if numbers.key not in self._bound:
            bound = BoundRun(numbers.diagram, self.plan.duration, self._options)
            try:
                bound.__enter__()
            except SimulationError as error:  # at these numbers; others may do
                self._alone = f"the diagram's own numbers give no start ({error})"
                return None
            if obstacle := bound.obstacle:
                self._alone = obstacle
                bound.__exit__(None, None, None)
                self._repeats = self._repeats and numbers.key is not None
                return None
            self._bound[numbers.key] = bound
            if len(self._bound) > _BOUND:
                self._bound.popitem(last=False)[1].__exit__(None, None, None)
        self._bound.move_to_end(numbers.key)
        return self._bound[numbers.key]

    # --- their outcomes ----------------------------------------------------------------------------------------------

    def _outcome(self, sample: Sample, run: Run) -> SampleOutcome:
        numbers = {name: self._reduce(name, function, run) for name, function in self.plan.reductions.items()}
        stopped = "" if run.stopped is None else run.stopped.block
        return self._with_samples(SampleOutcome(sample.index, numbers, stopped=stopped), run)

    def _with_samples(self, outcome: SampleOutcome, run: Run) -> SampleOutcome:
        """Return an outcome with the samples that are kept of a run."""
        t = run.t.copy() if self.plan.signals else None
        signals = {name: np.array(run[name]) for name in self.plan.signals}
        end, units = float(run.t[-1]), self._units(run)
        return replace(outcome, t=t, signals=signals, end=end, units=units, messages=run.messages)

    def _reduce(self, name: str, function: Callable[[Run], Any], run: Run) -> np.ndarray:
        try:
            found = function(run)
            if found is None:
                raise TypeError("it returned None; expected a number, or an array. Is a return missing?")
            return np.array(found, dtype=float)
        except LoopwrightError:
            raise
        except Exception as error:
            said = f"{type(error).__name__}: {error}".rstrip(".")
            text = f"the reduction {name!r} failed: {said}. Try it on a single run."
            failure = SimulationError(text, block=self.plan.diagram.name, port=name, t=float(run.t[-1]))
            raise failure.keep(run) from error

    def _units(self, run: Run) -> Mapping[str, str]:
        if self._known_units is None or self._known_units[0] is not run.signals:
            found = {name: run.unit(name) for name in self.plan.signals}
            for name, function in self.plan.reductions.items():
                if isinstance(function, Reduction):
                    found[name] = run.unit(function.signal) if function.unit is None else function.unit
            self._known_units = run.signals, {name: str(unit) for name, unit in found.items() if unit}
        return self._known_units[1]
