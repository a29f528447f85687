"""The ways to run the samples of a sweep: one after the other, in threads, in processes, on a cluster."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

from .outcome import SampleOutcome
from .plan import Plan
from .processes import run_in_processes
from .sample_queue import SampleQueue
from .samples import Sample
from .worker import Worker
from .workers import make_worker

_ASKED = 4
"""Samples asked whether their runs are compiled: one with a value that is refused does not decide for the others."""


def run_samples(
    plan: Plan, samples: Sequence[Sample], workers: int, client: Any
) -> Generator[SampleOutcome, None, None]:
    """Yield the outcomes of samples where they are run best: here, in threads, in processes or on a cluster."""
    if not samples:
        return
    if client is not None:
        from .cluster import run_on_cluster

        yield from run_on_cluster(plan, samples, client)
        return
    with make_worker(plan) as worker:
        if workers == 1:
            for k in range(0, len(samples), worker.width):
                yield from worker.run_all(samples[k : k + worker.width])
            return
        if any(worker.can_compile(sample) for sample in samples[:_ASKED]):
            with closing(_run_in_threads(plan, samples, min(workers, len(samples)), worker)) as stream:
                yield from stream
            return
    with closing(run_in_processes(plan, samples, min(workers, len(samples)))) as stream:
        yield from stream


class _Halt(BaseException):
    """Ends the run of a thread whose sweep is over."""


def _run_in_threads(
    plan: Plan, samples: Iterable[Sample], count: int, worker: Worker
) -> Generator[SampleOutcome, None, None]:
    """Yield the outcomes of samples, in the order in which they are ready; ``worker``, the first thread's, is set up.

    Where the caller stops, such as after Ctrl-C, the runs at hand end within a chunk of ticks.
    """

    def work(worker: Worker, queue: SampleQueue) -> None:
        def progress(t: float) -> None:
            if queue.is_closed:
                raise _Halt

        while taken := queue.take(worker.width):
            for outcome in worker.run_all(taken, progress):
                queue.put(outcome)

    def make_and_work(queue: SampleQueue) -> None:
        with make_worker(plan) as own:
            work(own, queue)

    yield from SampleQueue(samples).serve([partial(work, worker), *[make_and_work] * (count - 1)])
