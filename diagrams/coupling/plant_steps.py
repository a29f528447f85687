"""Communication steps of the plants of a run: each from one of its communication points to the next."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import EVERY, FlatDiagram, StepTable, takes_any_step, times_of
from .plants import Plant, bind, part_of


class PlantSteps:
    """The plants of a run with their ticks, and the inputs that they hold between them."""

    def __init__(
        self,
        flat: FlatDiagram,
        plants: Mapping[str, Plant],  # may be filled later
        z: np.ndarray,
        w: np.ndarray,
        time_of: Callable[[int], float],
        *,
        every_tick: bool,
        coupled: bool = False,
    ) -> None:
        self._flat, self._plants, self._time_of = flat, plants, time_of
        self.z, self._w = z, w  # z: inputs, as the diagram has computed them last
        self._visited = {EVERY} if every_tick else {*flat.visited}
        self.regular = all(map(self.is_regular, flat.plant_ticks))
        """Whether every plant steps at every tick that the run visits; then inputs are read from z itself."""
        moves = flat.hybrid and bool(flat.plant_ticks) and not coupled  # z follows states between ticks
        self.inputs = z.copy() if moves or not self.regular else z
        """Inputs of the plants, each as of its last communication point."""
        self.reached: dict[str, int] = {}  # tick at which each plant is
        self.ends_at_tick = True
        """Whether plants go to the last tick of a run; else its end is before the next one, and `end_at` goes there."""
        self._even = {path for path in flat.plant_ticks if not takes_any_step(flat.table.blocks[path])}
        self.own = {path: part_of(flat, flat.plant_inputs, path) for path in flat.plant_ticks}

    def is_regular(self, path: str) -> bool:
        """Whether a plant steps at every tick that the run visits."""
        ticks = self._flat.plant_ticks[path]
        return EVERY in ticks or self._visited <= {*ticks}

    def bind(self) -> None:
        """Let the plants read their inputs and write their outputs to w."""
        bind(self._flat, self._plants, self.inputs, self._w)

    def take_inputs(self) -> None:
        """Let every plant hold its inputs as they are in z."""
        if self.inputs is not self.z:
            self.inputs[:] = self.z

    def begin(self, k: int) -> None:
        """Put every plant at tick ``k``, and hold its inputs from there on."""
        self.take_inputs()
        self.reached = dict.fromkeys(self._plants, k)

    def go(self, k: int, following: int, *, last: bool) -> None:
        """Step the plants from a tick that the run has visited to the next one; at the ``last`` tick all that can."""
        # A plant that stops on its way, at the end of a run, continues from there with the inputs that it holds.
        due = self.due(k, following, last=last)
        if self.apart:
            step_each((self._plants[path], *step) for path, step in due.items())
        else:
            for path, step in due.items():
                self._plants[path].step(*step)
        if not self.regular:
            self.reached.update(dict.fromkeys(due, following))

    def due(self, k: int, following: int, *, last: bool) -> dict[str, tuple[float, float]]:
        """Return the steps from a visited tick to the next one: by path where each begins and its length, in s."""
        if self.regular:
            return dict.fromkeys(self._plants, (self._time_of(k), float(self._flat.base * (following - k))))
        return {
            path: (self._time_of(before), float(self._flat.base * (following - before)))
            for path, before in self.reached.items()
            if following > before and self._goes_to(path, following, last=last)
        }

    def _goes_to(self, path: str, k: int, *, last: bool) -> bool:
        return self._flat.steps_at(path, k) or (last and self._stops_on_its_way(path))

    def _stops_on_its_way(self, path: str) -> bool:
        """Whether a plant steps to the last tick of a run, though it is no communication point of it."""
        return self.ends_at_tick and path not in self._even

    def table(self, ticks: np.ndarray, last: int) -> StepTable | None:
        """Return the steps to ticks that are visited from here on, to the bits of `go`; None: all step at each."""
        if self.regular:
            return None
        shape = len(ticks), len(self._plants)
        begins, widths, holds = np.zeros(shape), np.zeros(shape), np.zeros(shape, dtype=np.uint8)
        for j, path in enumerate(self._plants):
            points = np.logical_or.reduce([pattern.among(ticks) for pattern in self._flat.plant_ticks[path]])
            ends = points | (ticks == last) if self._stops_on_its_way(path) else points
            to = ticks[ends]
            before = np.concatenate([[self.reached[path]], to[:-1]])[: len(to)]
            begins[ends, j], widths[ends, j] = times_of(self._flat, before), times_of(self._flat, to - before)
            holds[:, j] = points
        return StepTable(begins, widths, holds)

    def arrive(self, k: int, *, last: bool) -> None:
        """Note that all plants have stepped up to tick ``k``, as `go` does to each tick that is visited."""
        for path, before in () if self.regular else self.reached.items():
            stops = last and self._stops_on_its_way(path)
            points = k if stops else max(p.latest(k) for p in self._flat.plant_ticks[path])
            self.reached[path] = max(before, points)

    @property
    def apart(self) -> bool:
        """Whether several plants step, one of them in its own process."""
        return len(self._plants) > 1 and any(map(runs_apart, self._plants.values()))

    def hold(self, k: int) -> None:
        """Let the plants of which a tick is a communication point hold their inputs from there on."""
        if self.regular:
            self.take_inputs()
            return
        for path, own in self.own.items():
            if self._flat.steps_at(path, k):
                self.inputs[own] = self.z[own]

    def end_at(self, end: float, k: int) -> None:
        """Step all plants from where they are to the end of the run, in s, after tick ``k`` and before the next."""
        for path, plant in self._plants.items():
            now = self._time_of(k if self.regular else self.reached[path])
            plant.step(now, end - now)

    def save(self) -> dict[str, Any] | None:
        """Return where the plants are and what they hold; None where all of that is in z."""
        return None if self.regular else {"inputs": self.inputs.copy(), "reached": dict(self.reached)}

    def restore(self, saved: Mapping[str, Any] | None, k: int) -> None:
        """Go back to what `save` returned at tick ``k``."""
        self.begin(k)
        if saved is not None and not self.regular:
            self.inputs[:] = saved["inputs"]
            self.reached.update(saved["reached"])


def runs_apart(plant: Any) -> bool:
    """Whether a plant runs in its own process, so that its steps can run alongside others."""
    return not getattr(getattr(plant, "fmi", None), "in_process", True)


def asks_to_end(error: SimulationError) -> bool:
    """Whether an error is the request of a plant to end the run, and no failure."""
    return getattr(error, "ends_at", None) is not None


def step_all(plants: Iterable[Plant], t: float, h: float) -> None:
    """Let plants step from t over h, both in s; those in their own processes step at the same time."""
    # Every step that has begun is ended, also where one fails; then the first error is raised, and a plant's request to
    # end the run only where nothing else has failed.
    step_each((plant, t, h) for plant in plants)


def step_each(steps: Iterable[tuple[Plant, float, float]]) -> None:
    """Let plants step, each from its own time over its own length, both in s; see `step_all`."""
    begun: list[Any] = []
    failure: SimulationError | None = None
    for plant, t, h in steps:
        apart: Any = plant
        try:
            if hasattr(plant, "start_step"):
                apart.start_step(t, h)
                begun.append(apart)
            else:
                plant.step(t, h)
        except SimulationError as error:
            failure = error
            break
    end_all([plant.finish_step for plant in begun], failure)


def end_all(ends: Iterable[Callable[[], None]], failure: SimulationError | None = None) -> None:
    """End all steps that have begun; then raise ``failure``, or the first error, by the rule of `step_all`."""
    for end in ends:
        try:
            end()
        except SimulationError as error:
            failure = error if failure is None or asks_to_end(failure) else failure
    if failure is not None:
        raise failure from failure.__cause__
