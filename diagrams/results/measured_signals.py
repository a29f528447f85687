"""Measured data that a plot draws over the signals of a run: pairs of arrays, tables of arrays, and data frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import OptionError, enumerate_some, shorten

if TYPE_CHECKING:
    from .plots import DrawnSignal

TIMES = ("t", "time", "Time")
"""Names of a table's column of times, s."""
Data = tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike] | Any
"""Measured data: times and samples of one signal, or columns by name with the times in "t"; also a data frame."""
_FORMS = '(t, y), {"t": t, "speed": y} or a data frame with a column "t"'


class MeasuredSignals:
    """Samples of some signals, at their own times.

    ``data`` is a pair of times in s, (N,), and samples of one signal, (N, …); or columns by name, with the times in
    ``"t"`` or ``"time"``, of a data frame also in its index. ``label`` is for the legend.
    """

    def __init__(self, data: Any, label: str):
        self.label = label
        self._signals: dict[str | None, np.ndarray] = {}  # None: of the only signal that is drawn
        columns = _columns_of(data)
        if columns is None:
            self.t, values = self._read(data[0], "t"), self._read(data[1], "y")
            self._signals[None] = values
        else:
            times = next((name for name in TIMES if name in columns), None)
            index = getattr(data, "index", None)
            self.t = self._read(index if times is None else columns[times], times or "its index")
            self._signals.update({name: self._read(one, name) for name, one in columns.items() if name not in TIMES})
        if self.t.ndim != 1 or not self._signals:
            raise self._error(f"found times of shape {self.t.shape} and {len(self._signals)} signals")
        for name, values in self._signals.items():
            if values.shape[:1] != self.t.shape:
                raise self._error(f"found {len(self.t)} times and samples of shape {values.shape} of {name or 'y'}")

    def drawn(self, like: DrawnSignal) -> DrawnSignal | None:
        """Return the samples of a signal of a run, as it is drawn; None where there are none."""
        from .plots import DrawnSignal

        values = self._signals.get(None, self._signals.get(like.name))
        if values is None:
            return None
        if values.shape[1:] != like.values.shape[1:]:
            raise self._error(
                f"found samples of shape {values.shape} of {like.name}, which is {like.values.shape} in the run"
            )
        return DrawnSignal(like.name, self.t, values, like.units, self.label)

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse data of which nothing is drawn, and a pair where several signals are drawn."""
        if None in self._signals:
            if len(names) > 1:
                raise OptionError(
                    f"found a pair (t, y), which is one signal, and {len(names)} signals to draw; expected columns by "
                    f'name. Write {{"t": t, "{names[0]}": y}}.',
                    block="Run.plot",
                    port=f"against[{self.label!r}]",
                )
        elif not {*names} & {*self._signals}:
            raise OptionError(
                f"found the columns {enumerate_some([*map(repr, self._signals)])}; expected one of the signals that "
                f"are drawn, {enumerate_some([*map(repr, names)])}. Rename a column.",
                block="Run.plot",
                port=f"against[{self.label!r}]",
            )

    def _read(self, values: Any, name: object) -> np.ndarray:
        try:
            found = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            raise self._error(f"found {shorten(values):.40} … as {name}") from None
        return found

    def _error(self, found: str) -> OptionError:
        return OptionError(
            f"{found}; expected numbers at times in s, {_FORMS}. Give as many times as samples.",
            block="Run.plot",
            port=f"against[{self.label!r}]",
        )


def split_measured(against: Any) -> tuple[Any, list[MeasuredSignals]]:
    """Return what may be runs by their names, or None without any, and the measured data next to them."""
    if _is_measured(against):
        return None, [MeasuredSignals(against, "measured")]
    if not isinstance(against, Mapping):
        return against, []
    data = [MeasuredSignals(one, str(name)) for name, one in against.items() if _is_measured(one)]
    runs = {name: one for name, one in against.items() if not _is_measured(one)}
    return (runs or None if data else against), data


def _is_measured(value: object) -> bool:
    """Whether a value is meant as measured data, and not as a run, or runs by their names."""
    is_pair = isinstance(value, tuple | list) and len(value) == 2 and all(np.ndim(one) > 0 for one in value)
    return is_pair or _columns_of(value) is not None


def _columns_of(value: Any) -> dict[str, Any] | None:
    """Return the columns of a table by name; None for anything else."""
    if isinstance(value, Mapping):
        arrays = value and all(
            isinstance(one, np.ndarray | list | tuple) or hasattr(one, "to_numpy") for one in value.values()
        )
        return dict(value) if arrays and any(name in value for name in TIMES) else None
    if hasattr(value, "columns") and hasattr(value, "to_numpy"):  # of pandas, polars
        return {str(name): value[name] for name in value.columns}
    return None
