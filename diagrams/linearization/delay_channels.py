"""The transport delays of a diagram in continuous time, as channels, and what acts on what."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ...blocks.core import read_time
from ..flat import FlatDiagram
from ..wiring import find_cyclic_parts, join


@dataclass(frozen=True)
class DelayChannels:
    """The transport delays of a diagram in continuous time, one channel for each entry of their signals.

    ``inputs`` are places in z, ``outputs`` those in w, ``times`` the delays in s.
    """

    paths: tuple[str, ...]
    labels: tuple[str, ...]
    inputs: np.ndarray
    outputs: np.ndarray
    times: tuple[Fraction, ...]

    def __len__(self) -> int:
        return len(self.times)


def delay_channels(flat: FlatDiagram) -> DelayChannels:
    """Return the transport delays of a diagram that are in continuous time."""
    paths, labels, inputs, outputs, times = list[str](), list[str](), list[int](), list[int](), list[Fraction]()
    for path in sorted(flat.table.blocks):
        block = flat.table.blocks[path]
        if not block.transport or path in flat.checked.traced:
            continue
        into, out = flat.plant_inputs.slices[join(path, "u")], flat.plant_outputs.slices[join(path, "y")]
        inputs += range(into.start, into.stop)
        outputs += range(out.start, out.stop)
        labels += flat.plant_outputs.labels[out]
        paths += [path] * (out.stop - out.start)
        times += [read_time(float(block.delay)) or Fraction(float(block.delay))] * (out.stop - out.start)
    return DelayChannels(
        tuple(paths), tuple(labels), np.array(inputs, dtype=int), np.array(outputs, dtype=int), tuple(times)
    )


def blocks_around(flat: FlatDiagram, delays: Iterable[str]) -> tuple[str, ...]:
    """Return the blocks on ways without a state that lead from some transport delays back to them, sorted by path.

    ``delays`` are paths of blocks, and the delays are among what is returned.
    """
    traced, every = flat.checked.traced, set(delay_channels(flat).paths)
    edges: list[tuple[str, str]] = []
    for (block, port), wire in flat.table.wires.items():
        outputs = (
            [name for name in traced[block].outputs if port in traced[block].depends[name]] if block in traced else []
        )
        edges += [(join(wire.block, wire.port), join(block, out)) for out in (["y"] if block in every else outputs)]
    parts = find_cyclic_parts(sorted({key for edge in edges for key in edge}), edges)
    blocks = [{key.rpartition(".")[0] for key in part} for part in parts]
    return tuple(sorted(set().union(*(part for part in blocks if part & set(delays)))))


def reaches(M: np.ndarray) -> np.ndarray:
    """Return which entries of the exponential of a matrix may not be 0: (i, j) where j acts on i in some steps."""
    found = (M != 0.0) | np.eye(len(M), dtype=bool)
    while True:
        more = (found.astype(int) @ found.astype(int)) > 0
        if np.array_equal(more, found):
            return np.asarray(found)
        found = more


def find_loops(acts: np.ndarray) -> list[int]:
    """Return the delays that act on themselves, where (i, j) says whether j acts on i."""
    further = reaches(acts)
    return [i for i in range(len(acts)) if any(further[j, i] for j in np.flatnonzero(acts[i]))]
