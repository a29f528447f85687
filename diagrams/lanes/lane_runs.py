"""Runs side by side: their numbers in vectors, and the calls of the C code that goes over their ticks."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from .lane_code import LaneCode


@dataclass(frozen=True, eq=False)
class LaneStart:
    """The numbers of a run at its first tick."""

    x: np.ndarray
    w: np.ndarray
    z: np.ndarray
    p: np.ndarray
    plants: Mapping[str, np.ndarray]  # parameters, inputs and states of each FMU
    steps: tuple[float, ...]  # longest of each FMU's integrator in s; equal for runs side by side
    row: np.ndarray  # the entries of the log that are kept
    messages: tuple[str, ...] = ()  # what its start has reported


@dataclass(frozen=True, eq=False)
class LaneEnd:
    """The end of a run that went side by side with others; ticks are counted from the first one that was gone to."""

    failed: int  # the tick that it could not go beyond; 0 if none
    stopped: int  # the tick at which a stop condition ended it; 0 if none
    by: int  # that condition, by its place
    last: np.ndarray  # the entries of the log that are kept, at its end


class LaneVectors:
    """The numbers of runs at their first tick, as `LaneStart` has them; arrays have a column for each run."""

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
        """Let lanes without a run repeat the first one."""
        for values in (self.p, self.x, self.w, self.z, self.plants, self.row):
            values[:, self.count :] = values[:, :1]


class LaneRuns:
    """A vector of runs of one diagram, at most as many as the code has lanes; ``vectors`` change as they continue."""

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
        """Go through ticks as `CompiledLoop.run` does, into rows of `make_room`; return the number of written ones."""
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


@cache
def _structure(count: int) -> type[ctypes.Structure]:
    """Return the structure that C knows, for some number of lanes."""
    integer, pointer, lanes = ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64 * count
    fields = [
        *((name, integer) for name in ("every", "skip", "columns", "stops")),
        *((name, pointer) for name in ("column", "stop", "p", "x", "w", "z", "plant", "steps", "last")),
        *((name, lanes) for name in ("alive", "failed", "stopped", "by")),
        *((name, integer) for name in ("ticks", "rows")),
        ("room", pointer),
    ]
    return type("LanesStructure", (ctypes.Structure,), {"_fields_": fields})


def _aligned(values: np.ndarray) -> np.ndarray:
    """Return a copy at an address that suits vectors of its last axis: C loads and stores them whole."""
    found = make_room(*values.shape)
    found[...] = values
    return found
