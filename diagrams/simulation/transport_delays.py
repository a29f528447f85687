"""Transport delays in continuous time: their inputs, kept as polynomials over the solver's steps.

The output at t is the input at t − τ. As long as no step of the solver is longer than the shortest τ, that lies in the
past: it is a known function of time, and the delays cost the solver no states (the method of steps). Each accepted step
is kept as the polynomial through the input at Chebyshev points of the second kind, halved until that is as exact as the
solver's tolerance asks for: what goes in need not be what the solver looks at. A discontinuity of the input comes out τ
later, and the solver lands there. Where no delay feeds through to another, each way round is smoothed by a state: after
some of them the solver need not land there any more.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import Any

import numpy as np

from ...blocks.core import ShapeError, is_before
from ..flat import FlatDiagram
from ..wiring import join

_NODES = 9
_BETWEEN = (0.0211, 0.2671, 0.5837, 0.9113)  # where the polynomial is compared with the input, parts of a step
_DEEPEST = 10  # a step is halved so often at most
_ROUNDING = 1e-13
_SMOOTH = 8  # a discontinuity in the derivative of this order is none to a solver


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
    smoothed : bool
        Whether a state stands between any output and any input of a delay.
    """

    def __init__(
        self,
        taus: list[float],
        inputs: list[slice],
        outputs: list[slice],
        starts: list[np.ndarray | None],
        *,
        smoothed: bool = True,
    ):
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
        self._edges: list[tuple[float, int]] = []
        self.smoothed = smoothed
        self._middle = 0.0  # an instant within the segment that is being solved

    def begin(self, z: np.ndarray, w: np.ndarray) -> None:
        """Take the inputs at the start where there is no initial value, and put them out."""
        for i, where in enumerate(self.inputs):
            if self._from_input[i]:
                self.starts[i] = z[where].copy()
        self.outputs_at(0.0, w)

    def look_from(self, t: float) -> None:
        """Take the side of a discontinuity that is towards a time within the segment that is being solved."""
        self._middle = t

    def sample_times(self, t_old: float, t: float) -> np.ndarray:
        """Return the instants of a step at which `keep` wants the inputs."""
        found = t_old + (t - t_old) * self.nodes
        found[-1] = t
        return np.array(found)

    def keep(self, t_old: float, t: float, samples: np.ndarray) -> None:
        """Keep a step: the vector z at each of `sample_times`."""
        self._from.append(t_old)
        self._to.append(t)
        self._samples.append(samples)
        old = t - max(self.taus) - 1e-9 * (1.0 + abs(t))
        drop = bisect_right(self._to, old) - 1
        if drop > 1000:  # no delay reaches them any more
            del self._from[:drop], self._to[:drop], self._samples[:drop]

    def note_edge(self, t: float, order: int = 0) -> None:
        """Note a discontinuity of the inputs, or of their derivative of some order; one instant is noted once."""
        for tau in sorted(set(self.taus)):
            i = bisect_left(self._edges, (t + tau, -1))
            near = [k for k in (i - 1, i) if 0 <= k < len(self._edges) and _same(self._edges[k][0], t + tau)]
            if near:
                self._edges[near[0]] = (self._edges[near[0]][0], min(self._edges[near[0]][1], order))
            else:
                self._edges.insert(i, (t + tau, order))

    def next_edge(self, t: float) -> float:
        """Return the next time after ``t`` at which a discontinuity comes out."""
        while self._edges and not is_before(t, self._edges[0][0]):
            self._edges.pop(0)
        return self._edges[0][0] if self._edges else math.inf

    def note_reached(self, t: float, *, from_source: bool) -> None:
        """Note a discontinuity at ``t``, of a source or out of a delay: it goes into the delays."""
        order = 0 if from_source else math.inf
        while self._edges and not is_before(t, self._edges[0][0]):
            order = min(order, self._edges.pop(0)[1] + self.smoothed)
        if order < _SMOOTH:
            self.note_edge(t, int(order))

    def outputs_at(self, t: float, w: np.ndarray) -> None:
        """Write the outputs at a time into w."""
        for tau, into, where, start in zip(self.taus, self.outputs, self.inputs, self.starts, strict=True):
            w[into] = self._value(t - tau, self._middle - tau, where, start)

    def _value(self, s: float, inside: float, where: slice, start: Any) -> Any:
        nudged = s + 1e-9 * (inside - s)
        i = bisect_right(self._from, nudged) - 1
        if i < 0:
            return 0.0 if start is None else start
        a, b = self._from[i], self._to[i]
        return barycentric(self, (s - a) / (b - a), self._samples[i][:, where])

    def save(self) -> Any:
        """Return the memory with which a run goes on from here."""
        return list(self._from), list(self._to), list(self._samples), list(self._edges), list(self.starts)

    def restore(self, saved: Any) -> None:
        """Go back to the memory that `save` returned."""
        self._from, self._to, self._samples, self._edges, self.starts = (list(part) for part in saved)


def keep_step(
    delays: Delays,
    t_old: float,
    t: float,
    state: Callable[[float], np.ndarray],
    inputs: Callable[[float, np.ndarray], np.ndarray],
    tolerance: tuple[float, float],
) -> None:
    """Keep one accepted step of the solver, in as many pieces as the tolerance (relative, absolute) asks for."""
    rtol, atol = tolerance

    def at(times: np.ndarray) -> np.ndarray:
        return np.array([inputs(float(s), state(float(s))).copy() for s in times])

    def keep_piece(a: float, b: float, depth: int) -> None:
        samples = at(delays.sample_times(a, b))
        between = np.array([barycentric(delays, part, samples) for part in _BETWEEN])
        found = at(a + (b - a) * np.array(_BETWEEN))
        size = np.max(np.abs(samples), axis=0)
        allowed = np.maximum(0.1 * (atol + rtol * size), _ROUNDING * size)
        middle = 0.5 * (a + b)
        if depth and a < middle < b and np.any(np.abs(between - found) > allowed):
            keep_piece(a, middle, depth - 1)
            keep_piece(middle, b, depth - 1)
        else:
            delays.keep(a, b, samples)

    keep_piece(t_old, t, _DEEPEST)


def barycentric(delays: Delays, part: float, samples: np.ndarray) -> np.ndarray:
    """Return the polynomial through samples at the nodes, at a part of the step."""
    difference = part - delays.nodes
    exact = np.flatnonzero(difference == 0.0)
    if exact.size:
        return np.array(samples[exact[0]])
    factors = delays.weights / difference
    return np.array(factors @ samples / factors.sum())


def _same(a: float, b: float) -> bool:
    return not is_before(a, b) and not is_before(b, a)


def delays_of(flat: FlatDiagram) -> Delays | None:
    """Return the transport delays of a diagram that are in continuous time; None if there are none."""
    table = flat.table
    paths = [p for p in sorted(table.blocks) if table.blocks[p].transport and p not in flat.checked.traced]
    if not paths:
        return None
    blocks: list[Any] = [table.blocks[p] for p in paths]
    inputs = [flat.plant_inputs.slices[join(p, "u")] for p in paths]
    starts: list[Any] = []
    for path, block in zip(paths, blocks, strict=True):
        shape = flat.plant_inputs.shapes[join(path, "u")]
        if block.initial_value is None:
            starts.append(None)  # the first input; see `Delays.begin`
            continue
        try:
            starts.append(np.ravel(np.broadcast_to(np.asarray(block.initial_value, dtype=float), shape)).copy())
        except ValueError:
            raise ShapeError(
                f"found an initial_value of shape {np.shape(block.initial_value)}; expected {shape}, that of the "
                "input, or a number.",
                block=path,
                port="initial_value",
            ) from None
    outputs = [flat.plant_outputs.slices[join(p, "y")] for p in paths]
    into, out = (np.concatenate([np.arange(s.start, s.stop) for s in part]) for part in (inputs, outputs))
    straight = bool(np.any(flat.driven.depends("z", "w")[np.ix_(into, out)]))  # from a delay into another, or itself
    smoothed = not (flat.loops.slices or straight)
    return Delays([b.delay for b in blocks], inputs, outputs, starts, smoothed=smoothed)
