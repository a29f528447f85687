"""Communication steps of the plants of a run: each from one of its communication points to the next."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import EVERY, FlatDiagram, takes_any_step
from .plants import Plant, bind, part_of


class PlantSteps:
    """The plants of a run with their ticks, and the inputs that they hold between them.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    plants : mapping of str to Plant
        The plants by path; it may be filled later.
    z, w : ndarray
        Inputs of the plants, as the diagram has computed them, and their outputs.
    time_of : callable
        Gives the time of a tick in s.
    every_tick : bool
        Whether the run visits every tick.

    Attributes
    ----------
    regular : bool
        Whether every plant steps at every tick that the run visits. Then inputs are read from z itself.
    inputs : ndarray
        Inputs of the plants, each as of its last communication point.
    reached : dict
        Tick at which each plant stands, by path.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        plants: Mapping[str, Plant],
        z: np.ndarray,
        w: np.ndarray,
        time_of: Callable[[int], float],
        *,
        every_tick: bool,
        coupled: bool = False,
    ) -> None:
        self._flat, self._plants, self._time_of = flat, plants, time_of
        self._z, self._w = z, w
        self._visited = {EVERY} if every_tick else {*flat.visited}
        self.regular = all(map(self.is_regular, flat.plant_ticks))
        moves = flat.hybrid and bool(flat.plant_ticks) and not coupled  # z follows states between ticks
        self.inputs = z.copy() if moves or not self.regular else z
        self.reached: dict[str, int] = {}
        self._even = {path for path in flat.plant_ticks if not takes_any_step(flat.table.blocks[path])}
        self._own = {path: part_of(flat, flat.plant_inputs, path) for path in flat.plant_ticks}

    def is_regular(self, path: str) -> bool:
        """Whether a plant steps at every tick that the run visits."""
        ticks = self._flat.plant_ticks[path]
        return EVERY in ticks or self._visited <= {*ticks}

    def bind(self) -> None:
        """Let the plants read their inputs and write their outputs to w."""
        bind(self._flat, self._plants, self.inputs, self._w)

    def take_inputs(self) -> None:
        """Let every plant hold its inputs as they are in z."""
        if self.inputs is not self._z:
            self.inputs[:] = self._z

    def begin(self, k: int) -> None:
        """Let every plant stand at tick ``k``, and hold its inputs from there on."""
        self.take_inputs()
        self.reached = dict.fromkeys(self._plants, k)

    def go(self, k: int, following: int, *, last: bool) -> None:
        """Step the plants from a tick that the run has visited to the next one; see `step_to`."""
        if self.regular:
            self.step_together(self._time_of(k), float(self._flat.base * (following - k)))
        else:
            self.step_to(following, last=last)

    @property
    def apart(self) -> bool:
        """Whether several plants step, one of them in a process of its own."""
        return len(self._plants) > 1 and any(map(runs_apart, self._plants.values()))

    def step_together(self, t: float, h: float) -> None:
        """Step all plants from t over h, both in s."""
        if self.apart:
            step_all(self._plants.values(), t, h)
        else:
            for plant in self._plants.values():
                plant.step(t, h)

    def step_to(self, k: int, *, last: bool) -> None:
        """Step the plants of which a tick is a communication point to it; at the ``last`` tick all that can.

        A plant that stops on its way, at the end of a run, goes on from there with the inputs that it holds.
        """
        for path, plant in self._plants.items():
            if self._flat.steps_at(path, k) or (last and path not in self._even):
                before = self.reached[path]
                if k > before:
                    plant.step(self._time_of(before), float(self._flat.base * (k - before)))
                    self.reached[path] = k

    def hold(self, k: int) -> None:
        """Let the plants of which a tick is a communication point hold their inputs from there on."""
        if self.regular:
            self.take_inputs()
            return
        for path, own in self._own.items():
            if self._flat.steps_at(path, k):
                self.inputs[own] = self._z[own]

    def end_at(self, end: float, k: int) -> None:
        """Step all plants from where they stand to the end of the run, in s, after tick ``k`` and before the next."""
        for path, plant in self._plants.items():
            now = self._time_of(k if self.regular else self.reached[path])
            plant.step(now, end - now)

    def save(self) -> dict[str, Any] | None:
        """Return where the plants stand and what they hold; None where all of that is in z."""
        return None if self.regular else {"inputs": self.inputs.copy(), "reached": dict(self.reached)}

    def restore(self, saved: Mapping[str, Any] | None, k: int) -> None:
        """Go back to what `save` returned at tick ``k``."""
        self.begin(k)
        if saved is not None and not self.regular:
            self.inputs[:] = saved["inputs"]
            self.reached.update(saved["reached"])


def runs_apart(plant: Any) -> bool:
    """Whether a plant runs in a process of its own, so that its steps can go on beside others."""
    return not getattr(getattr(plant, "fmi", None), "in_process", True)


def asks_to_end(error: SimulationError) -> bool:
    """Whether an error is the request of a plant to end the run, and no failure."""
    return getattr(error, "ends_at", None) is not None


def step_all(plants: Iterable[Plant], t: float, h: float) -> None:
    """Let plants step from t over h, both in s; those in processes of their own step at the same time.

    Every step that has begun is ended, also where one fails; then the first error is raised, and a plant's request to
    end the run only where nothing else has failed.
    """
    begun: list[Any] = []
    failure: SimulationError | None = None
    for plant in plants:
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
    """End steps that have begun, each of them; then raise an error, by the rule of `step_all`.

    Parameters
    ----------
    failure : SimulationError, optional
        Error with which one could not begin.
    """
    for end in ends:
        try:
            end()
        except SimulationError as error:
            failure = error if failure is None or asks_to_end(failure) else failure
    if failure is not None:
        raise failure from failure.__cause__
