"""The results of a sweep: every run's numbers and samples, as arrays and as one labelled data set."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    MOST_ROWS,
    Grid,
    OptionError,
    Sheet,
    ShownAsTable,
    UnknownNameError,
    accepts,
    count_of,
    enumerate_some,
    explain_calls,
    kinds,
    near,
)
from .outcome import Failure, SampleOutcome
from .samples import Samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset


@explain_calls
@dataclass(frozen=True, eq=False)
class Sweep(ShownAsTable):
    """The results of a sweep.

    ``sweep["name"]`` is an array with one row for each sample, in their order: a reduction, the samples of a signal
    over time, or the values of a parameter, by its path. A run that failed has NaN in place of its reductions, and of
    the samples after its end. ``dataset`` has it all with names and units.

    Attributes
    ----------
    samples : Samples
        The samples.
    failures : tuple of Failure
        Runs that failed, in the order of the samples.
    elapsed : float
        Elapsed time in s.
    reused : int
        Number of samples that were on disk already.
    messages : tuple of str
        Messages of the runs, each once.
    """

    samples: Samples
    outcomes: Sequence[SampleOutcome | None] = field(repr=False)
    diagram_name: str
    elapsed: float = float("nan")
    reused: int = 0
    messages: tuple[str, ...] = ()
    asked: tuple[str, ...] = field(default=(), repr=False)
    """Names of the reductions that were asked for; one that no run has is NaN."""

    def __repr__(self) -> str:
        missing = sum(outcome is None for outcome in self.outcomes)
        failed = len(self.failures)
        more = (f", {failed} failed" if failed else "") + (f", {missing} not run" if missing else "")
        return f"<sweep of {self.diagram_name}: {len(self.samples)} samples of {', '.join(self.samples.names)}{more}>"

    def _sheet(self) -> Sheet:
        missing = sum(outcome is None for outcome in self.outcomes)
        failures, rows = self.failures, self.samples.rows
        return Sheet(
            f"sweep of {self.diagram_name}",
            (
                ("samples", len(rows)),
                ("failed", count_of(len(failures), "run") if failures else ""),
                ("not run", count_of(missing, "sample") if missing else ""),
                ("signals kept", enumerate_some(self._signals, 8)),
            ),
            (
                Grid("", ("", *self.samples.names, *self._reductions), tuple(self._rows()), total=len(rows)),
                Grid("Failures", ("sample", "error", "message"), tuple((f.index, f.kind, f.message) for f in failures)),
            ),
            (*self.messages, *self._mixed_units()),
        )

    def _rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield the first rows of its table: a sample's number and parameters, and its reductions."""
        for k, row in enumerate(self.samples.rows[:MOST_ROWS]):
            outcome = self.outcomes[k]
            numbers = {} if outcome is None else outcome.numbers
            found = (numbers.get(name) for name in self._reductions)
            yield k, *row, *(float(v) if v is not None and np.ndim(v) == 0 else v for v in found)

    @cached_property
    def failures(self) -> tuple[Failure, ...]:
        """Runs that failed, in the order of the samples."""
        return tuple(o.failure for o in self.outcomes if o is not None and o.failure is not None)

    @property
    def failed(self) -> np.ndarray:
        """Whether the run of each sample failed, or was not made, (N,) of bool."""
        return np.array([o is None or o.failure is not None for o in self.outcomes])

    @property
    def end(self) -> np.ndarray:
        """Time in s at which the run of each sample ended, (N,); NaN where it did not begin."""
        return np.array([np.nan if o is None else o.end for o in self.outcomes])

    @cached_property
    def _reductions(self) -> list[str]:
        found = (name for o in self.outcomes if o is not None for name in o.numbers)
        return list(dict.fromkeys([*self.asked, *found]))

    @cached_property
    def _signals(self) -> list[str]:
        return list(dict.fromkeys(name for o in self.outcomes if o is not None for name in o.signals))

    @property
    def names(self) -> list[str]:
        """Names of the reductions and signals that it holds."""
        return [*self._reductions, *self._signals]

    @accepts("sweep[…]", name=kinds.text)
    def __getitem__(self, name: str) -> np.ndarray:
        """Return a reduction or a parameter's values, shape (N, *shape), or the samples of a signal, (N, n, *shape).

        Raises
        ------
        UnknownNameError
            For a name that it doesn't hold.
        OptionError
            For numbers whose shape differs from run to run.
        """
        if name in self._reductions:
            return self._stack(name, [None if o is None else o.numbers.get(name) for o in self.outcomes])
        if name in self._signals:
            return self._stack_samples(name)
        if name in self.samples.names:
            return self.samples.column(name)
        known = [*self.names, *self.samples.names]
        raise UnknownNameError(f"the sweep holds no {name!r}. {near(name, known)}", block=self.diagram_name)

    def plot(self, *names: str, xlim: tuple[float, float] | None = None) -> Figure:
        """Draw signals of all runs over each other, one axis for each number, and return the figure.

        The legend has the samples' parameters; of more than five runs with one parameter, a scale of colors. A cross
        is the end of a run that failed.

        Parameters
        ----------
        *names : str
            Signals that were kept; all of them without any.
        xlim : (float, float), optional
            Times in s that are shown.

        Raises
        ------
        OptionError
            If no signal was kept, or none of such a name.
        """
        from .sweep_plot import plot_sweep

        return plot_sweep(self.samples, self.outcomes, self.units, self.diagram_name, names, xlim)

    def _stack(self, name: str, values: Sequence[np.ndarray | None]) -> np.ndarray:
        shapes = {value.shape for value in values if value is not None}
        if len(shapes) > 1:
            raise OptionError(
                f"its shape differs from run to run: {', '.join(map(str, sorted(shapes)))}; expected one shape. Let "
                "the reduction return as many numbers for every run.",
                block=self.diagram_name,
                port=name,
            )
        (shape,) = shapes or {()}
        missing = np.full(shape, np.nan)
        return np.array([missing if value is None else value for value in values])

    def _stack_samples(self, name: str) -> np.ndarray:
        parts = [None if o is None else o.signals.get(name) for o in self.outcomes]
        length = max((len(part) for part in parts if part is not None), default=0)
        shape = next((part.shape[1:] for part in parts if part is not None), ())
        found = np.full((len(parts), length, *shape), np.nan)
        for row, part in zip(found, parts, strict=True):
            if part is not None:
                row[: len(part)] = part
        return found

    @cached_property
    def t(self) -> np.ndarray:
        """Times of the samples in s: (n,) where all runs share them, else (N, n), NaN after a run's end.

        Raises
        ------
        OptionError
            If no signal was kept.
        """
        times = [o.t for o in self.outcomes if o is not None and o.t is not None]
        if not times:
            raise OptionError(
                "no samples were kept in this sweep, so it has no times. Keep signals: signals=['y'].",
                block=self.diagram_name,
            )
        longest = max(times, key=len)
        if all(np.array_equal(t, longest[: len(t)]) for t in times):
            return longest
        found = np.full((len(self.outcomes), len(longest)), np.nan)
        for row, outcome in zip(found, self.outcomes, strict=True):
            if outcome is not None and outcome.t is not None:
                row[: len(outcome.t)] = outcome.t
        return found

    @cached_property
    def units(self) -> Mapping[str, str]:
        """Units of signals and reductions, as far as they are declared, and the same in all runs."""
        return {name: units[0] for name, units in self._units.items() if len(units) == 1}

    @cached_property
    def _units(self) -> Mapping[str, Sequence[str]]:
        """Return the units that each signal and reduction has: several where plants that count otherwise are swept."""
        found = {(name, unit): None for o in self.outcomes if o is not None for name, unit in o.units.items()}
        return {name: [unit for of, unit in found if of == name] for name, _ in found}

    def _mixed_units(self) -> Iterator[str]:
        """Yield a line for each signal and reduction whose numbers can't be compared as they are."""
        for name, units in self._units.items():
            if len(units) > 1:
                yield (
                    f"{name}: found {enumerate_some(units, 8)}; its numbers are in the unit of their run, and can't be "
                    "compared as they are. Convert them, or put a UnitConversion in front of the wire."
                )

    @cached_property
    def dataset(self) -> Dataset:
        """One xarray data set: the dimensions of a grid are its parameters; else there is one, ``sample``.

        Its variables are the reductions, the signals, over ``t`` (s), the variables ``failed``, ``end_time`` (s) and
        ``failure``, the message. Entries of vectors count from 1. Where runs have their own times, samples run over
        ``step``, and ``t`` is a variable.

        Raises
        ------
        OptionError
            If xarray is not installed.
        """
        try:
            import xarray
        except ImportError as error:
            raise OptionError(
                "xarray is not installed: pip install 'loopwright[sweep]'. Without it, read arrays: sweep[name]."
            ) from error
        samples = self.samples
        axes: Mapping[str, tuple[Any, ...]] | None = samples.axes
        dims = ("sample",) if axes is None else tuple(axes)
        coordinates: dict[str, Any] = {}
        # Only a grid has an axis for each parameter; other samples share one, with the parameters along it.
        if axes is None:
            coordinates["sample"] = ("sample", np.arange(len(samples)))
            for k, name in enumerate(samples.names):
                coordinates[name] = ("sample", _labels([row[k] for row in samples.rows]))
        else:
            coordinates |= {name: (name, _labels(values)) for name, values in axes.items()}
        variables: dict[str, Any] = {}
        text = np.array(
            ["" if o is None or o.failure is None else str(o.failure.message) for o in self.outcomes], dtype=object
        )
        about: list[tuple[str, np.ndarray, dict[str, str]]] = [
            ("failed", self.failed, {}),
            ("end_time", self.end, {"units": "s"}),
            ("failure", text, {}),
        ]
        for name, values, attributes in about:
            variables[name] = (dims, values.reshape(samples.shape), attributes)
        inner: tuple[str, ...] = ()
        if self._signals:
            # Runs with steps of equal length share their times; else each run has its own.
            if self.t.ndim == 1:
                inner, coordinates["t"] = ("t",), ("t", self.t, {"units": "s"})
            else:
                inner, variables["t"] = ("step",), ((*dims, "step"), self.t.reshape(*samples.shape, -1), {"units": "s"})
        for name in self.names:
            values, own = self[name], inner if name in self._signals else ()
            extra = values.shape[1 + len(own) :]
            more = [f"{name}_dim"] if len(extra) == 1 else [f"{name}_dim{i + 1}" for i in range(len(extra))]
            coordinates |= {dim: (dim, np.arange(1, n + 1)) for dim, n in zip(more, extra, strict=True)}
            unit = {"units": self.units[name]} if name in self.units else {}
            variables[name] = ((*dims, *own, *more), values.reshape(*samples.shape, *values.shape[1:]), unit)
        found: Dataset = xarray.Dataset(
            variables, coordinates, attrs={"title": self.diagram_name, "seed": samples.seed}
        )
        return found


def _labels(values: Sequence[Any]) -> np.ndarray:
    """Return values as a coordinate: numbers where they are numbers, texts where they are texts, else as they print."""
    if all(isinstance(value, bool | int | float) for value in values) or all(isinstance(v, str) for v in values):
        return np.array(values)
    return np.array([repr(value.tolist() if isinstance(value, np.ndarray) else value) for value in values])
