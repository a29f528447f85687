"""The outcome of one run of a sweep: numbers, samples, or the failure that ended it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ...blocks.core import LoopwrightError, SimulationError, explain_calls


@explain_calls
@dataclass(frozen=True)
class Failure:
    """A run that failed, as data.

    Attributes
    ----------
    index : int
        Place of its sample in the sweep.
    kind : str
        Name of the error's class, such as ``"NonFiniteError"``.
    message : str
        Text of the error: block, port, time, found, expected, next step.
    t : float
        Time in s up to which the run went; NaN if it did not begin.
    block, port : str
        Block and port that the error names; empty where it names none.
    """

    index: int
    kind: str
    message: str
    t: float = float("nan")
    block: str = ""
    port: str = ""

    def __str__(self) -> str:
        return f"sample {self.index}: {self.kind}: {self.message}"


WORKER_ENDED = "WorkerEnded"
"""Kind of a failure: the process that ran the sample has ended. It is run again when the sweep continues."""


@dataclass(frozen=True, eq=False)
class SampleOutcome:
    """The outcome of a sample.

    Attributes
    ----------
    index : int
        Place of the sample.
    numbers : mapping of str to ndarray
        Reductions by name; none of a run that failed.
    t : ndarray or None
        Times of the samples that are kept, in s.
    signals : mapping of str to ndarray
        Samples by signal, (n, *shape); those until the end of a run that failed.
    end : float
        Time in s at which the run ended; NaN if it did not begin.
    stopped : str
        Path of the stop condition that ended it; empty without one.
    failure : Failure or None
        The failure that ended it.
    units : mapping of str to str
        Units of the signals that are kept, and of reductions.
    messages : tuple of str
        Messages of the run.
    """

    index: int
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)
    t: np.ndarray | None = None
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)
    end: float = float("nan")
    stopped: str = ""
    failure: Failure | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    messages: tuple[str, ...] = ()


def describe_failure(index: int, error: BaseException) -> Failure:
    """Return an error as data."""
    if not isinstance(error, LoopwrightError):
        return Failure(index, type(error).__name__, str(error))
    run = error.run if isinstance(error, SimulationError) else None
    reached = float(run.t[-1]) if run is not None and len(run.t) else float("nan")
    return Failure(index, type(error).__name__, str(error), reached, error.block or "", error.port or "")
