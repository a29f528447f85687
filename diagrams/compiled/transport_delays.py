"""Transport delays in continuous time: their inputs, kept as polynomials over the solver's steps.

The output at t is the input at t − τ. As long as no step of the solver is longer than the shortest τ, that lies in the
past: it is a known function of time, and the delays cost the solver no states (the method of steps). Each accepted step
is kept as the polynomial through the input at Chebyshev points of the second kind, halved until that is as exact as the
solver's tolerance asks for: what goes in need not be what the solver looks at. A discontinuity of the input comes out τ
later, and the solver lands there. Where no delay feeds through to another, each way round is smoothed by a state: after
some of them the solver need not land there any more. C keeps the steps (`fmus/runtime/delays.c`).
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...blocks.core import ShapeError, is_before
from ..flat import FlatDiagram
from ..wiring import join
from .bound_functions import MemoryForC, TickStructure, at
from .hybrid_structures import DelaysStructure

_NODES = 9
_ROOM = 2048  # pieces and discontinuities that there is memory for, at first
_STEP = 1100  # of them, that one step may make: halved ten times, it has 1024 parts


class Delays:
    """All transport delays of a run.

    Parameters
    ----------
    taus : list of float
        Delay of each in s.
    inputs, outputs : list of slice
        Where the inputs are in z, and the outputs in w.
    starts : list of ndarray
        Output of each until its delay has passed; None takes the first input.
    smoothed : bool
        Whether a state is between any output and any input of a delay.
    total : int, optional
        Number of entries of z.

    Attributes
    ----------
    pieces : ndarray, shape (m, 2 + 9 total)
        Past inputs, of which the first ``count`` rows are known: begin and end of a step or of a part of it in s, then
        z at its nodes. A loop in C reads and writes the same memory.
    edges : ndarray, shape (k, 2)
        Discontinuities that come out, of which the first ``noted`` rows are known: time in s, and the order of the
        derivative that jumps.
    start : ndarray, shape (total,)
        What comes out until a delay has passed, at the entries of its input.
    """

    def __init__(
        self,
        taus: list[float],
        inputs: list[slice],
        outputs: list[slice],
        starts: list[np.ndarray | None],
        *,
        smoothed: bool = True,
        total: int | None = None,
    ):
        self.taus, self.inputs, self.outputs = taus, inputs, outputs
        total = max((where.stop for where in inputs), default=0) if total is None else total
        self._from_input = [start is None for start in starts]
        self.start = np.zeros(total)
        for where, start in zip(inputs, starts, strict=True):
            if start is not None:
                self.start[where] = start
        self.shortest = min(taus, default=math.inf)
        angles = np.pi * np.arange(_NODES) / (_NODES - 1)
        self.nodes = 0.5 * (1.0 - np.cos(angles))
        self.weights = (-1.0) ** np.arange(_NODES)
        self.weights[[0, -1]] *= 0.5
        self.pieces, self.count = np.empty((_ROOM, 2 + _NODES * total)), 0
        self.edges, self.noted = np.empty((_ROOM, 2)), 0
        self.smoothed = smoothed
        self._middle = 0.0  # an instant within the segment that is being solved

    def begin(self, z: np.ndarray, w: np.ndarray) -> None:
        """Take the inputs at the start where there is no initial value, and put them out."""
        for i, where in enumerate(self.inputs):
            if self._from_input[i]:
                self.start[where] = z[where]
        self.outputs_at(0.0, w)

    def begin_at(self, w: np.ndarray) -> None:
        """Take what is put out at the beginning of a run as all that went in before."""
        for into, where in zip(self.outputs, self.inputs, strict=True):
            self.start[where] = w[into]

    def look_from(self, t: float) -> None:
        """Take the side of a discontinuity that is towards a time within the segment that is being solved."""
        self._middle = t

    def make_room(self, t: float) -> None:
        """Forget inputs that no delay reaches any more at a time in s; make room for a step of a loop in C."""
        edges = max(_STEP, 20 * len(self.taus))
        if self.count + _STEP > len(self.pieces):
            old = t - max(self.taus) - 1e-9 * (1.0 + abs(t))
            drop = max(0, int(self.pieces[: self.count, 1].searchsorted(old, side="right")) - 1)
            kept = self.pieces[drop : self.count]
            if 2 * len(kept) + _STEP > len(self.pieces):
                self.pieces = np.empty((2 * len(self.pieces), self.pieces.shape[1]))
            self.pieces[: len(kept)], self.count = kept.copy(), len(kept)
        if self.noted + edges > len(self.edges):
            self.edges = np.concatenate([self.edges, np.empty((len(self.edges) + edges, 2))])

    def note_edge(self, t: float) -> None:
        """Note a discontinuity of the inputs; one instant is noted once."""
        for tau in sorted(set(self.taus)):
            edges = self.edges[: self.noted]
            i = int(edges[:, 0].searchsorted(t + tau))
            near = [k for k in (i - 1, i) if 0 <= k < self.noted and _same(edges[k, 0], t + tau)]
            if near:
                edges[near[0], 1] = 0  # of the inputs, and not of a derivative alone
            else:
                self.make_room(t)
                self.edges[i + 1 : self.noted + 1] = self.edges[i : self.noted].copy()
                self.edges[i], self.noted = (t + tau, 0), self.noted + 1

    def outputs_at(self, t: float, w: np.ndarray) -> None:
        """Write the outputs at a time into w."""
        for tau, into, where in zip(self.taus, self.outputs, self.inputs, strict=True):
            w[into] = self._value(t - tau, self._middle - tau, where)

    def _value(self, s: float, inside: float, where: slice) -> Any:
        nudged = s + 1e-9 * (inside - s)
        i = int(self.pieces[: self.count, 0].searchsorted(nudged, side="right")) - 1
        if i < 0:
            return self.start[where]
        a, b = self.pieces[i, :2]
        return barycentric(self, (s - a) / (b - a), self.pieces[i, 2:].reshape(_NODES, -1)[:, where])

    def save(self) -> Any:
        """Return the memory with which a run continues from here."""
        return self.pieces[: self.count].copy(), self.edges[: self.noted].copy(), self.start.copy()

    def restore(self, saved: Any) -> None:
        """Go back to the memory that `save` returned."""
        pieces, edges, self.start[:] = saved
        self.count, self.noted = len(pieces), len(edges)
        self.pieces = np.concatenate([pieces, np.empty((_ROOM, pieces.shape[1]))])
        self.edges = np.concatenate([edges, np.empty((_ROOM, 2))])


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


class NativeDelays:
    """Transport delays bound to the numbers of a run, whose memory of past inputs C reads and writes.

    ``driven`` evaluates the inputs z at a trial, whose outputs of delays are in ``trial``; ``here`` are those of the
    run. Inputs are kept within ``tolerances``, relative and absolute.
    """

    def __init__(
        self,
        past: Delays,
        driven: TickStructure,
        z: np.ndarray,
        here: np.ndarray,
        trial: np.ndarray,
        tolerances: tuple[float, float],
    ):
        self._past, self._memory = past, MemoryForC(driven, z, here, trial)
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
        return self._memory.own(np.array(values, dtype=kind))

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
    total = flat.plant_inputs.total
    return Delays([b.delay for b in blocks], inputs, outputs, starts, smoothed=smoothed, total=total)
