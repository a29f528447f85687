"""The record of a page in a notebook, which comes back to Python while the page runs.

A page is an inline frame, the same in every notebook and on every web page. Where a kernel runs, a widget without a
view (anywidget) listens to that frame, and passes its samples on. So a notebook that is opened without a kernel shows
the page, and nothing is missing but the way back.
"""

from __future__ import annotations

import secrets
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Change:
    """A number that was moved on a page.

    ``after``: number of samples since the reset that there were; it acts at the next one.
    ``t``: time of the last one of them in s; None: there was none, so that it is a start value.
    """

    after: int
    t: float | None
    name: str
    value: float


@dataclass
class PageRecord:
    """Samples that a page has sent since its last reset, and what was moved.

    ``width``: numbers of a sample: the time and the columns.
    ``key``: what a page and its listener know each other by.
    """

    width: int
    key: str = field(default_factory=lambda: secrets.token_hex(8))
    _of: tuple[object, object] | None = None
    _parts: list[np.ndarray] = field(default_factory=list)
    _changes: dict[tuple[int, str], Change] = field(default_factory=dict)
    _first: int = 0
    _listener: Any = None
    message: str = ""

    @property
    def rows(self) -> np.ndarray:
        """All samples, one a row."""
        if len(self._parts) != 1:
            self._parts = [np.concatenate([np.empty((0, self.width)), *self._parts])]
        return self._parts[0]

    @property
    def changes(self) -> list[Change]:
        """What was moved, in order."""
        return list(self._changes.values())

    def take(self, _: object, content: Mapping[str, Any], buffers: Sequence[Any]) -> None:
        """Take a message of a page: samples from a number on, and changes.

        The page that was shown or reset last has the record. One that begins to listen late gets all that there is.
        """
        of, first = (content.get("view"), content.get("run")), int(content["first"])
        rows = np.frombuffer(bytes(buffers[0]), dtype="<f8").reshape(int(content["count"]), self.width)
        if of != self._of:
            self._of, self._parts, self._changes, self._first = of, [], {}, first
        known = sum(map(len, self._parts)) + self._first
        if first < known:
            self._parts = [self.rows[: max(0, first - self._first)]]
        elif first > known:  # the page has dropped what it couldn't keep
            self._parts, self._first = [], first
        self._parts.append(rows)
        for one in content["changes"]:
            made = Change(int(one["after"]), one["t"], str(one["name"]), float(one["value"]))
            self._changes[made.after, made.name] = made
        self.message = str(content.get("message", ""))

    def listen(self) -> bool:
        """Let the notebook pass on what the page sends; False where there is no kernel, or no anywidget."""
        if self._listener is None and runs_in_kernel():
            try:
                self._listener = _make_listener(self.key, self.take)
            except ImportError:
                return False
        return self._listener is not None


def runs_in_kernel() -> bool:
    """Return whether this is a notebook's process."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def _make_listener(key: str, take: Callable[..., None]) -> Any:
    """Return the widget that listens; it is never shown."""
    import anywidget
    import traitlets

    class PageListener(anywidget.AnyWidget):
        _esm = files(__package__).joinpath("page", "notebook.js").read_text(encoding="utf-8")
        key = traitlets.Unicode().tag(sync=True)

    made = PageListener(key=key)
    made.on_msg(take)
    return made
