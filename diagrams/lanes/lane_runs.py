"""Runs side by side: their numbers in vectors, and the calls of the C code that goes over their ticks."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .lane_code import LaneCode


@dataclass(frozen=True, eq=False)
class LaneStart:
    """The numbers of a run at its first tick.

    Attributes
    ----------
    x, w, z, p : ndarray
        States, outputs and inputs of the FMUs, and parameters of the diagram.
    plants : mapping of str to ndarray
        Parameters, inputs and states of each FMU.
    steps : tuple of float
        Longest step of each FMU's integrator in s. Runs go side by side if these are equal.
    row : ndarray
        The entries of the log that are kept.
    messages : tuple of str
        What its start has reported.
    """

    x: np.ndarray
    w: np.ndarray
    z: np.ndarray
    p: np.ndarray
    plants: Mapping[str, np.ndarray]
    steps: tuple[float, ...]
    row: np.ndarray
    messages: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class LaneEnd:
    """The end of a run that went side by side with others.

    Attributes
    ----------
    failed : int
        The tick that it could not go beyond, counted from the first one that was gone to; 0 if none.
    stopped : int
        The tick at which a stop condition ended it; 0 if none.
    by : int
        That condition, by its place.
    last : ndarray
        The entries of the log that are kept, at its end.
    """

    failed: int
    stopped: int
    by: int
    last: np.ndarray


class LaneVectors:
    """The numbers of a vector of runs at their first tick; each array has a column for each lane.

    Parameters
    ----------
    code : LaneCode
        The code.
    columns : int
        Entries of the log that are kept.

    Attributes
    ----------
    p, x, w, z : ndarray
        As `LaneStart` has them.
    plants : ndarray
        Parameters, inputs and states of the FMUs, one after the other.
    row : ndarray
        The entries of the log that are kept.
    steps : tuple of float
        Longest step of each FMU's integrator in s.
    messages : list of tuple of str
        What the start of each run has reported.
    """

    def __init__(self, code: LaneCode, columns: int):
        sizes, count = code.sizes, code.count
        self.p, self.x, self.w, self.z = (make_room(n, count) for n in (sizes.p, sizes.x, sizes.w, sizes.z))
        self.plants = make_room(sum(plant.width for plant in code.plants.values()), count)
        self.row = make_room(columns, count)
        self.steps: tuple[float, ...] = ()
        self.messages: list[tuple[str, ...]] = []

    @classmethod
    def of(cls, code: LaneCode, starts: Sequence[LaneStart]) -> LaneVectors:
        """Return the numbers of runs that were started one by one; their steps are equal."""
        found = cls(code, starts[0].row.size)
        for lane, start in enumerate(starts):
            for name in ("p", "x", "w", "z", "row"):
                getattr(found, name)[:, lane] = getattr(start, name)
            found.plants[:, lane] = np.concatenate([np.zeros(0), *(start.plants[path] for path in code.plants)])
            found.messages.append(start.messages)
        found.steps = starts[0].steps
        found.fill()
        return found

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.messages)

    def fill(self) -> None:
        """Let lanes without a run of their own repeat the first one."""
        for values in (self.p, self.x, self.w, self.z, self.plants, self.row):
            values[:, self.count :] = values[:, :1]


class LaneRuns:
    """A vector of runs of one diagram, at most as many as the code has lanes.

    Parameters
    ----------
    code : LaneCode
        The code.
    vectors : LaneVectors
        The runs' numbers, which change as they continue.
    columns : ndarray
        Entries of the log that are kept.
    every : int
        One of so many rows is kept.
    stops : sequence of int
        Entries of the log that end a run where they are true.
    """

    def __init__(self, code: LaneCode, vectors: LaneVectors, *, columns: np.ndarray, every: int, stops: Sequence[int]):
        self._code, self._columns = code, np.ascontiguousarray(columns, dtype=np.int64)
        self._stops = np.array([*stops], dtype=np.int64)
        self._steps = np.array(vectors.steps, dtype=float)
        width, count = code.count, vectors.count
        self._vectors, self._last, self._count = vectors, _aligned(vectors.row), count
        self._room = make_room(code.room.run, width)
        numbers = vectors.p, vectors.x, vectors.w, vectors.z, vectors.plants, self._last
        p, x, w, z, plant, last = (vector.ctypes.data for vector in numbers)
        self._structure = _structure(width)(
            every=every,
            skip=every - 1,
            columns=self._columns.size,
            stops=self._stops.size,
            column=self._columns.ctypes.data,
            stop=self._stops.ctypes.data,
            p=p,
            x=x,
            w=w,
            z=z,
            plant=plant,
            steps=self._steps.ctypes.data,
            last=last,
            room=self._room.ctypes.data,
        )
        self._structure.alive[:] = [-1] * count + [0] * (width - count)

    @property
    def is_going(self) -> bool:
        """Whether any run has not ended yet."""
        return any(self._structure.alive)

    @property
    def skip(self) -> int:
        """Rows to be left out before the next one that is kept."""
        return int(self._structure.skip)

    def run(self, times: np.ndarray, widths: np.ndarray, kinds: np.ndarray, rows: np.ndarray) -> int:
        """Go through ticks, as `CompiledLoop.run` does; return the number of rows that were written.

        Parameters
        ----------
        times : ndarray, shape (n + 1,)
            Time of the tick before them, and of each of them, in s.
        widths : ndarray, shape (n,)
            Length of each tick, in s.
        kinds : ndarray, shape (n,), of int32
            Clocks that act at each of them, as numbers of the code.
        rows : ndarray, shape (m, columns, lanes)
            The memory for the rows, of `make_room`.
        """
        self._structure.rows = 0
        self._code.run(
            ctypes.byref(self._structure),
            ctypes.c_int64(len(widths)),
            *(ctypes.c_void_p(vector.ctypes.data) for vector in (times, widths, kinds, rows)),
        )
        return int(self._structure.rows)

    def ends(self) -> list[LaneEnd]:
        """Return the ends of the runs, in their order."""
        found = self._structure
        return [
            LaneEnd(found.failed[i], found.stopped[i], found.by[i], self._last[: self._columns.size, i].copy())
            for i in range(self._count)
        ]


def make_room(*shape: int) -> np.ndarray:
    """Return memory for numbers, of which C loads and stores whole vectors of the last axis."""
    count, size = 8 * math.prod(shape), 8 * shape[-1]
    memory = np.empty(count + size, dtype=np.uint8)
    begin = -memory.ctypes.data % size
    return memory[begin : begin + count].view(float).reshape(shape)


_STRUCTURES: dict[int, type[ctypes.Structure]] = {}


def _structure(count: int) -> type[ctypes.Structure]:
    """Return the structure that C knows, for some number of lanes."""
    if count not in _STRUCTURES:
        integer, pointer, lanes = ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64 * count
        fields = [
            *((name, integer) for name in ("every", "skip", "columns", "stops")),
            *((name, pointer) for name in ("column", "stop", "p", "x", "w", "z", "plant", "steps", "last")),
            *((name, lanes) for name in ("alive", "failed", "stopped", "by")),
            *((name, integer) for name in ("ticks", "rows")),
            ("room", pointer),
        ]
        _STRUCTURES[count] = type("LanesStructure", (ctypes.Structure,), {"_fields_": fields})
    return _STRUCTURES[count]


def _aligned(values: np.ndarray) -> np.ndarray:
    """Return a copy at an address that suits vectors of its last axis: C loads and stores them whole."""
    found = make_room(*values.shape)
    found[...] = values
    return found
