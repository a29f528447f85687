"""The queue of a sweep: samples for workers in threads, and their outcomes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from itertools import islice
from queue import SimpleQueue

from .outcome import SampleOutcome
from .samples import Sample


class SampleQueue:
    """Samples that workers take, and the outcomes that they return."""

    def __init__(self, samples: Iterable[Sample]):
        self._waiting, self._lock, self._closed = iter(samples), threading.Lock(), threading.Event()
        self._ready: SimpleQueue[SampleOutcome | BaseException | None] = SimpleQueue()

    @property
    def is_closed(self) -> bool:
        """Whether the sweep is over: nobody waits for outcomes any more."""
        return self._closed.is_set()

    def take(self, count: int = 1) -> list[Sample]:
        """Return the next samples, at most ``count``; none once the queue is closed."""
        with self._lock:
            return [] if self.is_closed else list(islice(self._waiting, count))

    def put(self, outcome: SampleOutcome) -> None:
        """Add the outcome of a sample."""
        self._ready.put(outcome)

    def serve(
        self, workers: Sequence[Callable[[SampleQueue], None]], end: Callable[[], None] = lambda: None
    ) -> Generator[SampleOutcome, None, None]:
        """Yield the outcomes of workers, each in its own thread, as they become ready.

        The error of a worker closes the queue and is raised. When the caller stops, the queue is closed, then ``end``
        is called, and the workers are waited for.
        """

        def work(worker: Callable[[SampleQueue], None]) -> None:
            try:
                worker(self)
            except BaseException as error:
                if not self.is_closed:
                    self._ready.put(error)
                    self._closed.set()  # here, as the caller may read the error late: no worker starts another sample
            finally:
                self._ready.put(None)

        threads = [
            threading.Thread(target=work, args=(worker,), name=f"sweep {k}", daemon=True)
            for k, worker in enumerate(workers)
        ]
        for thread in threads:
            thread.start()
        left = len(threads)
        try:
            while left:
                found = self._ready.get()
                if found is None:
                    left -= 1
                elif isinstance(found, BaseException):
                    raise found
                else:
                    yield found
        finally:
            self._closed.set()
            end()
            for thread in threads:
                thread.join()
