"""A measurement in the making: windows of a test signal, their phasors, and what contradicts them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram
from .injection import InjectionRun
from .waveforms import Part, compute_phasors

MOVED = 1e-3
"""Movement of the operating point, relative to 1 + the size of a state, that refutes a measurement."""
FINER = 0.1
"""Factor of the solver's tolerances in the second measurement."""


class Measurement:
    """Results of a measurement; the last axis is that of the lines."""

    def __init__(self, lines: int, n: int, outputs: int):
        self.v, self.u = np.zeros((n, n, lines), complex), np.zeros((n, n, lines), complex)
        self.y = np.zeros((outputs, n, lines), complex)
        self.uncertainty, self.distortion = np.zeros(lines), np.zeros(lines)
        self.windows, self.settled = np.zeros(lines, int), np.ones(lines, bool)
        self.moved, self.unexpected, self.held = 0.0, 0.0, True
        self.largest = np.inf
        """Size above which a signal shows that the diagram is not stable."""

    def note_movement(self, run: InjectionRun, before: np.ndarray, began: float, samples: int, every: int) -> None:
        """Note the change of the states since the time ``began`` in s, and its part that is no uniform drift.

        The drift is that of one more window, without a test signal.
        """
        here, elapsed = run.read_states(), run.t - began
        size, t = 1.0 + np.abs(before), run.t
        run.go(samples, every)
        drift = (run.read_states() - here) * elapsed / (run.t - t)
        change = np.abs(here - before)
        beyond = np.minimum(change, np.abs(here - before - drift))
        self.moved = max(self.moved, float(np.max(change / size, initial=0.0)))
        self.unexpected = max(self.unexpected, float(np.max(beyond / size, initial=0.0)))

    def compare(self, other: Measurement) -> None:
        """Add twice the relative distance to a second measurement to the uncertainty."""
        for mine, theirs in ((self.v, other.v), (self.u, other.u)):
            distance, size = (np.linalg.norm(m, axis=(0, 1)) for m in (mine - theirs, mine))
            self.uncertainty += 2.0 * distance / np.where(size > 0.0, size, 1.0)

    def refute_moved(self) -> None:
        """Add the movement of the operating point to the uncertainty, which it makes infinite if it is large."""
        if self.unexpected > MOVED:
            self.uncertainty[:], self.settled[:] = np.inf, False
        else:
            self.uncertainty += self.unexpected


def refine_tolerances(flat: FlatDiagram, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with smaller tolerances, where a solver has some."""
    if not flat.hybrid or chosen.get("solver", "auto") in ("euler", "heun", "rk4"):
        return dict(chosen)
    return {**chosen, "rtol": FINER * float(chosen["rtol"]), "atol": FINER * np.asarray(chosen["atol"])}


def _check_size(run: InjectionRun, part: Part, v: np.ndarray, largest: float) -> None:
    """Refuse to go on where a signal grows without end.

    Raises
    ------
    SimulationError
        If the signal at the wire is larger than any stable loop makes it.
    """
    size = float(np.max(np.abs(v), initial=0.0))
    if size <= largest:
        return
    block, port = run.signal.port
    raise SimulationError(
        f"found a signal that has grown to {size:.3g} under a test signal of "
        f"{float(np.max(np.abs(part.waveform.amplitude))):.3g}; expected one that settles: the diagram is not stable "
        "there. Look at linearize().poles.",
        block=block,
        port=port,
        t=run.t,
    )


def _is_noise(errors: Sequence[np.ndarray], agreement: float) -> bool:
    """Whether distances of windows, one after the other, don't fall any more where they are too large."""
    if len(errors) < 7:
        return False
    before, lately = np.min(errors[1:-3], axis=0), np.min(errors[-3:], axis=0)
    return bool(np.all((lately >= 0.9 * before) | (errors[-1] <= agreement)))


def measure_part(
    run: InjectionRun, part: Part, entry: int, j: int, every: int, windows: int, agreement: float,
    found: Measurement, i: int,
) -> None:  # fmt: skip
    """Play part i of the test signal at one entry until two windows agree; write the last one's phasors to ``found``.

    ``j`` is the entry's place among the injected ones.
    """
    n = part.samples
    run.play(part.waveform, entry, ramp=n * every * float(run.flat.base))
    run.go(n, every)
    last, count, errors = None, 0, [np.full(len(part.lines), np.inf)]
    while count < windows and not np.all(errors[-1] <= agreement) and not _is_noise(errors, agreement):
        v, u, y = run.record(n, every)
        _check_size(run, part, v, found.largest)
        here, rest = compute_phasors(part, np.hstack([v, u, y]))
        count, m = count + 1, v.shape[1]
        if last is not None:
            error = np.zeros(len(part.lines))
            for columns, data in ((slice(0, m), v), (slice(m, 2 * m), u)):
                size = np.linalg.norm(here[:, columns], axis=1)
                change = np.linalg.norm((here - last)[:, columns], axis=1) + np.finfo(float).eps * np.max(np.abs(data))
                error += change / np.where(size > 0.0, size, 1.0)
            errors.append(error)
        last = here
    assert last is not None
    error = np.max(errors[-3:], axis=0) if _is_noise(errors, agreement) else errors[-1]
    found.held &= run.held
    where = slice(i, i + 1) if found.v.shape[2] > len(part.lines) else slice(None)
    d = last[:, m + j] - last[:, j]  # u − v at the entry where it was added
    scaled = (last / d[:, None]).T
    found.v[:, j, where], found.u[:, j, where], found.y[:, j, where] = scaled[:m], scaled[m : 2 * m], scaled[2 * m :]
    found.uncertainty[where] = np.maximum(found.uncertainty[where], error)
    found.distortion[where] = np.maximum(found.distortion[where], rest)
    found.windows[where] = np.maximum(found.windows[where], count)
    found.settled[where] &= errors[-1] <= agreement
