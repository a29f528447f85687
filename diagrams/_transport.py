"""Transport delays in continuous time: what went in, kept as polynomials over the solver's steps.

The output at t is the input at t − τ. As long as no step of the solver is longer than the shortest τ, that lies in the
past: it is a known function of time, and the delays cost the solver no states (the method of steps). Each accepted step
is kept as the polynomial through the input at Chebyshev points of the second kind; a discontinuity of the input comes
out τ later, and the solver lands there.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_right
from collections.abc import Callable
from typing import Any

import numpy as np

_NODES = 9


class Delays:
    """All transport delays of a run.

    Parameters
    ----------
    taus : list of float
        Delay of each in s.
    inputs, outputs : list of slice
        Where the inputs stand in z, and the outputs in w.
    starts : list of ndarray
        Output of each until its delay has passed; None takes the first input.
    """

    def __init__(self, taus: list[float], inputs: list[slice], outputs: list[slice], starts: list[np.ndarray | None]):
        self.taus, self.inputs, self.outputs, self.starts = taus, inputs, outputs, starts
        self._from_input = [start is None for start in starts]
        self.shortest = min(taus, default=math.inf)
        angles = np.pi * np.arange(_NODES) / (_NODES - 1)
        self.nodes = 0.5 * (1.0 - np.cos(angles))
        self.weights = (-1.0) ** np.arange(_NODES)
        self.weights[[0, -1]] *= 0.5
        self._from: list[float] = []
        self._to: list[float] = []
        self._samples: list[np.ndarray] = []
        self._edges: list[float] = []
        self.middle = 0.0
        """An instant within the segment that is being solved: tells which side of a discontinuity is meant."""

    def begin(self, z: np.ndarray, w: np.ndarray) -> None:
        """Take the inputs at the start where there is no initial value, and put them out."""
        for i, where in enumerate(self.inputs):
            if self._from_input[i]:
                self.starts[i] = z[where].copy()
        self.outputs_at(0.0, w)

    def times(self, t_old: float, t: float) -> np.ndarray:
        """Return the instants of a step at which `keep` wants the inputs."""
        found = t_old + (t - t_old) * self.nodes
        found[-1] = t
        return np.array(found)

    def keep(self, t_old: float, t: float, samples: np.ndarray) -> None:
        """Keep a step: the vector z at each of `times`."""
        self._from.append(t_old)
        self._to.append(t)
        self._samples.append(samples)
        old = t - max(self.taus) - 1e-9 * (1.0 + abs(t))
        drop = bisect_right(self._to, old) - 1
        if drop > 1000:  # what no delay reaches any more
            del self._from[:drop], self._to[:drop], self._samples[:drop]

    def edge(self, t: float) -> None:
        """Note a discontinuity of the inputs."""
        for tau in self.taus:
            heapq.heappush(self._edges, t + tau)

    def next_edge(self, t: float) -> float:
        """Return the next time after ``t`` at which a discontinuity comes out."""
        while self._edges and self._edges[0] <= t:
            heapq.heappop(self._edges)
        return self._edges[0] if self._edges else math.inf

    def outputs_at(self, t: float, w: np.ndarray) -> None:
        """Write the outputs at a time into w."""
        for tau, into, where, start in zip(self.taus, self.outputs, self.inputs, self.starts, strict=True):
            w[into] = self._value(t - tau, self.middle - tau, where, start)

    def _value(self, s: float, inside: float, where: slice, start: Any) -> Any:
        nudged = s + 1e-9 * (inside - s)
        i = bisect_right(self._from, nudged) - 1
        if i < 0:
            return 0.0 if start is None else start
        a, b = self._from[i], self._to[i]
        samples = self._samples[i][:, where]
        difference = (s - a) / (b - a) - self.nodes
        exact = np.flatnonzero(difference == 0.0)
        if exact.size:
            return samples[exact[0]]
        factors = self.weights / difference
        return factors @ samples / factors.sum()

    def save(self) -> Any:
        """Return what is needed to go on from here."""
        return list(self._from), list(self._to), list(self._samples), list(self._edges), list(self.starts)

    def restore(self, saved: Any) -> None:
        """Go back to what `save` returned."""
        self._from, self._to, self._samples, self._edges, self.starts = (list(part) for part in saved)


def step_inputs(
    delays: Delays,
    t_old: float,
    t: float,
    state: Callable[[float], np.ndarray],
    inputs: Callable[[float, np.ndarray], np.ndarray],
) -> None:
    """Keep one accepted step of the solver."""
    times = delays.times(t_old, t)
    delays.keep(t_old, t, np.array([inputs(float(s), state(float(s))).copy() for s in times]))
