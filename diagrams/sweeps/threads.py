"""Samples of a sweep in threads of this process: the loop over ticks in C holds no lock of Python's."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable
from queue import SimpleQueue

from .outcome import Outcome
from .plan import Plan, Worker
from .samples import Sample


class Halt(BaseException):
    """Ends the run of a thread whose sweep is over."""


def run_in_threads(plan: Plan, samples: Iterable[Sample], count: int) -> Generator[Outcome, None, None]:
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
    """
    waiting, lock, halted = iter(samples), threading.Lock(), threading.Event()
    ready: SimpleQueue[Outcome | BaseException | None] = SimpleQueue()

    def take() -> Sample | None:
        with lock:
            return None if halted.is_set() else next(waiting, None)

    def tell(t: float) -> None:
        if halted.is_set():
            raise Halt

    def work() -> None:
        try:
            with Worker(plan) as worker:
                while (sample := take()) is not None:
                    ready.put(worker.run(sample, tell))
        except Halt:
            pass
        except BaseException as error:
            ready.put(error)
        finally:
            ready.put(None)

    threads = [threading.Thread(target=work, name=f"sweep {k}", daemon=True) for k in range(count)]
    for thread in threads:
        thread.start()
    left = count
    try:
        while left:
            found = ready.get()
            if found is None:
                left -= 1
            elif isinstance(found, BaseException):
                raise found
            else:
                yield found
    finally:
        halted.set()
        for thread in threads:
            thread.join()
