"""Samples of a sweep in separate processes: for runs that Python interprets, and for FMUs of other tools."""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Generator, Iterable
from contextlib import suppress

from ...blocks.core import OptionError
from ...fmus.child_processes import ProcessGroup, PythonChild
from .outcome import SampleOutcome
from .plan import Plan
from .sample_queue import SampleQueue
from .samples import Sample

_LEAVING = 10.0  # s in which a process that has nothing more to do ends by itself


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_in_processes(plan: Plan, samples: Iterable[Sample], count: int) -> Generator[SampleOutcome, None, None]:
    """Yield the outcomes of samples, in the order in which they are ready.

    A process that ends in a run, such as by a crash, makes only that sample a failure; another process continues.
    """
    data = to_bytes(plan, plan.diagram.name)
    try:
        group = ProcessGroup()
    except OSError as error:
        raise OptionError(
            f"worker processes can't be started: {error}. workers=1 runs all in this process.", block=plan.diagram.name
        ) from error
    with group:
        processes = [_Process(data, group) for _ in range(count)]

        def end() -> None:
            for process in processes:
                process.end()

        yield from SampleQueue(samples).serve([process.work for process in processes], end)


def to_bytes(plan: object, name: str) -> bytes:
    """Return a plan as bytes; with cloudpickle, where it is installed, a script's functions and classes travel, too."""
    try:
        import cloudpickle

        return bytes(cloudpickle.dumps(plan))
    except ImportError:
        pass
    except Exception as error:
        raise _not_sent(name, error) from error
    try:
        data = pickle.dumps(plan, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        raise _not_sent(name, error) from error
    if b"__main__" in data:
        raise _not_sent(name, "it holds classes or functions of the main script")
    return data


def _not_sent(name: str, error: object) -> OptionError:
    return OptionError(
        f"the sweep can't be sent to worker processes: {error}. Define classes and functions in a module, or install "
        "the extra: pip install 'loopwright[sweep]'; workers=1 runs all in this process.",
        block=name,
    )


class _Process:
    """A worker process; it is started when first needed, and again after its end."""

    def __init__(self, data: bytes, group: ProcessGroup):
        self._data, self._group = data, group
        self._child: PythonChild | None = None
        self._lock, self._over = threading.Lock(), False

    def work(self, queue: SampleQueue) -> None:
        """Run samples of the queue until there are none; then the process ends by itself, and so its FMUs do."""
        while taken := queue.take():
            queue.put(self.run(taken[0]))
        child = self._child
        if child is not None:
            child.leave(_LEAVING)

    def run(self, sample: Sample) -> SampleOutcome:
        """Return the outcome of a sample; where the process ends, that is its failure."""
        try:
            child = self._begin()
            child.send(sample)
            found: SampleOutcome = child.receive()
        except (EOFError, OSError):
            return SampleOutcome.of_lost(sample, f"the worker process ended {self._describe_end()} in this run")
        return found

    def _begin(self) -> PythonChild:
        with self._lock:
            if self._over:
                raise EOFError
            child, fresh = self._child, self._child is None
            if child is None:
                child = self._child = PythonChild(self._group, "loopwright.diagrams.sweeps.worker_process")
        if fresh:
            child.send(self._data)
            if text := child.receive():
                raise OptionError(
                    f"the sweep can't be read in a worker process: {text}. Define its classes and functions in a "
                    "module that can be imported; workers=1 runs all in this process."
                )
        return child

    def _describe_end(self) -> str:
        child, self._child = self._child, None
        code = None if child is None else child.wait()
        if code is not None and code < 0:
            with suppress(ValueError):
                return f"by signal {signal.Signals(-code).name}"
        return f"with exit status {code}"

    def end(self) -> None:
        """End the process, whatever it does."""
        with self._lock:
            self._over = True
            child = self._child
        if child is not None:
            child.kill()
            child.wait()
