"""Layout of named arrays in a flat vector: the one place in which offsets are counted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

from .brief import brief, enumerate_some
from .explained_calls import explain_calls
from .ports import Shape


def elements(name: str, shape: Shape) -> list[str]:
    """Return the names of the elements of an array, in C order: ``name[i,j]``, or ``name`` of a scalar."""
    # in text elements are counted from 1, as FMI does; Python's own indices of arrays and signals count from 0
    return [f"{name}[{','.join(str(i + 1) for i in index)}]" if index else name for index in np.ndindex(*shape)]


def lay_out(sizes: Iterable[int], offset: int = 0) -> list[slice]:
    """Return the slices of pieces of a flat vector, one after the other."""
    ends = list(accumulate(sizes, initial=offset))
    return [slice(start, end) for start, end in pairwise(ends)]


@explain_calls
@dataclass(frozen=True)
class Layout:
    """Layout of a flat vector: slice and shape of each array by name, in C order, one after the other.

    Examples
    --------
    >>> layout = Layout.of({"position": (2,), "angle": ()})
    >>> layout.slices["angle"], layout.total, layout.labels
    (slice(2, 3, None), 3, ['position[1]', 'position[2]', 'angle'])
    """

    slices: dict[str, slice]
    shapes: dict[str, Shape]

    def __repr__(self) -> str:
        return brief("layout of a vector", f"{self.total} entries", enumerate_some(self.slices))

    @staticmethod
    def of(shapes: Mapping[str, Shape], offset: int = 0) -> Layout:
        """Return the layout of arrays of the given shapes, one after the other.

        Parameters
        ----------
        shapes : mapping
            Shape of each array, by name.
        offset : int, default: 0
            Number of the first entry.
        """
        sizes = [int(math.prod(shape)) for shape in shapes.values()]
        return Layout(dict(zip(shapes, lay_out(sizes, offset), strict=True)), dict(shapes))

    @property
    def total(self) -> int:
        """Number of entries, counted from the first slice."""
        bounds = [*self.slices.values()]
        return bounds[-1].stop - bounds[0].start if bounds else 0

    @property
    def cuts(self) -> list[int]:
        """Numbers of the first entry and of the entry behind each array, as CasADi's ``vertsplit`` takes them."""
        bounds = [*self.slices.values()]
        return [bounds[0].start if bounds else 0, *(s.stop for s in bounds)]

    @property
    def labels(self) -> list[str]:
        """Names of all entries; see `elements`."""
        return [label for name, shape in self.shapes.items() for label in elements(name, shape)]

    def index(self, name: str) -> np.ndarray:
        """Return the numbers of the entries of one array, in its shape."""
        where = self.slices[name]
        return np.arange(where.start, where.stop).reshape(self.shapes[name])

    def entries(self, names: Iterable[str]) -> list[int]:
        """Return the numbers of the entries of some arrays, one after the other."""
        return [i for name in names for i in range(self.slices[name].start, self.slices[name].stop)]

    def split(self, vector: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arrays in a vector by name: views, if NumPy can give them."""
        return {name: vector[where].reshape(self.shapes[name]) for name, where in self.slices.items()}
