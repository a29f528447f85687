"""Samples of a sweep in threads of this process: the loop over ticks in C holds no lock of Python's."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from functools import partial

from .outcome import SampleOutcome
from .plan import Plan
from .sample_queue import SampleQueue
from .samples import Sample
from .worker import Worker
from .workers import make_worker


class Halt(BaseException):
    """Ends the run of a thread whose sweep is over."""


def run_in_threads(
    plan: Plan, samples: Iterable[Sample], count: int, worker: Worker
) -> Generator[SampleOutcome, None, None]:
    """Yield the outcomes of samples, in the order in which they are ready; ``worker``, the first thread's, is set up.

    Where the caller stops, such as after Ctrl-C, the runs at hand end within a chunk of ticks.
    """

    def work(worker: Worker, queue: SampleQueue) -> None:
        def progress(t: float) -> None:
            if queue.is_closed:
                raise Halt

        while taken := queue.take(worker.width):
            for outcome in worker.run_all(taken, progress):
                queue.put(outcome)

    def make_and_work(queue: SampleQueue) -> None:
        with make_worker(plan) as own:
            work(own, queue)

    yield from SampleQueue(samples).serve([partial(work, worker), *[make_and_work] * (count - 1)])
