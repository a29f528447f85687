"""The start of runs that go side by side: their first ticks over vectors, with few calls of Python for each run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError
from ...fmus.calls import FmuInstance
from ..flat import TRUE, FlatDiagram, write_numbers
from ..lanes import LaneCode, LaneVectors, StartSource, make_room
from ..simulation import (
    START_SETTLED,
    Port,
    StartFunctions,
    TracedStartValues,
    find_initial_state,
    trace_start,
    values_from_left,
)
from .bound_run import LOADING, BoundRun
from .variation import Numbers

_PASSES = 30
"""Over inputs and outputs of the FMUs at the start; a run that needs more is started by itself."""
_KEPT = 1000
"""Initial states that are kept by the inputs from which they were computed."""


class StartSearch:
    """Functions from which a bound diagram's runs start, read once."""

    def __init__(self, bound: BoundRun):
        self.bound, flat = bound, bound.flat
        self.left: Mapping[Port, np.ndarray] = {}
        self.functions: StartFunctions | None = None
        self.source: StartSource | None = None
        if flat.hybrid or not TracedStartValues.fits(flat):
            return
        with LOADING:
            workspace = bound.engine.workspace
            workspace.begin_again(flat)
            self.left = {port: np.asarray(tap(None)) for port, tap in values_from_left(workspace).items()}
            self.functions = trace_start(flat, self.left)
        self.source = StartSource(flat.acting(0), self.values, tuple(self.left))

    @property
    def values(self) -> list[Any]:
        """The functions of values before the first tick, in the order in which they are called."""
        if self.functions is None:
            return []
        found = [function for function, _ in self.functions.inputs.values()]
        return [*found, *(f for f in (self.functions.held, self.functions.gates) if f is not None)]

    @property
    def sources(self) -> frozenset[str]:
        """The sources that matter just before t = 0; a run with another one of these is started by itself."""
        if self.functions is None or not (self.functions.inputs or self.functions.gates is not None):
            return frozenset()
        blocks = self.bound.flat.table.blocks
        return frozenset(
            path
            for path in self.bound.flat.checked.traced
            if not blocks[path].inputs and type(blocks[path]).next_instant is not Block.next_instant
        )


class VectorStart:
    """Starts runs side by side, as `initialize` and the first tick do it for one; ``code.starts`` is there.

    ``columns`` are the entries of the log that are kept, ``stops`` those that end a run where they are true.
    NoLanesError: an FMU integrates with steps that are not fixed.
    """

    def __init__(self, search: StartSearch, code: LaneCode, columns: np.ndarray, stops: Sequence[int]):
        assert search.functions is not None
        self._flat: FlatDiagram = search.bound.flat
        self._code, self._columns, self._stops = code, columns, [*stops]
        self._functions, self._sources = search.functions, search.sources
        self._calls, n = code.starts, code.count
        self._places, numbers_of, steps = dict[str, dict[str, np.ndarray]](), list[np.ndarray](), dict[str, float]()
        at = 0
        for path, plant in code.plants.items():
            instance = search.bound.engine.plants[path]
            assert isinstance(instance, FmuInstance)
            with LOADING:
                instance.start_again({})
                numbers, step = plant.read(instance)
            self._places[path] = {
                name: at + np.concatenate([np.r_[plant.entries[r]] for r in variable.references])
                for name, variable in instance.description.variables.items()
                if all(reference in plant.entries for reference in variable.references)
            }
            numbers_of.append(numbers)
            steps[path] = step
            at += plant.width
        self.steps = steps
        self._base = np.concatenate([np.zeros(0), *numbers_of])
        left = [np.ravel(search.left[port]) for port in self._functions.places]
        sizes = code.sizes
        self._left = make_room(self._functions.width, n)
        self._left[:] = np.concatenate([*left, [0.0]])[:, None]
        self._next, self._log, self._ok = make_room(sizes.x, n), make_room(sizes.log, n), make_room(1, n)
        self._room = make_room(code.room.start, n)
        self._values = [make_room(size, n) for size in code.starts.sizes] if code.starts is not None else []
        self._initial: dict[str, dict[bytes, np.ndarray]] = {path: {} for path in self._functions.inputs}

    def fits(self, numbers: Numbers) -> bool:
        """Whether a run's numbers can be set over vectors."""
        known = all(name in self._places.get(path, {}) for path, values in numbers.starts.items() for name in values)
        return known and not (numbers.blocks.keys() & self._sources)

    def find(self, group: Sequence[Numbers]) -> tuple[LaneVectors | None, list[int]]:
        """Return runs at their first tick, and which of a group these are; the others are started one by one."""
        places = [i for i, numbers in enumerate(group) if self.fits(numbers)]
        while places:
            vectors = LaneVectors(self._code, len(self._columns))
            good = self._fill(vectors, [group[i] for i in places])
            if good.all():
                good = self._settle(vectors, [group[i] for i in places])
            if good.all():
                return vectors, places
            places = [i for i, is_good in zip(places, good, strict=True) if is_good]
        return None, []

    def _fill(self, vectors: LaneVectors, group: Sequence[Numbers]) -> np.ndarray:
        """Set all numbers with which runs begin; return for which ones that could be done."""
        flat, good = self._flat, np.ones(len(group), dtype=bool)
        vectors.p[:], vectors.x[:] = flat.p[:, None], flat.x0[:, None]
        vectors.plants[:], vectors.z[:] = self._base[:, None], 0.0
        for lane, numbers in enumerate(group):
            try:
                write_numbers(flat, numbers.blocks, vectors.p[:, lane], vectors.x[:, lane])
            except LoopwrightError:  # its own start says what it is
                good[lane] = False
            for path, values in numbers.starts.items():
                for name, value in values.items():
                    vectors.plants[self._places[path][name], lane] = np.ravel(value)
        vectors.steps, vectors.messages = tuple(self.steps.values()), [()] * len(group)
        vectors.fill()
        return good

    def _settle(self, vectors: LaneVectors, group: Sequence[Numbers]) -> np.ndarray:
        """Go through the first tick, with inputs and outputs of the FMUs that agree; return for which that went."""
        calls, count = self._calls, len(group)
        assert calls is not None
        x, w, z, plants = vectors.x, vectors.w, vectors.z, vectors.plants
        log, ok, after = self._log, self._ok, self._next
        every = [array.ctypes.data for array in (x, w, vectors.p, after, z, log, ok, self._room)]
        own, given, into = plants.ctypes.data, z.ctypes.data, w.ctypes.data
        left, good = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
        ends = [np.empty_like(values) for values in (after, w, z, plants)]
        row = vectors.row
        calls.outputs(own, None, into)
        for _ in range(_PASSES):
            good &= self._set_start(vectors, group) | ~left
            calls.tick(*every)
            good &= (ok[0, :count] != 0.0) | ~left
            before = z.copy()
            if self._code.plants:
                calls.outputs(own, given, into)
                calls.tick(*every)
            same = before == z
            settled = np.ones(count, dtype=bool)
            if not same.all():
                with np.errstate(invalid="ignore"):
                    near = np.abs(before - z) <= START_SETTLED * np.abs(z)
                settled = (same | near).all(axis=0)[:count]
            # a lane that has settled keeps its values; the others take another pass
            now = settled & left
            if now.all():
                ends = [after, w, z, plants]
                row[:] = log[self._columns]
                good &= self._is_good(vectors)[:count]
            else:
                for end, values in zip(ends, (after, w, z, plants), strict=True):
                    end[:, :count][:, now] = values[:, :count][:, now]
                row[:, :count][:, now] = log[self._columns, :count][:, now]
                good[now] &= self._is_good(vectors)[:count][now]
            left &= ~now
            if not left.any() or not good.all():
                break
        for end, values in zip(ends, (x, w, z, plants), strict=True):
            values[:] = end
        vectors.fill()
        return good & ~left

    def _is_good(self, vectors: LaneVectors) -> np.ndarray:
        """Return for which lanes all is finite, no guard has failed and no stop condition is met."""
        good: np.ndarray = (self._ok[0] != 0.0) & np.isfinite(vectors.w).all(axis=0)
        if self._stops:
            good &= ~(self._log[self._stops] > TRUE).any(axis=0)
        return good

    def _set_start(self, vectors: LaneVectors, group: Sequence[Numbers]) -> np.ndarray:
        """Compute initial states, first held outputs and gates, as `TracedStartValues.set` does."""
        flat, calls, functions = self._flat, self._calls, self._functions
        assert calls is not None
        x, good, k = vectors.x, np.ones(len(group), dtype=bool), 0
        addresses = [array.ctypes.data for array in (x, vectors.w, vectors.p, self._left)]

        def call(k: int) -> np.ndarray:
            calls.values[k](*addresses, self._values[k].ctypes.data)
            return self._values[k]

        for path in functions.inputs:
            found = call(k)
            for lane, numbers in enumerate(group):
                try:
                    x[flat.states.slices[path], lane] = self._start_of(path, k, found[:, lane], numbers)
                except LoopwrightError:  # its own start says what it is
                    good[lane] = False
            k += 1
        for path, where in flat.starts.slices.items():
            x[where] = x[flat.states.slices[path]]
        if functions.held is not None:
            found, at = call(k), 0
            for where in flat.held.slices.values():
                size = where.stop - where.start
                x[where], at = found[at : at + size], at + size
            k += 1
        if functions.gates is not None:
            found = call(k)
            for i, where in enumerate(flat.gates.slices.values()):
                x[where] = (found[i] > TRUE).astype(float)
        return good

    def _start_of(self, path: str, k: int, values: np.ndarray, numbers: Numbers) -> np.ndarray:
        """Return the initial state of a block from its inputs."""
        known, key, block = self._initial[path], values.tobytes(), numbers.blocks.get(path)
        if block is None and key in known:
            return known[key]
        function, names = self._functions.inputs[path]
        columns: dict[str, Any] = dict.fromkeys(self._flat.checked.traced[path].inputs)
        at = 0
        for i, name in enumerate(names):
            size = function.numel_out(i)
            columns[name], at = values[at : at + size].copy(), at + size
        found = find_initial_state(self._flat, path, columns, block)
        if block is None:
            if len(known) >= _KEPT:
                known.clear()
            known[key] = found
        return found
