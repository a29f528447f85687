"""The plants of a run as the loop in C steps them: by itself, or by Python where it can't."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial

import numpy as np

from ...fmus.calls import FmuInstance
from ..compiled import (
    REFUSED,
    TAKEN_BY_PYTHON,
    UNDER_WAY,
    CompiledLoop,
    Outcome,
    PythonStep,
    ReturnReason,
    compile_other_side,
)
from ..coupling import CoupledSteps, Plant, PlantSteps, end_all, runs_apart
from ..flat import FlatDiagram, StepTable, times_of


class PlantsInC:
    """The plants of a run, in the order in which the loop in C goes over them."""

    def __init__(
        self, flat: FlatDiagram, plants: Mapping[str, Plant], steps: PlantSteps, coupled: CoupledSteps | None = None
    ):
        self._flat, self._plants, self.steps, self._coupled = flat, plants, steps, coupled
        self.ended: float | None = None
        """Time in s at which a stop condition has ended the run within a coupled step."""
        self.turn: Callable[[float], AbstractContextManager[None]] = lambda t: nullcontext()
        """Gives the run's numbers to Python for a coupled step that ends at a time in s."""
        self.entries: dict[str, FmuInstance | PythonStep] = {
            path: plant if isinstance(plant, FmuInstance) else partial(_step, plant) for path, plant in plants.items()
        }
        """What C goes over, by path: an FMU, or a step that Python takes; one of all plants where they are coupled."""
        if coupled is not None:
            self.entries = {"": self._step_coupled}

    @property
    def are_coupled(self) -> bool:
        """Whether another coupling than "jacobi" is asked for."""
        return self._coupled is not None

    @property
    def held(self) -> tuple[np.ndarray, np.ndarray]:
        """Inputs of all plants as they are now, and as they are held between ticks; one array where these agree."""
        return self.steps.z, self.steps.inputs

    @property
    def inputs(self) -> list[slice]:
        """The inputs of each plant among them; none where all plants step at all ticks."""
        return [] if self.steps.regular else [self.steps.own[path] for path in self.entries]

    def _step_coupled(self, t: float, h: float) -> bool:
        assert self._coupled is not None
        base = self._flat.base
        end = round((t + h) * base.denominator / base.numerator) * base.numerator / base.denominator
        with self.turn(end):
            self.ended = self._coupled.go(t, end, h)
        return self.ended is not None or any(getattr(plant, "ends_run", False) for plant in self._plants.values())

    def prepare(self) -> Callable[[], object]:
        """Return a function that compiles what the steps of plants need apart from the code of a diagram."""
        return compile_other_side if any(map(runs_apart, self.entries.values())) else lambda: None

    def table(self, ticks: np.ndarray, last: int) -> StepTable | None:
        """Return the steps to ticks that come next; None where all plants step at each of them."""
        return self.steps.table(ticks, last)

    def arrive(self, k: int, last: int) -> None:
        """Note that C has stepped the plants up to a tick."""
        self.steps.arrive(k, last=k == last)

    def go(self, k: int, following: int, last: int) -> None:
        """Take the steps from a visited tick to the next one by Python."""
        if self._coupled is None:
            self.steps.go(k, following, last=following == last)
        else:
            now, h = times_of(self._flat, np.array([k, following - k])).tolist()
            self._step_coupled(now, h)

    def end_at(self, end: float, k: int) -> float | None:
        """Take the steps to the end of a run, in s, after tick ``k`` and before the next; see `CoupledSteps.go`."""
        if self._coupled is None:
            self.steps.end_at(end, k)
            return None
        now = k * self._flat.base.numerator / self._flat.base.denominator
        return self._coupled.go(now, end, end - now)

    def no_steps(self) -> StepTable | None:
        """Return that no plant steps to a tick; None where all plants step at all ticks."""
        if self.steps.regular:
            return None
        shape = 1, len(self._plants)
        return StepTable(np.zeros(shape), np.zeros(shape), np.zeros(shape, dtype=np.uint8))

    def continue_steps(self, loop: CompiledLoop, found: Outcome, k: int, following: int, last: int) -> None:
        """Continue with the steps from a visited tick to the next one, from the plant on that C could not go beyond."""
        if found.stage == REFUSED:
            self.go(k, following, last)
            return
        if self._coupled is not None:
            loop.plants.check_steps()
            return
        due, rest = self.steps.due(k, following, last=following == last), list[Callable[[], None]]()
        places = enumerate(zip(self._plants.items(), loop.plants.begun(), strict=True))
        for place, ((path, plant), begun) in places:
            if place < found.plant or path not in due:
                continue
            if begun:
                assert isinstance(plant, FmuInstance)
                rest.append(partial(plant.finish_remote, *due[path]))
            elif place > found.plant:
                rest.append(partial(plant.step, *due[path]))
            elif found.stage == TAKEN_BY_PYTHON:
                rest.append(loop.plants.check_steps)
            else:
                assert found.stage != UNDER_WAY
                assert isinstance(plant, FmuInstance)
                status = found.status if found.reason is ReturnReason.FMU_FAILED else 0
                rest.append(partial(_judge, plant, found.stage, status, *due[path]))
        if self.steps.apart:
            end_all(rest)
        else:
            for end in rest:
                end()
        self.steps.arrive(following, last=following == last)


def _step(plant: Plant, t: float, h: float) -> bool:
    plant.step(t, h)
    return bool(getattr(plant, "ends_run", False))


def _judge(plant: FmuInstance, stage: int, status: int, t: float, h: float) -> None:
    plant.judge_native(stage, status, t, h)
    plant.read(t + h)
