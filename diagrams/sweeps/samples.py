"""Samples of parameters: grids, Latin hypercubes and tables, each sample with its own seed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from ...blocks.core import Block, OptionError, accepts, brief, enumerate_some, explain_calls, kinds, near
from ..flat import WiredDiagram

KINDS = ("grid", "latin")
_SCALES = ("linear", "log")


_BOX = "Give (low, high), such as (0.5, 2.0), or Box(low, high, scale='log')."
"""Next step where a range is expected."""


@explain_calls
@accepts(None, scale=kinds.choice(*_SCALES).worded(found=kinds.by_name))
@dataclass(frozen=True)
class Box:
    """Range of one parameter, in its unit: a number, or an array of numbers with a range each.

    Attributes
    ----------
    low, high : float or array_like
        Ends of the range; both belong to it.
    scale : {"linear", "log"}
        Whether values, or their logarithms, are spread evenly.

    Examples
    --------
    >>> Box(1.0, 100.0, "log").at(0.5)
    10.0
    """

    low: Any
    high: Any
    scale: str = "linear"

    def __post_init__(self) -> None:
        try:
            low, high = np.array(self.low, dtype=float), np.array(self.high, dtype=float)
        except (TypeError, ValueError):
            raise OptionError(
                f"found a range from {self.low!r} to {self.high!r}; expected two numbers. {_BOX}"
            ) from None
        if low.shape != high.shape:
            raise OptionError(
                f"found ends of shapes {low.shape} and {high.shape}; expected equal shapes. Give both ends for each "
                "entry."
            )
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
            raise OptionError(
                f"found a range from {self.low!r} to {self.high!r}; expected finite ends, the lower one first. {_BOX}"
            )
        if self.scale == "log" and not (low > 0.0).all():
            raise OptionError(
                f"found a range from {self.low!r} on with scale='log'; expected positive ends. Take scale='linear'."
            )

    @classmethod
    def of(cls, value: object, name: str = "") -> Box:
        """Return a box, which may be given as a pair ``(low, high)``.

        Raises
        ------
        OptionError
            For anything else; ``name`` says whose it is.
        """
        if isinstance(value, cls):
            return value
        if isinstance(value, tuple | list) and len(value) == 2:
            try:
                return cls(*value)
            except OptionError as error:
                raise error.at(block=name) from None
        raise OptionError(f"found {value!r}; expected a range, of two ends. {_BOX}", block=name or None)

    @property
    def size(self) -> int:
        """Number of entries, each with a range."""
        return int(np.size(self.low))

    def at(self, fraction: Any) -> Any:
        """Return the value at a fraction of the range, 0 to 1: one for all entries, or one for each.

        A box of numbers gives a float, one of arrays an array.
        """
        part = np.array(fraction, dtype=float)
        found = self.at_all(part.reshape(1, *(np.shape(self.low) if part.ndim else ())))[0]
        return float(found) if found.ndim == 0 else found

    def at_all(self, fractions: np.ndarray) -> np.ndarray:
        """Return the values at fractions of the range, one of each in a row; a row is as `at` takes it."""
        low, high = np.array(self.low, dtype=float), np.array(self.high, dtype=float)
        part = fractions.reshape(len(fractions), *([1] * low.ndim)) if fractions.ndim == 1 else fractions
        found = low ** (1.0 - part) * high**part if self.scale == "log" else low + part * (high - low)
        return np.where(part == 0.0, low, np.where(part == 1.0, high, np.clip(found, low, high)))


@explain_calls
@dataclass(frozen=True)
class Sample:
    """One point of a sweep.

    Attributes
    ----------
    index : int
        Its place in the sweep.
    parameters : mapping
        Values by the names of the sweep, as `Diagram.replace` takes them.
    seed : int
        Its own seed: it depends on the sweep's seed and the place alone, not on who runs it, or when.
    """

    index: int
    parameters: Mapping[str, Any]
    seed: int


@explain_calls
@dataclass(frozen=True)
class Samples(Sequence[Sample]):
    """Samples of parameters, in their order.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    rows : tuple of tuple
        Values of each sample, in the order of the names.
    axes : mapping or None
        Values along each axis of a grid, by name, the last one running fastest; None if it is no grid.
    seed : int
        Seed of the sweep.

    Examples
    --------
    >>> for sample in grid({"k": (1.0, 2.0), "d": (0.1,)}):
    ...     print(sample.index, dict(sample.parameters))
    0 {'k': 1.0, 'd': 0.1}
    1 {'k': 2.0, 'd': 0.1}
    """

    names: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    axes: Mapping[str, tuple[Any, ...]] | None = None
    seed: int = 0
    boxes: Mapping[str, Box] = field(default_factory=dict)

    def __repr__(self) -> str:
        facts = f"{len(self)} samples of {enumerate_some(self.names)}", "" if self.axes is None else "a grid"
        return brief("samples", *facts, then="samples[0].parameters")

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = range(len(self))[index]
        return Sample(place, dict(zip(self.names, self.rows[place], strict=True)), seed_of(self.seed, place))

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(len(self)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of samples along each axis of a grid; one number where it is no grid."""
        return (len(self),) if self.axes is None else tuple(len(values) for values in self.axes.values())

    def column(self, name: str) -> np.ndarray:
        """Return the values of a parameter, one row for each sample.

        Blocks, arrays of several shapes, and numbers among texts are objects.

        Raises `ValueError` for a name that is not among the names.
        """
        values = [row[self.names.index(name)] for row in self.rows]
        plain = all(isinstance(value, bool | int | float | str | tuple | list | np.ndarray) for value in values)
        if plain and len({(np.shape(value), isinstance(value, str)) for value in values}) == 1:
            return np.array(values)
        found = np.empty(len(values), dtype=object)
        found[:] = values
        return found

    def resolve(self, diagram: WiredDiagram) -> Samples:
        """Return the samples with the full path of each parameter in a diagram.

        Raises
        ------
        UnknownNameError
            For a name that isn't there; near names are offered.
        OptionError
            For two names of one parameter.
        """
        full: dict[str, str] = {}
        for name in self.names:
            path = diagram.find_parameter(name)
            if path in full:
                raise OptionError(
                    f"found two names of one parameter, {full[path]!r} and {name!r}; give it once.",
                    block=diagram.name,
                    port=path,
                )
            full[path] = name
        for path in full:
            if (whole := path.rpartition("[")[0]) in full:
                raise OptionError(f"found {whole!r} and an entry of it, {path!r}; expected one of them. Leave one out.")
        paths = {name: path for path, name in full.items()}
        axes = None if self.axes is None else {paths[name]: values for name, values in self.axes.items()}
        boxes = {paths[name]: box for name, box in self.boxes.items()}
        return Samples(tuple(full), self.rows, axes, self.seed, boxes)


def seed_of(seed: int, index: int) -> int:
    """Return the seed of a sample: a non-negative integer below 2⁶³."""
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)[0] >> np.uint64(1))


_SEED = kinds.integer(0).worded(step="Give one.", found=kinds.by_name)


@accepts(None, seed=_SEED)
def grid(parameters: Mapping[str, Any], *, seed: int = 0) -> Samples:
    """Return every combination of the parameters' values, the last parameter running fastest.

    Parameters
    ----------
    parameters : mapping of str to sequence
        Values of each parameter.
    seed : int
        Seed of the sweep.

    Raises
    ------
    OptionError
        For a parameter without values, or values that are no sequence.
    """
    _check_parameters(parameters)
    axes = {name: _list_values(name, values) for name, values in parameters.items()}
    return Samples(tuple(axes), tuple(product(*axes.values())), axes, int(seed))


@accepts(
    None,
    count=kinds.integer(1).worded("a positive integer, the number of samples", "Give one.", kinds.by_name),
    seed=_SEED,
)
def latin(parameters: Mapping[str, Any], count: int, *, seed: int = 0) -> Samples:
    """Return a Latin hypercube: along each parameter, every one of ``count`` equal parts of its range has one sample.

    Parameters
    ----------
    parameters : mapping of str to (low, high) or Box
        Ranges.
    count : int
        Number of samples.
    seed : int
        Seed of the sweep: equal seeds give equal samples.

    Raises
    ------
    OptionError
        For ranges that are none, or a count that is no positive integer.
    """
    from scipy.stats import qmc

    _check_parameters(parameters)
    boxes = {name: Box.of(value, name) for name, value in parameters.items()}
    generator = np.random.default_rng(np.random.SeedSequence(int(seed)))
    fractions = qmc.LatinHypercube(sum(box.size for box in boxes.values()), seed=generator).random(int(count))
    ends = np.cumsum([box.size for box in boxes.values()])[:-1]
    parts = zip(boxes.values(), np.split(fractions, ends, axis=1), strict=True)
    columns = [box.at_all(part.reshape(len(part), *np.shape(box.low))) for box, part in parts]
    rows = zip(*(column.tolist() if column.ndim == 1 else [*column] for column in columns), strict=True)
    return Samples(tuple(boxes), tuple(rows), None, int(seed), boxes)


@accepts(None, seed=_SEED)
def table(rows: Any, *, seed: int = 0) -> Samples:
    """Return the samples of a table.

    Parameters
    ----------
    rows : list of mapping, mapping of str to sequence, or DataFrame
        Samples one by one, or the values of each parameter; a pandas DataFrame has a column for each.
    seed : int
        Seed of the sweep.

    Raises
    ------
    OptionError
        For samples that don't all give the same parameters, columns of unequal length, and no samples at all.
    """
    if hasattr(rows, "to_dict") and hasattr(rows, "columns"):
        rows = {str(name): rows[name].tolist() for name in rows.columns}
    if isinstance(rows, Mapping):
        _check_parameters(rows)
        columns = {name: _list_values(name, values) for name, values in rows.items()}
        sizes = {name: len(values) for name, values in columns.items()}
        if len(set(sizes.values())) > 1:
            found = ", ".join(f"{name}: {size}" for name, size in sizes.items())
            raise OptionError(
                f"found columns of unequal length ({found}); expected a value of each for every sample. Fill the "
                "shorter ones, or give all combinations: sweep({…})."
            )
        return Samples(tuple(columns), tuple(zip(*columns.values(), strict=True)), None, int(seed))
    if isinstance(rows, str) or not isinstance(rows, Sequence) or not all(isinstance(row, Mapping) for row in rows):
        raise OptionError(
            f"found {rows!r}; expected a list of samples, or the values by name. Give "
            "[{'controller.gain': 2.0}], or {'controller.gain': [2.0]}."
        )
    if not rows:
        raise OptionError("found no sample; expected one at least. Give a row of the table.")
    names = tuple(rows[0])
    _check_parameters(rows[0])
    for place, row in enumerate(rows):
        if set(row) != set(names):
            odd = sorted(map(str, set(row) ^ set(names)))
            raise OptionError(
                f"sample {place} gives {', '.join(map(str, row))}, and sample 0 {', '.join(names)}; expected the same "
                f"parameters in all. Look at {', '.join(odd)}."
            )
    return Samples(names, tuple(tuple(row[name] for name in names) for row in rows), None, int(seed))


def read_samples(
    diagram: WiredDiagram, parameters: Any, samples: Any = "grid", *, count: int | None = None, seed: int = 0
) -> Samples:
    """Return the samples of a sweep of a diagram, with the full paths of their parameters.

    Parameters
    ----------
    parameters : mapping
        Values, or ranges, by dotted path; empty or None where ``samples`` is a table.
    samples : {"grid", "latin"}, Samples, list of mapping, mapping or DataFrame
        Every combination of the values; a Latin hypercube of ``count`` samples in the ranges; or a table.
    count : int, optional
        Number of samples of a Latin hypercube.
    seed : int
        Seed of the sweep.

    Raises
    ------
    OptionError
        For a kind that is unknown, parameters next to a table, and what `grid`, `latin` and `table` refuse.
    UnknownNameError
        For a name that isn't in the diagram.
    """
    kind = samples if isinstance(samples, str) else None
    if kind is not None and kind not in KINDS:
        raise OptionError(
            f"found samples={kind!r}. {near(kind, KINDS)} Or give a table: a list of mappings.",
            block=diagram.name,
            port="samples",
        )
    if kind != "latin" and count is not None:
        raise OptionError(
            f"found count={count!r} together with samples that have their number; expected it with samples='latin' "
            "alone. Leave it out.",
            block=diagram.name,
        )
    if kind is None and parameters:
        raise OptionError(
            f"found values of {', '.join(map(str, parameters))} together with a table of samples; give one of them.",
            block=diagram.name,
        )
    try:
        if kind == "grid":
            found = grid(parameters, seed=seed)
        elif kind == "latin":
            if count is None:
                raise OptionError("samples='latin' needs count=, the number of samples. Give it.")
            found = latin(parameters, count, seed=seed)
        else:
            found = samples if isinstance(samples, Samples) else table(samples, seed=seed)
    except OptionError as error:
        raise error.at(block=diagram.name) from None
    resolved = found.resolve(diagram)
    for name in resolved.names:
        if name in diagram.structure.blocks and not any(isinstance(s.parameters[name], Block) for s in resolved):
            diagram.replace({name: resolved[0].parameters[name]})  # ends in an error that names its parameters
    return resolved


def _check_parameters(parameters: object) -> None:
    if not isinstance(parameters, Mapping) or not parameters:
        raise OptionError(
            f"found {parameters!r}; expected parameters by name, with their values. Give "
            "{'controller.gain': (1.0, 2.0)}."
        )


def _list_values(name: str, values: Any) -> tuple[Any, ...]:
    if isinstance(values, str | Mapping | Box) or not isinstance(values, Sequence | np.ndarray):
        raise OptionError(
            f"found {values!r}; expected a list of its values. Give one, such as (1.0, 2.0) or "
            "np.linspace(1.0, 2.0, 5).",
            block=str(name),
        )
    found = tuple(_plain(value) for value in values)
    if not found:
        raise OptionError("found no value; expected one at least. Give it.", block=str(name))
    for value in found:
        if isinstance(value, float) and not math.isfinite(value):
            raise OptionError(f"found the value {value!r}; expected finite numbers. Leave it out.", block=str(name))
    return found


def _plain(value: Any) -> Any:
    """Return a NumPy scalar as Python's own number, so that samples compare and print as people write them."""
    return value.item() if isinstance(value, np.generic) else value
