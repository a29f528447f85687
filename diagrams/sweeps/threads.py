"""Samples of a sweep in threads of this process: the loop over ticks in C holds no lock of Python's."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from functools import partial

from .desk import Desk
from .outcome import Outcome
from .plan import Plan, Worker
from .samples import Sample
from .workers import make_worker


class Halt(BaseException):
    """Ends the run of a thread whose sweep is over."""


def run_in_threads(plan: Plan, samples: Iterable[Sample], count: int, worker: Worker) -> Generator[Outcome, None, None]:
    """Yield the outcomes of samples, in the order in which they are ready.

    Where the caller stops, such as after Ctrl-C, the runs at hand end within a chunk of ticks.

    Parameters
    ----------
    plan : Plan
        The sweep.
    samples : iterable of Sample
        The samples.
    count : int
        Number of threads.
    worker : Worker
        The worker of the first thread, which has been set up; each of the others makes its own.
    """

    def work(worker: Worker, desk: Desk) -> None:
        def tell(t: float) -> None:
            if desk.is_closed:
                raise Halt

        while taken := desk.take(worker.width):
            for outcome in worker.run_all(taken, tell):
                desk.put(outcome)

    def make_and_work(desk: Desk) -> None:
        with make_worker(plan) as own:
            work(own, desk)

    yield from Desk(samples).serve([partial(work, worker), *[make_and_work] * (count - 1)])
