"""A sweep on disk: a folder of parts, each of which appears whole or not at all."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Mapping
from pathlib import Path
from time import monotonic
from typing import Any
from zipfile import BadZipFile

import numpy as np

from ...blocks.core import OptionError, explain_disk_errors, replace_file, write_text
from ..results import SWEEP_HEADER
from .outcome import WORKER_ENDED, Failure, SampleOutcome
from .revision import Parts, describe_differences, digest_of

HEAD = SWEEP_HEADER
_FORMAT = 2
_EVERY = 1.0  # s between two parts


class Store:
    """Keeps outcomes in a folder, which it makes, and finds those that are there; ``about`` is for its readers."""

    def __init__(self, folder: Path, parts: Parts, about: dict[str, Any], *, overwrite: bool = False):
        own = {"block": str(about.get("diagram", "")) or None, "port": "to"}
        step = "Choose your own folder, such as to='sweeps/first'."
        with explain_disk_errors(f"the sweep can't be kept in {str(folder)!r}", folder, step, OptionError, **own):
            self.folder = folder.absolute()  # loading an FMU changes the working folder for a moment
            self._open(parts, about, overwrite=overwrite)
        self._waiting: list[tuple[str, SampleOutcome]] = []
        self._last = monotonic()

    def _open(self, parts: Parts, about: dict[str, Any], *, overwrite: bool) -> None:
        folder, head, revision = self.folder, self.folder / HEAD, digest_of(parts)
        if folder.exists() and not folder.is_dir():
            raise OptionError(f"found a file at {str(folder)!r}; expected a folder, or nothing. Choose another path.")
        if head.is_file():
            try:
                found = json.loads(head.read_text(encoding="utf-8"))
                fits = found["format"] == _FORMAT and found["revision"] == revision and "diagram" in found
            except (ValueError, KeyError, TypeError):  # no text, no JSON, or that of others
                found, fits = {}, False
            if not found and not overwrite:
                raise OptionError(
                    f"the file {str(head)!r} is damaged, or of something else; expected the head of a sweep. Choose "
                    "another folder, or replace the sweep in this one with overwrite=True."
                )
            if not fits and not overwrite:
                raise OptionError(
                    f"the folder {str(folder)!r} holds a sweep of {found.get('diagram')!r} that differs from this one "
                    f"in {_describe(found, parts)}. Choose another folder, or replace it with overwrite=True."
                )
            if not fits:
                self._remove()
        elif folder.exists() and any(folder.iterdir()):
            raise OptionError(
                f"the folder {str(folder)!r} holds other files, and no sweep. Choose another one, or an empty one."
            )
        folder.mkdir(parents=True, exist_ok=True)
        if not head.is_file():
            write_text(
                head,
                json.dumps({"format": _FORMAT, "revision": revision, **about, "parts": parts}, indent=1) + "\n",
            )

    def _remove(self) -> None:
        """Remove the sweep, and nothing else in its folder."""
        for path in (*self.folder.glob("part-*.npz"), self.folder / HEAD):
            path.unlink()

    def read(self) -> dict[str, SampleOutcome]:
        """Return the outcomes that are there, by the keys of their samples; unfinished parts don't count."""
        found: dict[str, SampleOutcome] = {}
        for path in sorted(self.folder.glob("part-*.npz")):
            found.update(_read_part(path))
        return found

    def add(self, key: str, outcome: SampleOutcome) -> None:
        """Keep an outcome; it is on disk within about a second, or after `flush`."""
        if outcome.failure is None or outcome.failure.kind != WORKER_ENDED:
            self._waiting.append((key, outcome))
        if monotonic() - self._last > _EVERY:
            self.flush()

    def flush(self) -> None:
        """Write what was not written yet."""
        if self._waiting:
            failed = f"the sweep can't be written to {str(self.folder)!r}; a later call takes what is there already"
            with explain_disk_errors(failed, self.folder, "Choose another folder for to=….", OptionError, port="to"):
                _write_part(self.folder / f"part-{secrets.token_hex(8)}.npz", self._waiting)
        self._waiting = []
        self._last = monotonic()


def _describe(found: Mapping[str, Any], parts: Parts) -> str:
    """Return in words in what a stored sweep differs from this one."""
    if found.get("format") != _FORMAT:
        return "the version of Loopwright that wrote it"
    kinds = found.get("parts")
    known = {kind: part for kind, part in kinds.items() if isinstance(part, dict)} if isinstance(kinds, dict) else {}
    return describe_differences(known, parts) or "its head, which was changed by hand"


def _write_part(path: Path, outcomes: Iterable[tuple[str, SampleOutcome]]) -> None:
    heads, arrays = [], dict[str, np.ndarray]()
    for place, (key, outcome) in enumerate(outcomes):
        failure = None if outcome.failure is None else vars(outcome.failure)
        heads.append(
            {
                "key": key,
                "numbers": [*outcome.numbers],
                "signals": [*outcome.signals],
                "has_t": outcome.t is not None,
                "end": outcome.end,
                "stopped": outcome.stopped,
                "failure": failure,
                "units": dict(outcome.units),
                "messages": [*outcome.messages],
            }
        )
        arrays |= {f"{place}.n{k}": value for k, value in enumerate(outcome.numbers.values())}
        arrays |= {f"{place}.s{k}": value for k, value in enumerate(outcome.signals.values())}
        if outcome.t is not None:
            arrays[f"{place}.t"] = outcome.t
    arrays["heads"] = np.frombuffer(json.dumps(heads).encode(), dtype=np.uint8)
    save: Any = np.savez
    with replace_file(path) as fresh:
        save(fresh, **arrays)


def _read_part(path: Path) -> dict[str, SampleOutcome]:
    found: dict[str, SampleOutcome] = {}
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as part:
            for place, head in enumerate(json.loads(part["heads"].tobytes())):
                failure = head["failure"]
                found[head["key"]] = SampleOutcome(
                    -1,
                    {name: part[f"{place}.n{k}"] for k, name in enumerate(head["numbers"])},
                    part[f"{place}.t"] if head["has_t"] else None,
                    {name: part[f"{place}.s{k}"] for k, name in enumerate(head["signals"])},
                    head["end"],
                    head["stopped"],
                    None if failure is None else Failure(**failure),
                    head["units"],
                    tuple(head["messages"]),
                )
    except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile) as error:
        raise OptionError(
            f"the file {str(path)!r} of a sweep can't be read: {error}. Remove it; its samples are then run again."
        ) from error
    return found
