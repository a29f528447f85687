"""A check that plants which go back to the beginning of a step are there again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import FmuRuntimeError
from .links import Links
from .plants import Plant

ROUNDING = 1e-9
"""Largest difference of an output that was restored, relative to its size."""


class Rollback:
    """Compares outputs after a step was taken back with those at its beginning."""

    # Both are read after a restore, so that an FMU which computes its outputs again then is compared with itself. An
    # output is compared until it has moved in a step and come back once.

    def __init__(self, links: Links, w: np.ndarray) -> None:
        self._links, self._w = links, w
        self._open = np.ones(len(w), dtype=bool)

    @property
    def is_open(self) -> bool:
        """Whether an output has not moved and come back yet."""
        return bool(self._open.any())

    def check(self, path: str, stepped: np.ndarray, begun: np.ndarray, t: float | None) -> None:
        """Compare the outputs of a plant that has just been restored."""
        mine = self._links.outputs[path]
        found, expected = self._w[mine], begun[mine]
        allowed = ROUNDING * (self._links.nominals[mine] + np.abs(expected))
        open_ = self._open[mine]
        off = np.where(open_ & np.isfinite(expected), np.abs(found - expected) / allowed, 0.0)
        if not off.max(initial=0.0) <= 1.0:
            worst = int(np.argmax(off))
            port = self._links.name_of_output(mine.start + worst)[1]
            raise FmuRuntimeError(
                "the FMU does not restore its state, although its function for that reports success: after a step was "
                f"taken back, found the output {found[worst]:.9g}; expected {expected[worst]:.9g}, its value at the "
                "beginning of the step. Take coupling='gauss_seidel' or 'jacobi' without error=, which never go back, "
                "with a smaller step, or an FMU whose canGetAndSetFMUState holds true.",
                block=path,
                port=port,
                t=t,
            )
        self._open[mine] = open_ & ~(np.abs(stepped - expected) > allowed)


TAKEN_BACK = 1e-3
"""Part of a step's change by which two halves differ from one half, where an FMU takes the first one back."""


def find_taken_back(links: Links, paths: Iterable[str], made: Sequence[np.ndarray], t: float) -> set[str]:
    """Return the plants that have moved in a whole step; refuse those that take back the first of two halves."""
    # A step behind a state that may be restored is not said to be final (noSetFMUStatePriorToCurrentPoint = false).
    # There are FMUs that go back to its beginning when the next one begins, although nothing has restored their state.
    moved, (half, halves, whole) = set(), made  # outputs of all plants after half a step, two halves, a whole step
    for path in paths:
        mine = links.outputs[path]
        change = np.abs(whole[mine] - half[mine])
        moving = change > 1e3 * ROUNDING * (links.nominals[mine] + np.abs(half[mine]))
        if not moving.any():
            continue
        moved.add(path)
        if np.all(np.abs(halves[mine] - half[mine])[moving] <= TAKEN_BACK * change[moving]):
            worst = int(np.argmax(change))
            raise FmuRuntimeError(
                "the FMU takes a step back when the next one begins, although its state was not restored: after two "
                f"half steps found the output {halves[mine][worst]:.9g}, as after one; expected about "
                f"{whole[mine][worst]:.9g}, as after a whole step. It takes noSetFMUStatePriorToCurrentPoint = false "
                "for a rejection. Take coupling='gauss_seidel' or 'jacobi' without error=, which never go back.",
                block=path,
                port=links.name_of_output(mine.start + worst)[1],
                t=t,
            )
    return moved


@dataclass
class Beginning:
    """The beginning of a communication step."""

    rest: Any
    plants: dict[str, Any]
    texts: dict[str, dict[str, list[Any]]]
    refused: dict[str, FmuRuntimeError | None]
    """Inputs out of their range in earlier steps that are tried with it, by path."""
    w: np.ndarray
    z: np.ndarray
    read: np.ndarray | None = None
    """Outputs as the plants give them when they are set back at once; None where that is not compared any more."""


def save_plant(plant: Plant) -> Any:
    """Return the state of a plant, for its ``restore``."""
    save = getattr(plant, "save", None)
    return plant.deserialize(plant.serialize()) if save is None else save()


def try_steps(plants: Iterable[Any]) -> None:
    """Let inputs out of their range be kept, and no error yet, as the next steps may be taken back."""
    for plant in plants:
        if hasattr(plant, "is_trial"):  # one that refuses no value has none
            plant.is_trial = True


def accept_steps(plants: Iterable[Any]) -> None:
    """Raise the error of an input that was out of its range in steps that are accepted."""
    for plant in plants:
        if getattr(plant, "refused", None) is not None:
            raise plant.refused


def texts_of(plant: Plant) -> Mapping[str, list[Any]]:
    """Return the record of a plant's texts by port."""
    found: Mapping[str, list[Any]] = getattr(plant, "texts", {})
    return found
