"""A measurement in the making: windows of a test signal, their phasors, and what contradicts them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram
from ..solvers import FIXED
from .injection import InjectionRun, Part, compute_phasors

MOVED = 1e-3
"""Movement of the operating point, relative to 1 + the size of a state, that refutes a measurement."""
SHARE = 0.95
"""Share of the measurements with noise whose error is at most what the noise adds to the uncertainty."""
SWAMPED = 0.1
"""Relative error by noise beyond which a line is not measured."""
WANDERS = 10.0
"""Movement of a state that noise explains, in standard deviations, of which few samples give an estimate only."""
LIKE = 3.0
"""Ratio of two distances of windows that both are noise."""
PARTS = 8
"""Parts of the last window, at whose ends the scatter of the states is looked at."""
FINER = 0.1
"""Factor of the solver's tolerances in the second measurement."""


class Measurement:
    """Results of a measurement; the last axis is that of the lines."""

    def __init__(self, lines: int, n: int, outputs: int):
        self.v, self.u = np.zeros((n, n, lines), complex), np.zeros((n, n, lines), complex)
        self.y = np.zeros((outputs, n, lines), complex)
        self.uncertainty, self.distortion = np.zeros(lines), np.zeros(lines)
        self.windows, self.settled = np.zeros(lines, int), np.ones(lines, bool)
        self.noise = np.zeros((2, lines))
        """Relative errors of v and u by noise; 0 where two windows agree."""
        self.moved, self.unexpected, self.held = 0.0, 0.0, True
        self.largest = np.inf
        """Size above which a signal shows that the diagram is not stable."""

    def note_movement(self, run: InjectionRun, before: np.ndarray, began: float, samples: int, every: int) -> None:
        """Note the change of the states since the time ``began`` in s, and its part that is no uniform drift.

        The drift is that of one more window, without a test signal. Where noise was seen, a state that scatters in that
        window has moved only as far as its scatter does not explain.
        """
        here, elapsed = run.read_states(), run.t - began
        size, t = 1.0 + np.abs(before), run.t
        ends = np.unique(np.linspace(0, samples, PARTS + 1).astype(int))
        seen = [here]
        for count in np.diff(ends):
            run.go(int(count), every)
            seen.append(run.read_states())
        drift = (seen[-1] - here) * elapsed / (run.t - t)
        change = np.abs(here - before)
        beyond = np.minimum(change, np.abs(here - before - drift))
        if self.noise.any():
            beyond = np.maximum(0.0, beyond - WANDERS * _scatter(ends, np.array(seen)))
        self.moved = max(self.moved, float(np.max(change / size, initial=0.0)))
        self.unexpected = max(self.unexpected, float(np.max(beyond / size, initial=0.0)))

    def compare(self, other: Measurement) -> None:
        """Add twice the relative distance to a second measurement, beyond the noise of both, to the uncertainty."""
        for mine, theirs, noise in zip((self.v, self.u), (other.v, other.u), self.noise + other.noise, strict=True):
            distance, size = (np.linalg.norm(m, axis=(0, 1)) for m in (mine - theirs, mine))
            self.uncertainty += 2.0 * np.maximum(0.0, distance / np.where(size > 0.0, size, 1.0) - noise)

    def refute_moved(self) -> None:
        """Add the movement of the operating point to the uncertainty, which it makes infinite if it is large."""
        if self.unexpected > MOVED:
            self.uncertainty[:], self.settled[:] = np.inf, False
        else:
            self.uncertainty += self.unexpected


def refine_tolerances(flat: FlatDiagram, chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Return options with smaller tolerances, where a solver has some."""
    if not flat.hybrid or chosen.get("solver", "auto") in FIXED:
        return dict(chosen)
    return {**chosen, "rtol": FINER * float(chosen["rtol"]), "atol": FINER * np.asarray(chosen["atol"])}


def _check_size(run: InjectionRun, part: Part, v: np.ndarray, largest: float) -> None:
    """Refuse to continue where a signal grows without end."""
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


def _begin_of_noise(errors: Sequence[np.ndarray], noisy: np.ndarray) -> int:
    """Return the first window, of at least four, from which on distances are of the size of the last three.

    The first two are left out in any case: the response may still be coming to rest in them.
    """
    level = LIKE * np.max(errors[-3:], axis=0)
    falling = [k for k in range(1, len(errors) - 3) if np.any((errors[k] > level) & noisy)]
    return max(2, falling[-1] if falling else 0)


def _scatter(at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the standard deviation of each column about its straight line."""
    if len(at) < 4:
        return np.zeros(values.shape[1])
    line = np.column_stack([np.ones(len(at)), at / at[-1]])
    rest = values - line @ np.linalg.lstsq(line, values)[0]
    return np.asarray(np.sqrt(np.sum(rest**2, axis=0) / (len(at) - 2)))


def _find_noise(phasors: np.ndarray) -> np.ndarray:
    """Return the error of the mean of windows by noise, by line, that `SHARE` of all means keep.

    Of m complex normal values, |mean − true|² over Σ|value − mean|²/(m (m − 1)) is F-distributed with 2 and 2 (m − 1)
    degrees of freedom, whose quantile is (m − 1) ((1 − share)^(−1/(m − 1)) − 1).
    """
    m = len(phasors)
    quantile = (m - 1) * ((1.0 - SHARE) ** (-1.0 / (m - 1)) - 1.0)
    squares = np.sum(np.abs(phasors - np.mean(phasors, axis=0)) ** 2, axis=(0, 2))
    return np.asarray(np.sqrt(quantile * squares / (m * (m - 1))))


def measure_part(
    run: InjectionRun,
    part: Part,
    entry: int,
    j: int,
    every: int,
    windows: int,
    agreement: float,
    found: Measurement,
    i: int,
) -> None:
    """Play part i of the test signal at one entry until two windows agree; write the last one's phasors to ``found``.

    Where the distance of windows is noise, which falls no further, the mean of the windows since then is written.

    ``j`` is the entry's place among the injected ones.
    """
    n = part.samples
    run.play(part.waveform, entry, ramp=n * every * float(run.flat.base))
    run.go(n, every)
    last, count, errors, all_windows = None, 0, [np.full(len(part.lines), np.inf)], []
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
        all_windows.append(here)
    assert last is not None
    error, noise = errors[-1], np.zeros((2, len(part.lines)))
    noisy = (errors[-1] > agreement) & _is_noise(errors, agreement)
    if noisy.any():
        some = np.array(all_windows[_begin_of_noise(errors, noisy) :])
        mean = np.mean(some, axis=0)
        for k, columns in enumerate((slice(0, m), slice(m, 2 * m))):
            size = np.linalg.norm(mean[:, columns], axis=1)
            noise[k] = np.where(noisy, _find_noise(some[:, :, columns]) / np.where(size > 0.0, size, 1.0), 0.0)
        last = np.where(noisy[:, None], mean, last)
        error = np.where(noisy, np.sum(noise, axis=0), error)
    found.held &= run.held
    where = slice(i, i + 1) if found.v.shape[2] > len(part.lines) else slice(None)
    d = last[:, m + j] - last[:, j]  # u − v at the entry where it was added
    scaled = (last / d[:, None]).T
    found.v[:, j, where], found.u[:, j, where], found.y[:, j, where] = scaled[:m], scaled[m : 2 * m], scaled[2 * m :]
    found.uncertainty[where] = np.maximum(found.uncertainty[where], error)
    found.distortion[where] = np.maximum(found.distortion[where], rest)
    found.windows[where] = np.maximum(found.windows[where], count)
    found.settled[where] &= (errors[-1] <= agreement) | (noisy & (error <= SWAMPED))
    found.noise[:, where] = np.maximum(found.noise[:, where], noise)
