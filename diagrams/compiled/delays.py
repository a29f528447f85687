"""Transport delays in continuous time, as the loop in C knows them."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from .bound_functions import TickStructure, at
from .hybrid_structures import DelaysStructure


class PastInputs(Protocol):
    """The memory of a run's transport delays; see `loopwright.diagrams.simulation.transport_delays.Delays`."""

    taus: list[float]
    inputs: list[slice]
    outputs: list[slice]
    start: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    pieces: np.ndarray
    edges: np.ndarray
    count: int
    noted: int
    smoothed: bool

    def make_room(self, t: float) -> None:
        """Make room for one more step of a loop in C, at a time in s."""


class NativeDelays:
    """Transport delays bound to the numbers of a run, whose memory of past inputs C reads and writes.

    Parameters
    ----------
    past : PastInputs
        The memory.
    driven : TickStructure
        Evaluates the inputs z at a trial.
    z : ndarray
        Its result.
    here, trial : ndarray
        The vector w of the run, and that of trials.
    tolerances : pair of float
        Relative and absolute tolerance with which inputs are kept.
    """

    def __init__(
        self,
        past: PastInputs,
        driven: TickStructure,
        z: np.ndarray,
        here: np.ndarray,
        trial: np.ndarray,
        tolerances: tuple[float, float],
    ):
        self._past, self._kept = past, list[Any]([driven, z, here, trial])
        self.structure = DelaysStructure(
            n=len(past.taus),
            distinct=len(set(past.taus)),
            tau=self._own(past.taus),
            different=self._own(sorted(set(past.taus))),
            input=self._own([s.start for s in past.inputs], np.int64),
            output=self._own([s.start for s in past.outputs], np.int64),
            size=self._own([s.stop - s.start for s in past.inputs], np.int64),
            start=at(past.start),
            node=self._own(past.nodes),
            weight=self._own(past.weights),
            inputs=z.size,
            outputs=here.size,
            here=at(here),
            trial=at(trial),
            driven=driven,
            z=at(z),
            found=self._own(np.zeros(z.size)),
            rtol=tolerances[0],
            atol=tolerances[1],
            smoothed=past.smoothed,
        )

    def _own(self, values: Sequence[Any] | np.ndarray, kind: type = float) -> int | None:
        self._kept.append(np.array(values, dtype=kind))
        return at(self._kept[-1])

    @property
    def address(self) -> int:
        """Address of the delays as C knows them."""
        return ctypes.addressof(self.structure)

    def hand_over(self, t: float) -> None:
        """Let C continue from a time in s."""
        past, of = self._past, self.structure
        past.make_room(t)
        of.pieces, of.edges = at(past.pieces), at(past.edges)
        of.capacity, of.room, of.count, of.noted = len(past.pieces), len(past.edges), past.count, past.noted

    def take_back(self) -> None:
        """Let Python continue from where C has come to."""
        self._past.count, self._past.noted = self.structure.count, self.structure.noted
