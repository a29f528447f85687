"""The choices of a recording: signals and states, how often, into memory or to disk."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...blocks.core import OptionError, PortUnit, accepts
from ..flat import FlatDiagram
from ..wiring import join
from .memory import check_memory
from .recorder import EVERY, Recorder, select
from .signal_names import outputs_of
from .stored import PathLike, header


@accepts(None, every=EVERY)
@dataclass
class Recording:
    """The choices of a recording: `Diagram.simulate` takes them as ``record``, ``every``, ``states`` and ``to``."""

    flat: FlatDiagram
    name: str
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

    @property
    def width(self) -> int:
        """Entries of the vector of a sample, without the residual."""
        return self.flat.log.total + self.flat.width

    @cached_property
    def columns(self) -> np.ndarray | None:
        """The entries that are kept; None for all."""
        flat = self.flat
        return select(self.record, flat.log, flat.table.names, self.width, states=self.states, blocks=flat.table.blocks)

    @cached_property
    def units(self) -> dict[str, PortUnit]:
        """The units of the ports by path."""
        return {join(*port): unit for port, unit in self.flat.checked.units.items()}

    def check_memory(self, ticks: int, *, every_tick: bool) -> None:
        """Refuse a run whose samples can't fit: at every tick, or at those at which a subsystem acts."""
        width = self.width if self.columns is None else len(self.columns)
        clocks = self.flat.distinct
        samples = ticks + 1
        if clocks and not every_tick:
            samples = min(samples, sum(ticks // clock.every + 1 for clock in clocks) + 2)
        check_memory(samples, width, self.flat.base, self.name, every=self.every, to=self.to)

    def begin(self, rows: int | None = None) -> Recorder:
        """Return a recorder that has no sample yet; ``rows`` are the samples to come, if that is known."""
        flat, head = self.flat, None
        residual = bool(flat.loops.slices)
        if self.to is not None:
            head = header(
                diagram=self.name,
                layout=flat.log,
                wires=flat.table.names,
                units=self.units,
                width=self.width,
                columns=self.columns,
                has_states=self.states,
                residual=residual,
                outputs=outputs_of(flat.table.blocks),
            )
        recorder = Recorder(
            self.width,
            self.columns,
            every=self.every,
            rows=rows,
            residual=residual,
            to=self.to,
            header=head,
            overwrite=self.overwrite,
        )
        recorder.watch(flat.unread)
        return recorder
