"""Test signals: their lines, the windows of a measurement, and the phasors of a window."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from .injection import Waveform

KINDS = ("sine", "multisine", "chirp")
SAMPLES = 256
"""Smallest number of samples in a window."""


def choose_step(omega: np.ndarray) -> Fraction:
    """Return the seconds between samples of a continuous diagram: 16 to a period of the highest frequency, whole ns."""
    return Fraction(max(1, round(2.0 * np.pi / (16.0 * omega[-1]) * 1e9)), 10**9)


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the test signal and its window."""

    waveform: Waveform
    samples: int  # samples of the window
    lines: np.ndarray  # lines to read: whole periods in the window
    omega: np.ndarray  # their frequencies in rad/s
    every_line: bool  # whether the signal has all lines, as a chirp has

    @property
    def silence(self) -> Waveform:
        """Waveform of this part with amplitude zero."""
        return replace(self.waveform, amplitude=0.0 * self.waveform.amplitude)


def plan_signal(kind: str, omega: np.ndarray, dt: float, amplitude: float) -> Iterator[Part]:
    """Yield the parts of a test signal, to be played one after the other."""
    zero = np.zeros(1)
    if kind == "sine":
        for w in omega:
            periods = max(1, math.ceil(SAMPLES * dt * w / (2.0 * np.pi)))
            n = round(2.0 * np.pi * periods / (w * dt))
            fits = np.array([2.0 * np.pi * periods / (n * dt)])
            yield Part(Waveform(zero + amplitude, fits, zero, zero, n * dt), n, np.array([periods]), fits, False)
        return
    gap = float(np.min(np.diff(omega), initial=omega[0]))
    parts = min(64, math.ceil(2.0 * omega[0] / gap))
    n = max(SAMPLES, round(2.0 * np.pi * parts / (omega[0] * dt)))
    unit = 2.0 * np.pi / (n * dt)
    lines = np.unique(np.clip(np.round(omega / unit).astype(int), 1, (n - 1) // 2))
    if kind == "multisine":
        phase = -np.pi * np.arange(len(lines)) * (np.arange(len(lines)) + 1.0) / len(lines)  # Schroeder's
        tau = np.arange(n) * dt
        peak = float(np.max(np.abs(np.sum(np.sin(np.outer(lines * unit, tau) + phase[:, None]), axis=0))))
        each = np.full(len(lines), amplitude / peak)
        waveform = Waveform(each, lines * unit, np.zeros(len(lines)), phase, n * dt)
    else:
        first, last = max(1, int(0.8 * lines[0])), min((n - 1) // 2, math.ceil(1.2 * lines[-1]))
        last -= (last - first) % 2  # whole turns in a period, so that it repeats without a jump
        waveform = Waveform(
            zero + amplitude, zero + first * unit, zero + (last - first) * unit / (n * dt), zero, n * dt
        )
    yield Part(waveform, n, lines, lines * unit, kind == "chirp")


def compute_phasors(part: Part, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the phasors, by line and signal, and the distortion of the first signal.

    The distortion is the rms of the rest next to the lines, relative to that of each line; NaN for a part with every
    line. Over a window of whole periods the lines are orthogonal to all others. The difference of the window's end from
    its beginning is a drift, and is subtracted.
    """
    n = part.samples
    k = np.arange(n)
    data = data[:n] - np.outer(k / n, data[n] - data[0])
    data = data - np.mean(data, axis=0)
    turns = np.exp(-2j * np.pi / n * (np.outer(part.lines, k) % n))
    phasors = 2.0 / n * turns @ data
    lines = len(part.lines)
    if part.every_line:
        return phasors, np.full(lines, np.nan)
    rest = np.sqrt(np.mean((data[:, 0] - np.real(phasors[:, 0] @ turns.conj())) ** 2))
    size = np.abs(phasors[:, 0]) / np.sqrt(2.0)
    return phasors, rest / np.where(size > 0.0, size, np.inf)
