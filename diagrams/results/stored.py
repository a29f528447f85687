"""Runs on disk: a folder that any tool can read.

::

    run/
    ├── header.json    what the columns are: names, shapes, units, wires, versions; written before the first row
    ├── rows.f64       the samples: little-endian 64-bit floats, one row after the other, t first
    ├── events.jsonl   one event a line
    └── end.json       how the run ended; missing where it was killed, or still runs

``np.fromfile("rows.f64", "<f8").reshape(-1, n)`` is all it takes, n being the number of names in ``columns`` of the
header. Rows are only ever appended, so what was once written stays readable; a row that was cut off is left out.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core.errors import OptionError
from ...blocks.core.layout import Layout
from ..wiring.structure import Wire

FORMAT, VERSION = "loopwright run", 1
HEADER, ROWS, EVENTS, END = "header.json", "rows.f64", "events.jsonl", "end.json"
_BLOCK = 2**24  # bytes written at once


@dataclass(frozen=True)
class Occurrence:
    """An event that fired: when (s), which block by its path, which of its events, and its states around the jump."""

    t: float
    block: str
    event: str
    before: Mapping[str, Any] = field(default_factory=dict)
    after: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stopped:
    """What ended a run before its duration was over: when (s), and the path of the stop condition's block."""

    t: float
    block: str


def header(
    *,
    diagram: str,
    layout: Layout,
    wires: Mapping[str, Wire],
    units: Mapping[str, Any],
    width: int,
    columns: Any = None,
    has_states: bool = True,
    residual: bool = False,
) -> dict[str, Any]:
    """Return the header of a stored run.

    Parameters
    ----------
    diagram : str
        The diagram's name.
    layout : Layout
        Where each port's entries stand in the vector of a sample; the states follow them.
    wires, units : mapping
        Named wires, and units of ports.
    width : int
        Entries of that vector, without the residual.
    columns : sequence of int, optional
        Entries that are recorded; None for all.
    has_states : bool
        Whether the states are among them.
    residual : bool
        Whether each row ends with the residual of the algebraic loops.
    """
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
            name: {"block": w.block, "port": w.port, "index": _index_to_json(w.index)} for name, w in wires.items()
        },
        "vector": {
            "width": width,
            "columns": None if columns is None else list(kept),
            "has_states": has_states,
            "residual": residual,
        },
    }


def prepare(folder: Path, overwrite: bool) -> None:
    """Check that a run may be written to a folder; nothing is written yet.

    Raises
    ------
    OptionError
        If something stands there that may not be replaced.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise OptionError(f"found a file at {os.fspath(folder)!r}; expected a folder, or nothing. Choose another path.")
    if any(folder.iterdir()) and not (folder / HEADER).is_file():
        raise OptionError(
            f"found a folder at {os.fspath(folder)!r} that holds other things than a run. Choose another path."
        )
    if (folder / HEADER).is_file() and not overwrite:
        raise OptionError(
            f"found a run at {os.fspath(folder)!r} already. Choose another path, or give overwrite=True to replace it."
        )


def create(folder: Path, head: Mapping[str, Any]) -> tuple[Any, Any]:
    """Write the header, and return the open files for rows and events.

    Files of an earlier run are removed, not emptied: whoever still has them open goes on reading what was there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (HEADER, END, EVENTS, ROWS):
        (folder / name).unlink(missing_ok=True)
    rows = open(folder / ROWS, "xb", buffering=0)  # noqa: SIM115 - they stay open for the run
    events = open(folder / EVENTS, "x", encoding="utf-8")  # noqa: SIM115
    write_json(folder / HEADER, head)
    return rows, events


def write_json(path: Path, value: Any) -> None:
    """Write a file as a whole: whoever reads it finds all of it, or no file."""
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


def write(folder: Path, run: Any, overwrite: bool) -> None:
    """Write a run that is at hand; see `Run.save`."""
    prepare(folder, overwrite)
    beyond = run.data.shape[1] if run.columns is None else int(np.sum(run.columns >= run.layout.total))
    head = header(
        diagram=run.diagram_name,
        layout=run.layout,
        wires=run.wires,
        units=run.units,
        width=beyond if run.columns is None else run.layout.total + beyond,
        columns=run.columns,
        has_states=run.has_states,
        residual=run.residual is not None,
    )
    events, n = list(run.events), _BLOCK // (8 * len(head["columns"])) + 1
    rows, lines = create(folder, head)
    with rows, lines:
        for k in range(0, len(run.t), n):
            some = slice(k, k + n)
            parts = [run.t[some, None], run.data[some], *([] if run.residual is None else [run.residual[some, None]])]
            left = np.ascontiguousarray(np.hstack(parts), "<f8").data.cast("B")
            while left:
                left = left[rows.write(left) :]
        lines.writelines(map(event_line, events))
        lines.flush()
        for file in (rows, lines):
            os.fsync(file.fileno())
    write_json(folder / END, {"elapsed": run.elapsed, "messages": run.messages, "stopped": run.stopped})


class StoredEvents(Sequence[Occurrence]):
    """The events of a stored run, read when they are first asked for."""

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

    def __getitem__(self, k: Any) -> Any:
        return self._all[k]

    def __iter__(self) -> Iterator[Occurrence]:
        return iter(self._all)

    def __repr__(self) -> str:
        return repr(self._all)


@dataclass(frozen=True)
class Stored:
    """A stored run as it is read; the samples stay on disk until they are used."""

    head: dict[str, Any]
    end: dict[str, Any] | None
    """How the run ended; None where it was killed, or still runs."""
    t: np.ndarray
    data: np.ndarray
    residual: np.ndarray | None
    events: StoredEvents

    @property
    def columns(self) -> np.ndarray | None:
        """Which entries of a sample's vector were recorded, None for all."""
        chosen = self.head["vector"]["columns"]
        return None if chosen is None else np.array(chosen, dtype=int)

    @property
    def layout(self) -> Layout:
        """Where each port's entries stand in that vector."""
        shapes = {s["name"]: tuple(s["shape"]) for s in self.head["signals"]}
        first = {s["name"]: s["first"] for s in self.head["signals"]}
        return Layout({n: slice(k, k + int(np.prod(shapes[n], dtype=int))) for n, k in first.items()}, shapes)

    @property
    def wires(self) -> dict[str, Wire]:
        """The named wires."""
        found = self.head["wires"].items()
        return {name: Wire(w["block"], w["port"], _index_from_json(w["index"])) for name, w in found}

    @property
    def units(self) -> dict[str, Any]:
        """The units of ports."""
        return {s["name"]: _to_tuples(s["unit"]) for s in self.head["signals"] if s["unit"] is not None}


def read(folder: Path) -> Stored:
    """Open a stored run.

    Raises
    ------
    OptionError
        If there is none, or one of another version.
    """
    place = os.fspath(folder)
    try:
        head = json.loads((folder / HEADER).read_text(encoding="utf-8"))
        if head["format"] != FORMAT:
            raise KeyError("format")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OptionError(
            f"found no stored run at {place!r}; expected a folder with a {HEADER}, as run.save(path) and "
            "simulate(…, to=path) write it. Check the path."
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


def _to_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Stopped):
        return asdict(value)
    raise TypeError(f"{type(value).__name__} can't be stored")


def _to_tuples(value: Any) -> Any:
    return tuple(_to_tuples(v) for v in value) if isinstance(value, list) else value


def _index_to_json(index: Any) -> Any:
    return {"slice": [index.start, index.stop, index.step]} if isinstance(index, slice) else index


def _index_from_json(index: Any) -> Any:
    return slice(*index["slice"]) if isinstance(index, dict) else index


def own_version() -> str:
    """Return the version of loopwright that is installed."""
    try:
        return version("loopwright")
    except PackageNotFoundError:
        return "unknown"
