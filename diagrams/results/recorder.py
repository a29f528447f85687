"""The recorder: takes samples into memory, or to disk during the run; the choices of a recording, and its room."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from io import FileIO
from pathlib import Path
from time import monotonic
from typing import TextIO

import numpy as np

from ...blocks.core import (
    Block,
    OptionError,
    SimulationError,
    accepts,
    check_argument,
    describe_disk_error,
    enumerate_some,
    explain_disk_errors,
    kinds,
)
from ..flat import FlatDiagram
from .recorded_signals import RecordedSignals
from .stored import END, OTHER_PATH, Occurrence, PathLike, create, event_line, header, prepare, read, split, write_json

_FIRST, _LARGEST = 1024, 2**26  # rows of the first chunk in memory, bytes of the largest
_ROWS, _BYTES = 1024, 2**18  # of a chunk on its way to disk, whichever is less
EVERY = kinds.integer(1).worded("a positive integer, such as 10 to keep one sample of 10", "Give one.", kinds.by_name)
"""Kind of the number of ticks from one recorded sample to the next."""
_LATEST = 1.0  # seconds after which a row is written at the latest when the next one comes


class Recorder:
    """Takes a run's samples.

    In memory, samples go into chunks that double until they hold 64 MiB. `finish` joins them chunk by chunk, so it
    never holds much more than the samples themselves. With ``to`` they go to disk in chunks of at most 1024 rows and
    about 256 KiB, and memory holds one chunk. Nothing is allocated or written before the first sample.

    After a kill of the process (``kill -9``, a crash) everything that was flushed can be read. Rows and events are
    flushed when the chunk is full, when a row comes a second or more after the last flush, and by `flush`. So a kill
    loses at most the last 1024 rows, and of these only those of the second before the newest one. A row that was cut in
    the middle is left out. After a power failure the same holds for the data that the operating system had written by
    then, and for everything once `finish` has returned.

    ``columns`` are the entries of a sample's vector that are kept, ascending; None for all. The first of ``every``
    calls of `row` is kept. Where the number of calls to come is known, ``rows``, memory is taken once. With
    ``residual`` the vector has one more entry than ``width`` at its end, the residual of the algebraic loops; it is
    always kept, apart from the data. ``header`` is that of the run on disk (`stored.header`).
    """

    def __init__(
        self,
        width: int,
        columns: Iterable[int] | None = None,
        *,
        every: int = 1,
        rows: int | None = None,
        residual: bool = False,
        to: PathLike | None = None,
        header: Mapping[str, object] | None = None,
        overwrite: bool = False,
    ):
        check_argument(every, EVERY, "every", None)
        self.every, self.has_residual = int(every), residual
        self.columns = None if columns is None else np.array([*columns], dtype=int)
        self._pick = self.columns
        if self.columns is not None and residual:
            self._pick = np.append(self.columns, width)
        self._width = 1 + (width + residual if self._pick is None else len(self._pick))
        self._expected = None if rows is None else -(-rows // self.every) + 1
        self.to = None if to is None else Path(to)
        if self.to is not None:
            prepare(self.to, overwrite)
        self._header, self._written = header, 0
        self._files: tuple[FileIO, TextIO] | None = None
        self._fired: list[Occurrence] = []
        self.events: Sequence[Occurrence] = self._fired
        self._done: list[np.ndarray] = []
        self._chunk = np.empty((0, 0))
        self._k = self._limit = self._skip = 0
        self._due, self._broken = 0.0, False
        self._tail: np.ndarray | None = None  # the newest row that was flushed
        self._watched: Mapping[str, np.ndarray] = {}
        self._lost: dict[str, float] = {}
        self.residual: np.ndarray | None = None
        """After `finish`: the residual of each sample kept."""

    def watch(self, outputs: Mapping[str, slice]) -> None:
        """Look for samples of outputs (entries of the vector by path) that are no finite numbers: `lost_outputs`."""
        column = None if self._pick is None else {entry: k for k, entry in enumerate(self._pick.tolist(), 1)}
        watched = dict(self._watched)
        for name, where in outputs.items():
            entries = range(where.start, where.stop)
            kept = [1 + k for k in entries] if column is None else [column[k] for k in entries if k in column]
            if kept:
                watched[name] = np.array(kept)
        self._watched = watched

    def describe_lost(self) -> tuple[str, ...]:
        """Return the message of a run on the outputs that were watched and are no finite numbers in its samples."""
        found = [f"{name} from t = {t:.9g} s on" for name, t in self.lost_outputs().items()]
        if not found:
            return ()
        text = (
            f"no finite numbers are in the record of {enumerate_some(found)}: an FMU puts them out, and the run "
            "continues, as nothing reads them. Choose the FMU's ports without them, by ports=, if they are of no use."
        )
        return (text,)

    def lost_outputs(self) -> dict[str, float]:
        """Return the outputs that were watched and are no finite numbers in a sample, with the first such time in s."""
        if not self._watched:
            return {}
        if self.to is not None:
            self.flush()
        else:
            for chunk in (*self._done, self._chunk[: self._k]):
                self._look(chunk)
        return dict(self._lost)

    def _look(self, rows: np.ndarray) -> None:
        for name, columns in self._watched.items():
            if name not in self._lost and len(rows):
                lost = ~np.isfinite(rows[:, columns]).all(axis=1)
                if lost.any():
                    self._lost[name] = float(rows[int(np.argmax(lost)), 0])

    # --- samples: C writes almost all of them into `room` ------------------------------------------------------------

    def row(self, t: float, vector: np.ndarray) -> None:
        """Append a sample, which is copied, if it is the one of ``every`` that is kept."""
        if self._skip:
            self._skip -= 1
        else:
            self._skip = self.every - 1
            self._keep(t, vector)

    def _keep(self, t: float, vector: np.ndarray) -> None:
        row = self.room(t)[0]
        row[0] = t
        row[1:] = vector if self._pick is None else vector[self._pick]
        self._k += 1

    @property
    def entries(self) -> np.ndarray | None:
        """Entries of the vector that a row keeps, ascending; None for all."""
        return self._pick

    @property
    def skip(self) -> int:
        """Calls of `row` to come until the next one that is kept."""
        return self._skip

    def room(self, t: float) -> np.ndarray:
        """Return rows that the caller writes, (n, 1 + entries), n > 0: time, then values; see `took`."""
        if self._k == self._limit or (self.to is not None and monotonic() >= self._due):
            if self.to is None:
                self._grow(t)
            else:
                self._start()
                self.flush()
        return self._chunk[self._k :]

    def took(self, rows: int, skip: int) -> None:
        """Take over rows that were written into `room`, and how many samples are to be skipped next."""
        self._k += rows
        self._skip = skip

    def last(self, t: float, vector: np.ndarray) -> None:
        """Append the final sample, whatever ``every`` is, unless `row` has just kept it."""
        newest = self._chunk[self._k - 1] if self._k else self._tail
        values = vector if self._pick is None else vector[self._pick]
        if newest is not None and newest[0] == t and (newest[1:] == values).all():
            return
        if newest is None or newest[0] != t or not np.array_equal(newest[1:], values, equal_nan=True):
            self._keep(t, vector)

    def event(self, occurrence: Occurrence) -> None:
        """Append an event that fired."""
        if self.to is None:
            self._fired.append(occurrence)
        else:
            events = self._start()[1]
            try:
                events.write(event_line(occurrence))
            except OSError as error:
                raise self._write_error(error) from error

    def begin_again(self) -> None:
        """Take the samples of another run into memory, after `finish`."""
        self._skip, self._tail, self._fired, self._lost = 0, None, [], {}
        self.events = self._fired

    # --- chunks ------------------------------------------------------------------------------------------------------

    def _begin_chunk(self, rows: int) -> None:
        self._chunk = np.empty((rows, self._width), "<f8")
        self._k, self._limit = 0, rows

    def _grow(self, t: float) -> None:
        """Begin the next chunk."""
        if self._limit:
            self._done.append(self._chunk)
        row = 8 * self._width
        rows = min(2 * self._limit, max(_LARGEST // row, 1)) if self._limit else (self._expected or _FIRST)
        held = sum(chunk.nbytes for chunk in self._done)
        if self._done and held + rows * row > 0.8 * machine_memory():
            self._chunk, self._k, self._limit = self._chunk[:0], 0, 0  # the full one is among the chunks done
            raise SimulationError(
                f"the samples fill {held / 2**30:.1f} GiB, and this machine has {machine_memory() / 2**30:.0f}. Record "
                "less with record=[…] or every=…, or stream to disk with to=path.",
                t=t,
            )
        self._begin_chunk(rows)

    def _start(self) -> tuple[FileIO, TextIO]:
        """Return the open files for rows and events; the first time, create the folder and open them."""
        if self._files is None:
            assert self.to is not None
            try:
                self._files = create(self.to, self._header or {})
            except OSError as error:
                raise self._write_error(error) from error
            self._begin_chunk(max(1, min(_ROWS, _BYTES // (8 * self._width))))
            self._due = monotonic() + _LATEST
        return self._files

    @property
    def is_open(self) -> bool:
        """Whether files on disk are open: samples were written, and `finish` was not called."""
        return self._files is not None

    def flush(self) -> None:
        """Write the rows of the chunk to disk; without ``to`` this does nothing."""
        if self._files is None:
            return
        rows, events = self._files
        self._look(self._chunk[: self._k])
        if self._k:
            self._tail = self._chunk[self._k - 1].copy()
        left = self._chunk[: self._k].data.cast("B") if self._k else memoryview(b"")
        try:
            while left:
                left = left[rows.write(left) :]
            events.flush()
        except OSError as error:
            rows.truncate(self._written * 8 * self._width)  # whole rows only, or later ones would be shifted
            self._k = 0
            raise self._write_error(error) from error
        self._written += self._k
        self._k, self._due = 0, monotonic() + _LATEST

    def _write_error(self, error: OSError) -> SimulationError:
        self._broken = True
        place = os.fspath(self.to or "")
        return SimulationError(
            f"the run can't be written to {place!r}; the samples written before are kept: "
            f"{describe_disk_error(error, place, OTHER_PATH)}"
        )

    def finish(self, **end: object) -> tuple[np.ndarray, np.ndarray]:
        """Close the files, with an `End`, and return times, (n,), and samples, (n, entries kept)."""
        if self.to is not None:
            return self._close(end)
        if self._k:
            self._done.append(self._chunk[: self._k])
        self._chunk, self._k, self._limit = np.empty((0, 0)), 0, 0
        rows = self._done.pop() if len(self._done) == 1 else self._join_chunks()
        self.events = tuple(self._fired)
        t, data, self.residual = split(rows, self.has_residual)
        return np.ascontiguousarray(t), data

    def _join_chunks(self) -> np.ndarray:
        rows, n = np.empty((sum(map(len, self._done)), self._width)), 0
        self._done.reverse()
        while self._done:  # each is freed once it is copied: memory for `rows` is taken page by page, on writing
            chunk = self._done.pop()
            rows[n : n + len(chunk)] = chunk
            n += len(chunk)
        return rows

    def _close(self, end: Mapping[str, object]) -> tuple[np.ndarray, np.ndarray]:
        assert self.to is not None
        files = self._start()
        try:
            self.flush()
            for file in files:
                file.flush()
                os.fsync(file.fileno())
            write_json(self.to / END, end)
        except OSError as error:
            if not self._broken:  # else the error was raised before
                raise self._write_error(error) from error
        finally:
            for file in files:
                file.close()
            self._files = None
        stored = read(self.to)
        self.events, self.residual = stored.events, stored.residual
        return stored.t, stored.data


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
                f"found record={self.record!r}; expected names of signals. Give a list, such as record=['y'].",
                block=self.name,
            )
        if self.to is not None and not isinstance(self.to, str | os.PathLike):
            raise OptionError(
                f"found to={self.to!r}; expected the path of a folder. Give one, such as to='runs/first'.",
                block=self.name,
            )

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


def machine_memory() -> int:
    """Return the bytes of memory of this machine."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):  # not on Windows
        return 16 * 2**30


def check_memory(
    samples: int, width: int, base: Fraction, name: str, *, every: int = 1, to: str | os.PathLike[str] | None = None
) -> None:
    """Refuse a run whose samples can't fit, before it takes the machine down.

    There is one sample more than ticks of ``base`` seconds; ``width`` numbers of one sample in ``every`` are recorded,
    in memory, or on disk at ``to``.
    """
    needed = -(-samples // every) * 8 * (width + 1)
    if to is None:
        there, most, place = machine_memory(), 0.8 * machine_memory(), "this machine has"
        remedy = "record less with record=[…] or every=…, or stream to disk with to=path"
    else:
        there = most = free_on_disk(Path(to))
        place, remedy = "the disk has free", "record less with record=[…] or every=…, or choose another disk"
    if needed > most:
        kept = f"{width} numbers each" if every == 1 else f"{width} numbers of each {every}th"
        raise OptionError(
            f"found {samples - 1} ticks of {float(base):g} s; {kept} need {needed / 2**30:.0f} GiB, "
            f"and {place} {there / 2**30:.0f}. Is the duration in s? Take a shorter one or a larger step, {remedy}.",
            block=name,
            port="duration",
        )


def free_on_disk(path: Path) -> int:
    """Return the bytes that are free where a path is to be created."""
    with explain_disk_errors(f"the run can't be kept in {str(path)!r}", path, "Choose another path.", OptionError):
        path = path.absolute()
        return shutil.disk_usage(next(p for p in (path, *path.parents) if p.exists())).free
