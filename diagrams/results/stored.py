"""Runs on disk: a folder that any tool can read.

::

    run/
    ├── header.json    the columns: names, shapes, units, wires, versions; written before the first row
    ├── rows.f64       the samples: little-endian 64-bit floats, one row after the other, t first
    ├── events.jsonl   one event a line
    └── end.json       the run's end; missing where it was killed, or still runs

``np.fromfile("rows.f64", "<f8").reshape(-1, n)`` reads the samples, n being the number of names in ``columns`` of the
header. Rows are only ever appended, so they stay readable once written. A row that was cut off is left out.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from io import FileIO
from pathlib import Path
from typing import Any, NotRequired, TextIO, TypedDict, overload

import numpy as np

from ...blocks.core import (
    Layout,
    OptionError,
    check_argument,
    count_of,
    describe_disk_error,
    explain_calls,
    explain_disk_errors,
    kinds,
)
from ..wiring import Wire
from .recorded_signals import RecordedSignals

FORMAT, VERSION = "loopwright run", 1
HEADER, ROWS, EVENTS, END = "header.json", "rows.f64", "events.jsonl", "end.json"
SWEEP_HEADER = "sweep.json"
"""Header in the folder of a sweep, which is no run."""
_BLOCK = 2**24  # bytes written at once

OTHER_PATH = "Choose another path."
"""Step where a run's folder can't be used."""

PathLike = str | os.PathLike[str]


@explain_calls
@dataclass(frozen=True)
class Occurrence:
    """An event that fired: its time in s, the block's path, the event's name, and the states around the jump."""

    t: float
    block: str
    event: str
    before: Mapping[str, Any] = field(default_factory=dict)
    after: Mapping[str, Any] = field(default_factory=dict)


@explain_calls
@dataclass(frozen=True)
class Stopped:
    """The end of a run before its duration was over, by a stop condition, or by an FMU that has asked for it.

    Attributes
    ----------
    t : float
        Time in s.
    block : str
        Path of the block or FMU.
    """

    t: float
    block: str


class SignalEntry(TypedDict):
    """A port in a header: ``first`` is its first entry in the vector of a sample."""

    name: str
    shape: list[int]
    first: int
    unit: str | Sequence[str] | None


class WireEntry(TypedDict):
    """A named wire in a header; a slice is written as ``{"slice": [start, stop, step]}``."""

    block: str
    port: str
    index: int | dict[str, list[int | None]] | None


class VectorEntry(TypedDict):
    """The vector of a sample in a header."""

    width: int
    columns: list[int] | None
    has_states: bool
    residual: bool


class Header(TypedDict):
    """The header of a stored run."""

    format: str
    version: int
    diagram: str
    created: str
    versions: dict[str, str]
    columns: list[str]
    signals: list[SignalEntry]
    wires: dict[str, WireEntry]
    vector: VectorEntry
    outputs: NotRequired[Mapping[str, Sequence[str]]]


class End(TypedDict, total=False):
    """The end of a stored run."""

    elapsed: float
    messages: list[str]
    texts: dict[str, list[list[Any]]]
    stopped: dict[str, Any] | None


def header(diagram: str, signals: RecordedSignals, *, residual: bool = False) -> Header:
    """Return the header of a run of ``diagram``; with ``residual`` each row ends with that of the algebraic loops."""
    # Entries count from 1 and have their port's name: other tools read these column names.
    layout, units, width, columns = signals.layout, signals.units, signals.width, signals.columns
    entries = [""] * width
    for name, where in layout.slices.items():
        many = layout.shapes[name] != ()
        for i, k in enumerate(range(where.start, where.stop)):
            entries[k] = f"{name}[{i + 1}]" if many else name
    entries[layout.total :] = [f"x[{i + 1}]" for i in range(width - layout.total)]
    kept = range(width) if columns is None else [int(c) for c in columns]
    return {
        "format": FORMAT,
        "version": VERSION,
        "diagram": diagram,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"loopwright": own_version(), "numpy": np.__version__, "python": platform.python_version()},
        "columns": ["t", *(entries[k] for k in kept), *(["residual"] if residual else [])],
        "signals": [
            {"name": n, "shape": list(layout.shapes[n]), "first": s.start, "unit": units.get(n)}
            for n, s in layout.slices.items()
        ],
        "wires": {
            name: {"block": w.block, "port": w.port, "index": _index_to_json(w.index)}
            for name, w in signals.wires.items()
        },
        "vector": {
            "width": width,
            "columns": None if columns is None else list(kept),
            "has_states": signals.has_states,
            "residual": residual,
        },
        "outputs": {path: list(names) for path, names in signals.outputs.items()},
    }


def prepare(folder: Path, overwrite: bool) -> None:
    """Check that a run may be written to a folder, without writing."""
    place = os.fspath(folder)
    with explain_disk_errors(f"the run can't be kept in {place!r}", place, OTHER_PATH, OptionError):
        if not folder.exists():
            return
        if not folder.is_dir():
            raise OptionError(f"found a file at {place!r}; expected a folder, or nothing. Choose another path.")
        if any(folder.iterdir()) and not (folder / HEADER).is_file():
            raise OptionError(f"found a folder at {place!r} that holds other things than a run. Choose another path.")
        if (folder / HEADER).is_file() and not overwrite:
            raise OptionError(
                f"found a run at {place!r} already. Choose another path, or give overwrite=True to replace it."
            )


def create(folder: Path, head: Mapping[str, object]) -> tuple[FileIO, TextIO]:
    """Write the header, and return the open files for rows and events; an earlier run that a reader has open stays."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in (HEADER, END, EVENTS, ROWS):
        (folder / name).unlink(missing_ok=True)
    rows = open(folder / ROWS, "xb", buffering=0)  # noqa: SIM115 - both stay open for the run
    events = open(folder / EVENTS, "x", encoding="utf-8")  # noqa: SIM115
    write_json(folder / HEADER, head)
    return rows, events


def write_json(path: Path, value: Mapping[str, object]) -> None:
    """Write a file as a whole: a reader finds all of it, or no file."""
    part = path.with_name(path.name + ".part")
    with open(part, "w", encoding="utf-8") as file:
        json.dump(value, file, ensure_ascii=False, indent=1, default=_to_json)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def event_line(event: Occurrence) -> str:
    """Return the line of an event."""
    return json.dumps(asdict(event), ensure_ascii=False, default=_to_json) + "\n"


def write(folder: Path, head: Header, parts: Sequence[np.ndarray], events: Iterable[Occurrence], **end: object) -> None:
    """Write a run that is complete; see `Run.save`. DiskError: it can't be written.

    ``parts`` are times, (n, 1), samples, (n, columns), and residuals, (n, 1), where there are any; ``end`` as in `End`.
    """
    events, n = list(events), _BLOCK // (8 * len(head["columns"])) + 1
    with explain_disk_errors(f"the run can't be written to {os.fspath(folder)!r}", folder, OTHER_PATH):
        rows, lines = create(folder, head)
        with rows, lines:
            for k in range(0, len(parts[0]), n):
                left = np.ascontiguousarray(np.hstack([part[k : k + n] for part in parts]), "<f8").data.cast("B")
                while left:
                    left = left[rows.write(left) :]
            lines.writelines(map(event_line, events))
            lines.flush()
            for file in (rows, lines):
                os.fsync(file.fileno())
        write_json(folder / END, end)


class StoredEvents(Sequence[Occurrence]):
    """The events of a stored run, read at first use."""

    def __init__(self, path: Path):
        self.path = path

    @cached_property
    def _all(self) -> tuple[Occurrence, ...]:
        if not self.path.is_file():
            return ()
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
        return tuple(Occurrence(**json.loads(text)) for text in lines if text.endswith("\n"))

    def __len__(self) -> int:
        return len(self._all)

    @overload
    def __getitem__(self, k: int) -> Occurrence: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[Occurrence, ...]: ...
    def __getitem__(self, k: int | slice) -> Occurrence | tuple[Occurrence, ...]:
        return self._all[k]

    def __iter__(self) -> Iterator[Occurrence]:
        return iter(self._all)

    def __repr__(self) -> str:
        return repr(self._all)


@dataclass(frozen=True)
class Stored:
    """A stored run as it is read; the samples stay on disk until they are used."""

    head: Header
    end: End | None
    """The run's end; None where it was killed, or still runs."""
    t: np.ndarray
    data: np.ndarray
    residual: np.ndarray | None
    events: StoredEvents

    @property
    def signals(self) -> RecordedSignals:
        """The signals that were recorded."""
        ports, wires, vector = self.head["signals"], self.head["wires"], self.head["vector"]
        shapes = {s["name"]: tuple(s["shape"]) for s in ports}
        first = {s["name"]: s["first"] for s in ports}
        places = {n: slice(k, k + int(np.prod(shapes[n], dtype=int))) for n, k in first.items()}
        units = ((s["name"], s["unit"]) for s in ports)
        return RecordedSignals(
            Layout(places, shapes),
            {name: Wire(w["block"], w["port"], _index_from_json(w["index"])) for name, w in wires.items()},
            {name: unit if isinstance(unit, str) else tuple(unit) for name, unit in units if unit is not None},
            vector["width"],
            None if vector["columns"] is None else np.array(vector["columns"], dtype=int),
            vector["has_states"],
            stored_outputs=self.head.get("outputs", {}),
        )


def _describe_other(folder: Path) -> tuple[str, str]:
    """Return what is where a run was looked for, and the next step."""
    if not folder.exists():
        return "nothing", "Check the path."
    if folder.is_file():
        step = "Give the folder of a run; exported files are read by pandas, and by Recorded.from_csv as a source."
        return "a file", step
    if (folder / SWEEP_HEADER).is_file():
        return "a sweep", f"diagram.sweep(…, to={os.fspath(folder)!r}) with the same samples reads it."
    runs = sorted(one.name for one in folder.iterdir() if (one / HEADER).is_file())
    if runs:
        return (
            f"a folder of {count_of(len(runs), 'run')}",
            f"Open one of them: Run.open({os.fspath(folder / runs[0])!r}).",
        )
    if (folder / HEADER).is_file():
        return "a damaged header", "Simulate again, or copy the folder again."
    return "a folder of other files", "Check the path."


def read(path: PathLike) -> Stored:
    """Open a stored run."""
    check_argument(path, kinds.path, "path", "Run.open")
    folder, place = Path(path), os.fspath(path)
    try:
        head: Header = json.loads((folder / HEADER).read_text(encoding="utf-8"))
        if head["format"] != FORMAT:
            raise KeyError("format")
    except PermissionError as error:
        step = "Copy it to a folder that you can read."
        raise OptionError(f"the run at {place!r} can't be read: {describe_disk_error(error, place, step)}") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        found, step = _describe_other(folder)
        raise OptionError(
            f"found {found} at {place!r}, and no stored run; expected a folder with a {HEADER}, as run.save(path) and "
            f"simulate(…, to=path) write it. {step}"
        ) from error
    if head["version"] != VERSION:
        raise OptionError(
            f"found a run of version {head['version']} of the format at {place!r}; this loopwright reads version "
            f"{VERSION}. Open it with loopwright {head['versions']['loopwright']}."
        )
    ended = folder / END
    end = json.loads(ended.read_text(encoding="utf-8")) if ended.is_file() else None
    t, data, residual = split(_read_rows(folder / ROWS, len(head["columns"])), head["vector"]["residual"])
    return Stored(head, end, t, data, residual, StoredEvents(folder / EVENTS))


def split(rows: np.ndarray, residual: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return times, samples and residuals of rows, as views."""
    return rows[:, 0], rows[:, 1 : -1 if residual else None], rows[:, -1] if residual else None


def _read_rows(path: Path, width: int) -> np.ndarray:
    n = path.stat().st_size // (8 * width) if path.is_file() else 0
    if n == 0:
        return np.zeros((0, width))  # an empty file can't be mapped
    return np.asarray(np.memmap(path, "<f8", mode="r", shape=(n, width)))


def _to_json(value: object) -> object:
    if isinstance(value, Mapping | Stopped):
        return dict(value) if isinstance(value, Mapping) else asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} can't be stored")


def _index_to_json(index: int | slice | None) -> int | dict[str, list[int | None]] | None:
    return {"slice": [index.start, index.stop, index.step]} if isinstance(index, slice) else index


def _index_from_json(index: int | dict[str, list[int | None]] | None) -> int | slice | None:
    return slice(*index["slice"]) if isinstance(index, dict) else index


@cache
def own_version() -> str:
    """Return the version of loopwright that is installed."""
    try:
        return version("loopwright")
    except PackageNotFoundError:
        return "unknown"
