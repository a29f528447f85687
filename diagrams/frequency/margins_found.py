"""Margins of a loop as values: the numbers, the crossings, and the poles."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ...blocks.core import Finding, brief, explain_calls
from .number import MARK, Number

NEAR = 1e-12
"""Distance from the limit of stability, relative to the largest pole, within which an unstable loop's pole is named."""


@explain_calls
@dataclass(frozen=True)
class GainCrossover:
    """A frequency at which |L| = 1, and the rotation that takes L to −1 there (−180° to 180°)."""

    frequency: Number
    phase_margin_deg: Number


@explain_calls
@dataclass(frozen=True)
class PhaseCrossover:
    """A frequency at which L is real and negative, and the factor that takes it to −1 there."""

    frequency: Number
    gain_margin: Number


@explain_calls
@dataclass(frozen=True)
class Margins:
    """Margins of a loop L with S = 1/(1 + L) and T = L/(1 + L).

    The margins of an unstable closed loop are NaN; its crossings and poles are there.

    Parameters
    ----------
    stable : bool
        Whether all of `closed_loop_poles` are stable. Hidden modes are not among them: see `hidden_unstable`.
    gain_crossovers, phase_crossovers : tuple
        All crossovers by rising frequency; phase crossovers also at 0, at π/T and at infinity.
    gain_margin_low, gain_margin_high : Number
        Largest factor below 1, and smallest above 1, on L that ends stability; 0 and infinity where there is none.
    phase_margin_deg : Number
        Smallest rotation of L, to either side, that ends stability; infinite where |L| = 1 nowhere.
    delay_margin_s, delay_margin_samples : Number
        Smallest delay τ in series, e^(−jωτ), that ends stability. In a sampled loop it is read from the response
        between the samples. Where |L| > 1 at π/T that has no meaning: the whole samples that the loop bears are given.
        `delayed_hold_margin` gives another number, the delay in front of the plant's hold.
    modulus_margin : Number
        Smallest distance of L to −1, 1/M_s.
    disk_margin : Number
        α of the symmetric disk (S − T), or of that with the given skew; see `disk_margin`.
    ms, ms_frequency, mt, mt_frequency : Number
        Largest |S| and |T|, and their frequencies.
    bandwidth : Number
        Lowest frequency at which |T| falls below 1/√2 (3.0103 dB) of its value at low frequency.
    closed_loop_poles : tuple of complex
        In the s plane (continuous) or the z plane (sampled). Multiple poles scatter, as ε^(1/multiplicity).
    hidden_poles : tuple of complex
        Poles that are not controllable or not observable in the loop; none of the numbers above contains them.
    hidden_unstable : tuple of complex
        Hidden poles beyond the limit of stability. No gain in this loop stabilizes them: another loop must.
    encirclements : int
        Clockwise encirclements of −1 by L.
    dt : float
        Sample time of the loop in s, 0 of a continuous one.
    findings : tuple of Finding
        Effects on the loop that its linear model leaves out, such as a kink at the operating point. Every number
        carries them.
    """

    stable: bool
    gain_crossovers: tuple[GainCrossover, ...]
    phase_crossovers: tuple[PhaseCrossover, ...]
    gain_margin_low: Number
    gain_margin_high: Number
    phase_margin_deg: Number
    delay_margin_s: Number
    delay_margin_samples: Number
    modulus_margin: Number
    disk_margin: Number
    ms: Number
    ms_frequency: Number
    mt: Number
    mt_frequency: Number
    bandwidth: Number
    closed_loop_poles: tuple[complex, ...]
    hidden_poles: tuple[complex, ...]
    hidden_unstable: tuple[complex, ...]
    encirclements: int
    dt: float = 0.0
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        names = ("gain_margin_high", "phase_margin_deg", "disk_margin", "ms")
        told = [f"{name} {number}" for name, number in self.numbers().items() if name in names] if self.stable else []
        poles = ", ".join(f"{p:.4g}" for p in self.unstable_poles[:3])
        facts = "stable" if self.stable else f"the closed loop is unstable, poles {poles}", *told
        return brief("margins", *facts, then="print(…) shows all")

    def numbers(self) -> dict[str, Number]:
        """Return the single numbers by name, in the order of the report."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in found.items() if isinstance(value, Number)}

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """Return the single numbers by name, as in a report's JSON."""
        return {name: number.as_dict() for name, number in self.numbers().items()}

    @property
    def unstable_poles(self) -> tuple[complex, ...]:
        """The closed-loop poles that are not stable, in the plane of `closed_loop_poles`; empty for a stable loop."""
        if self.stable:
            return ()
        poles = np.array(self.closed_loop_poles)
        growth = np.abs(poles) - 1.0 if self.dt else poles.real
        limit = min(0.0, float(growth.max(initial=0.0))) - NEAR * float(np.abs(poles).max(initial=0.0))
        return tuple(complex(p) for p, g in zip(poles, growth, strict=True) if g >= limit)

    def __str__(self) -> str:
        if self.stable:
            lines = [f"{name:22s}{number}" for name, number in self.numbers().items()]
        else:
            plane, limit = ("z", "|z| < 1") if self.dt else ("s", "Re s < 0")
            poles = ", ".join(f"{p:.6g}" for p in self.unstable_poles)
            lines = [
                "unstable: the closed loop has no margins",
                f"unstable_poles        {plane} = {poles} (stable: {limit})",
            ]
            lines += [f"gain_crossover        {c.frequency}" for c in self.gain_crossovers]
            lines += [f"phase_crossover       {c.frequency}, factor {c.gain_margin}" for c in self.phase_crossovers]
        if self.hidden_unstable:
            lines.append(
                f"hidden_unstable       {', '.join(f'{p:.6g}' for p in self.hidden_unstable)}: not in this loop"
            )
        return "\n".join([*lines, *(f"{MARK} {finding}" for finding in self.findings)])
