"""The choices of a recording: signals and states, how often, into memory or to disk."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

from ...blocks.core import Block, OptionError, accepts
from ..flat import FlatDiagram
from .memory import check_memory
from .recorded_signals import RecordedSignals
from .recorder import EVERY, Recorder
from .stored import PathLike, header


@accepts(None, every=EVERY)
@dataclass
class Recording:
    """The choices of a recording: `Diagram.simulate` takes them as ``record``, ``every``, ``states`` and ``to``."""

    flat: FlatDiagram
    name: str
    blocks: Mapping[str, Block]
    """The diagram's blocks, as they were wired."""
    record: Iterable[str] | None
    every: int
    states: bool
    to: PathLike | None
    overwrite: bool

    def __post_init__(self) -> None:
        if self.record is not None and not isinstance(self.record, Iterable):
            raise OptionError(
                f"found record={self.record!r}; expected names of signals, such as record=['y'].", block=self.name
            )
        if self.to is not None and not isinstance(self.to, str | os.PathLike):
            raise OptionError(f"found to={self.to!r}; expected the path of a folder.", block=self.name)

    def stay_in_memory(self) -> None:
        """Let the next recorder keep its samples in memory: the run on disk stays."""
        self.to = None

    def allow_overwriting(self) -> None:
        """Let the next recorder replace the run on disk."""
        self.overwrite = True

    @cached_property
    def signals(self) -> RecordedSignals:
        """The signals that are recorded."""
        return RecordedSignals.of(self.flat, self.blocks).choose(self.record, states=self.states)

    def check_memory(self, ticks: int, *, every_tick: bool) -> None:
        """Refuse a run whose samples can't fit: at every tick, or at those at which a subsystem acts."""
        columns = self.signals.columns
        width = self.signals.width if columns is None else len(columns)
        clocks = self.flat.distinct
        samples = ticks + 1
        if clocks and not every_tick:
            samples = min(samples, sum(ticks // clock.every + 1 for clock in clocks) + 2)
        check_memory(samples, width, self.flat.base, self.name, every=self.every, to=self.to)

    def begin(self, rows: int | None = None) -> Recorder:
        """Return a recorder that has no sample yet; ``rows`` are the samples to come, if that is known."""
        residual = bool(self.flat.loops.slices)
        recorder = Recorder(
            self.signals.width,
            self.signals.columns,
            every=self.every,
            rows=rows,
            residual=residual,
            to=self.to,
            header=None if self.to is None else header(self.name, self.signals, residual=residual),
            overwrite=self.overwrite,
        )
        recorder.watch(self.flat.unread)
        return recorder
