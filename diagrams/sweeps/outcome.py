"""The outcome of one run of a sweep: numbers, samples, or the failure that ended it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ...blocks.core import explain_calls
from .samples import Sample


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
    """The outcome of a sample."""

    index: int  # place of the sample
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)  # reductions by name; none of a run that failed
    t: np.ndarray | None = None  # times of the samples that are kept, in s
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)  # (n, *shape); until the end of a run that failed
    end: float = float("nan")  # time in s at which the run ended; NaN if it did not begin
    stopped: str = ""  # path of the stop condition that ended it
    failure: Failure | None = None
    units: Mapping[str, str] = field(default_factory=dict)  # of the signals that are kept, and of reductions
    messages: tuple[str, ...] = ()

    @classmethod
    def of_lost(cls, sample: Sample, end: str) -> SampleOutcome:
        """Return the outcome of a sample whose process has ended; ``end`` says how."""
        values = ", ".join(f"{name!r}: {value!r}" for name, value in sample.parameters.items())
        text = f"{end}. Run it alone: diagram.replace({{{values}}}).simulate(…)."
        return cls(sample.index, failure=Failure(sample.index, WORKER_ENDED, text))
