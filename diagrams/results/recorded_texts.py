"""Texts and binary data in the record of a run."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from ...blocks.core import OptionError, explain_calls

Text = str | bytes | tuple[str, ...] | tuple[bytes, ...]


@explain_calls
@dataclass(frozen=True)
class TextSignal:
    """A text or binary data over time: each value holds from its time until the next one.

    Attributes
    ----------
    t : tuple of float
        Times in s at which the value changed, the start of the record first.
    values : tuple of str, bytes or tuples of these
        The values, one for each time; that of an array is a tuple of its elements.

    Examples
    --------
    >>> mode = TextSignal((0.0, 0.3), ("heating", "resting"))
    >>> mode.at(0.2), mode.at(0.3)
    ('heating', 'resting')
    """

    t: tuple[float, ...]
    values: tuple[Text, ...]

    @classmethod
    def of(cls, changes: Iterable[tuple[float, Text]]) -> TextSignal:
        """Return the signal of (time, value) pairs."""
        pairs = list(changes)
        return cls(tuple(t for t, _ in pairs), tuple(value for _, value in pairs))

    def at(self, t: float) -> Text:
        """Return the value at a time in s.

        Raises
        ------
        OptionError
            For a time before the record.
        """
        k = bisect_right(self.t, t + 4.0 * math.ulp(t))  # the end of a step is rounded, t + h
        if not k:
            begins = f"the record begins at {self.t[0]:.9g} s" if self.t else "nothing was recorded"
            raise OptionError(f"found t = {t:.9g} s; {begins}. Ask for a time within the run.", port="t")
        return self.values[k - 1]

    def to_json(self) -> list[list[Any]]:
        """Return it for a file in JSON; bytes become ``{"hex": …}``."""
        return [[t, _encode(value)] for t, value in zip(self.t, self.values, strict=True)]

    @classmethod
    def from_json(cls, rows: Sequence[Sequence[Any]]) -> TextSignal:
        """Return the signal that `to_json` has written."""
        return cls.of((t, _decode(value)) for t, value in rows)


def _encode(value: Text) -> Any:
    if isinstance(value, tuple):
        return [_encode(element) for element in value]
    return {"hex": value.hex()} if isinstance(value, bytes) else value


def _decode(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_decode(element) for element in value)
    return bytes.fromhex(value["hex"]) if isinstance(value, dict) else value
