"""Sources that play a table over time: straight lines between points, and recorded data of files and data frames."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np

from ..core import (
    Array,
    Kind,
    OptionError,
    ParameterError,
    Source,
    UnknownNameError,
    accepts,
    explain_disk_errors,
    kinds,
    move_earlier,
    near,
    parameter,
    shorten,
)
from .piecewise_functions import piecewise

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


class _Table(Source):
    """Base of the sources that read a table over time."""

    times: Array = parameter(
        unit="s",
        structural=True,
        description="times of the values, rising",
        kind=Kind(
            "a list of rising times, one or more",
            lambda times: np.ndim(times) == 1 and np.size(times) > 0 and bool(np.all(np.diff(times) > 0)),
            "Sort them, with their values, and leave out repeated ones.",
            lambda name, times: f"found times of shape {np.shape(times)}",
        ),
    )
    values: Array = parameter(structural=True, description="a value for each time: numbers, or a vector in each row")

    def check(self) -> None:
        """Refuse values that don't fit the times."""
        super().check()
        times, values = np.shape(self.times), np.shape(self.values)
        if len(values) not in (1, 2) or values[0] != times[0]:
            raise ParameterError(
                f"found values of shape {values} for {times[0]} times; expected shape ({times[0]},), or "
                f"({times[0]}, n) for vectors of n entries. Give one row of values for each time (values.T turns "
                "columns into rows).",
                port="values",
            )

    def piece_starts(self) -> np.ndarray:
        """Return the beginnings of the pieces after each time."""
        times: np.ndarray = self.times
        return times

    @property
    def slopes(self) -> np.ndarray:
        """Slopes between the times, one row for each, for linear interpolation."""
        columns = np.reshape(self.values, (len(self.times), -1))
        result: np.ndarray = np.diff(columns, axis=0) / np.diff(self.times)[:, None]
        return result

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value at t, from one piece before the first time, those between, and one after the last."""
        columns = np.reshape(self.values, (len(self.times), -1))
        still = np.zeros((1, columns.shape[1]))
        coefficients = np.stack(
            [np.concatenate([columns[:1], columns]), np.concatenate([still, self.slopes, still])], axis=2
        )
        span, times = 1.0 + np.abs(self.times[[0, -1]]), self.piece_starts()
        breaks = np.concatenate([[times[0] - span[0]], times, [times[-1] + span[1]]])
        y = piecewise(breaks, coefficients, t)
        return y if np.ndim(self.values) == 2 else y[0]


class PiecewiseLinear(_Table):
    """Straight lines through points, y(times[i]) = values[i]; beyond the ends the first and the last value are held.

    Raises
    ------
    ParameterError
        For times that don't rise, or not one value for each.
    """

    def instants(self) -> Array:
        """Return the times at which the slope changes."""
        slopes = self.slopes
        still = np.zeros((1, slopes.shape[1]))
        changes = np.abs(np.diff(np.concatenate([still, slopes, still]), axis=0))
        return self.times[np.any(changes > 1e-12 * np.max(np.abs(slopes), initial=0.0), axis=1)]


_FRAME = Kind("a pandas DataFrame or Series", lambda value: all(hasattr(value, name) for name in ("index", "to_numpy")))


class Recorded(_Table):
    """Recorded data: y is interpolated between the samples; beyond them the first and the last value are held.

    ``linear`` interpolates, ``previous`` holds each value until the next time, as a sampled signal does; the times may
    be off by their rounding, as those of ``np.linspace`` are. A solver lands on every sample, in a continuous
    subsystem.

    Raises
    ------
    ParameterError
        For times that don't rise, not one value for each, or another interpolation.
    """

    interpolation: str = parameter(
        default="linear", description="'linear' or 'previous'", kind=kinds.choice("linear", "previous")
    )

    @classmethod
    @accepts("{cls.__name__}", path=kinds.path, columns=kinds.names, time=kinds.text)
    def from_csv(
        cls, path: str | PathLike[str], columns: str | Sequence[str] = "", *, time: str = "", **parameters: Any
    ) -> Self:
        """Return the source that plays columns of a file of comma-separated values with a line of names.

        Semicolons and tabs separate columns, too. `Run.to_csv` writes such a file.

        Parameters
        ----------
        path : path
            The file.
        columns : str or sequence of str
            Column, or columns of a vector; without it, all but the time.
        time : str
            Column of the times in s; without it, the first one.
        **parameters
            Further ones of the block: ``interpolation``, ``unit``, ``name``.

        Raises
        ------
        OptionError
            For a file that can't be read.
        UnknownNameError
            For a column that isn't there; the message has near names.
        ParameterError
            For values that are no numbers, and times that don't rise.
        """
        file = Path(path).expanduser()
        step = "Name another file."
        if file.is_dir():
            step = 'A run in a folder is played by run = Run.open(path), Recorded(times=run.t, values=run["y"]).'
        with explain_disk_errors(f"{str(path)!r} can't be read", file, step, OptionError, port="path"):
            text = file.read_text(encoding="utf-8-sig")
        head = text.partition("\n")[0]
        separator = max(",;\t", key=head.count)
        lines = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator) if row]
        if not lines:
            raise OptionError(
                f"{str(path)!r} is empty; expected a line of names, then numbers. Name another file.", port="path"
            )
        names, *rows = lines
        own = parameters.get("name") or cls.__name__
        if all(_NUMBER.fullmatch(name) for name in names):
            raise ParameterError(
                f"found the numbers {', '.join(names)} in the first line of {str(path)!r}; expected names of the "
                f"columns. Put a line above them, such as {separator.join(['t', 'y', *names[2:]][: len(names)])}.",
                block=own,
                port="values",
            )
        table: dict[str, list[float]] = {name: [] for name in names}
        for number, row in enumerate(rows, 2):
            try:
                for name, cell in zip(names, row, strict=True):
                    table[name].append(float(cell))
            except ValueError:
                step = "Leave other rows out."
                if separator != "," and any(_NUMBER.fullmatch(cell.replace(",", ".")) for cell in row if "," in cell):
                    step = "Write decimal points, or read it with pandas.read_csv(…, decimal=',') and from_pandas."
                raise ParameterError(
                    f"found the row {number} of {str(path)!r}, {shorten(row)}; expected {len(names)} numbers, one for "
                    f"each name in its first line. {step}",
                    block=own,
                    port="values",
                ) from None
        return cls._from_columns(table, columns, time or names[0], parameters)

    @classmethod
    @accepts("{cls.__name__}", frame=_FRAME, columns=kinds.names, time=kinds.text)
    def from_pandas(cls, frame: Any, columns: str | Sequence[str] = "", *, time: str = "", **parameters: Any) -> Self:
        """Return the source that plays columns of a pandas DataFrame, or a Series.

        Parameters
        ----------
        frame : pandas.DataFrame or pandas.Series
            The data, with the times in s as its index.
        columns : str or sequence of str
            Column, or columns of a vector; without it, all but the time.
        time : str
            Column of the times in s; without it, the index.
        **parameters
            Further ones of the block: ``interpolation``, ``unit``, ``name``.

        Raises
        ------
        UnknownNameError
            For a column that isn't there; the message has near names.
        ParameterError
            For values that are no numbers, and times that don't rise.
        """
        data = frame.to_frame() if hasattr(frame, "to_frame") else frame
        table = {str(name): data[name].to_numpy() for name in data.columns}
        if not time:
            time, table = "index", {**table, "index": data.index.to_numpy()}
        return cls._from_columns(table, columns, time, parameters)

    @classmethod
    def _from_columns(
        cls, table: Mapping[str, Any], columns: str | Sequence[str], time: str, parameters: dict[str, Any]
    ) -> Self:
        chosen = [columns] if isinstance(columns, str) and columns else list(columns) or [n for n in table if n != time]
        for name in (time, *chosen):
            if name not in table:
                raise UnknownNameError(
                    f"the data has no column {name!r}. {near(name, table)}",
                    block=parameters.get("name") or cls.__name__,
                )
        try:
            times, *values = (np.asarray(table[name], dtype=float) for name in (time, *chosen))
        except (TypeError, ValueError):
            raise ParameterError(
                f"found columns {time}, {', '.join(chosen)} with other values than numbers; expected numbers, times "
                "in s. Convert them.",
                block=parameters.get("name") or cls.__name__,
                port="values",
            ) from None
        if parameters.get("interpolation") == "previous":  # at an event a run has two rows: the last one holds
            last = np.append(np.diff(times) != 0.0, True)
            times, values = times[last], [column[last] for column in values]
        return cls(times=times, values=values[0] if len(chosen) == 1 else np.stack(values, axis=1), **parameters)

    def piece_starts(self) -> np.ndarray:
        """Return the times, moved earlier by their rounding if values jump there."""
        times: np.ndarray = self.times
        return move_earlier(times) if self.interpolation == "previous" else times

    @property
    def slopes(self) -> np.ndarray:
        """Slopes between the times; zero if values are held."""
        return super().slopes * float(self.interpolation == "linear")

    def instants(self) -> Array:
        """Return the times of the samples."""
        return self.times
