"""Results of an analysis of margins, and the skeleton that all analyses of a closed loop share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from ...blocks.core import Finding, Grid, Sheet, ShownAsTable, brief, decibels, explain_calls, missing_member
from .loop_model import LoopModel
from .number import MARK, NOT_IN_DATA, Interval, Number
from .scan_refine_confirm import Candidate

EIGENVALUES = "closed-loop eigenvalues"
NEAR = 1e-12
"""Distance from the limit of stability, relative to the largest pole, within which an unstable loop's pole is named."""
MARGIN_UNITS = {
    "phase_margin_deg": "deg",
    "delay_margin_s": "s",
    "delay_margin_samples": "samples",
    "ms_frequency": "rad/s",
    "mt_frequency": "rad/s",
    "bandwidth": "rad/s",
    "disk_frequency": "rad/s",
}
"""Units of the numbers that are no pure ones."""
FACTORS = ("gain_margin_low", "gain_margin_high")
"""Numbers that are factors on the gain, which are shown in dB, too."""
ROTATIONS = (30.0, 60.0, 90.0, 120.0, 150.0, 180.0)
"""Rotations in degrees that are tried where no limit was found."""


WAYS = {
    **dict.fromkeys(
        ("gain_margin", "gain_margin_db", "gm"),
        "margins.gain_margin_high, the smallest factor above 1 that ends stability, or margins.gain_margin_low, the "
        "largest below 1; print(margins) has both in dB",
    ),
    **dict.fromkeys(("phase_margin", "pm"), "margins.phase_margin_deg"),
    **dict.fromkeys(("delay_margin",), "margins.delay_margin_s or margins.delay_margin_samples"),
    **dict.fromkeys(
        ("wc", "wcp", "wpc", "gain_crossover", "crossover", "crossover_frequency", "gain_crossover_frequency"),
        "margins.gain_crossovers[0].frequency",
    ),
    **dict.fromkeys(
        ("w180", "wcg", "wgc", "phase_crossover", "phase_crossover_frequency"), "margins.phase_crossovers[0].frequency"
    ),
    "sm": "margins.modulus_margin",
    "poles": "margins.closed_loop_poles",
}
"""What to write for names that users of other tools look for in margins."""


@explain_calls
class MarginTable(ShownAsTable):
    """Margins by name. The results for a linear, a periodic and a measured loop are such tables."""

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            raise missing_member(self, name, "a table of margins", WAYS)

    def numbers(self) -> dict[str, Any]:
        """Return the single numbers by name, in the order of the report."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in found.items() if isinstance(value, Number | Interval)}

    def _grid(self) -> Grid:
        """Return its numbers as a table; factors of the gain in dB, too."""
        rows: list[tuple[Any, ...]] = []
        for name, number in self.numbers().items():
            unit = decibels(float(number)) if name in FACTORS else number.unit
            mark = f" {MARK}" if getattr(number, "findings", ()) else ""
            value, interval = float(number), ""
            if isinstance(number, Interval):
                interval = f"{number.low:.4g} to {number.high:.4g}"
            if isinstance(number, Interval) and math.isnan(value):
                rows.append((name, None, "", NOT_IN_DATA))
            else:
                rows.append((name, value, ("" if unit == "1" else unit) + mark, interval))
        return Grid("", ("number", "value", "unit", "interval"), tuple(rows))


@explain_calls
class StabilityMargins(MarginTable):
    """Margins of a closed loop that may be unstable: then its numbers are NaN, and its poles say why."""

    stable: bool
    closed_loop_poles: tuple[complex, ...]
    dt: float
    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        if self.stable:
            names = ("gain_margin_high", "phase_margin_deg", "disk_margin", "ms")
            facts = "stable", *(f"{name} {number}" for name, number in self.numbers().items() if name in names)
        else:
            poles = ", ".join(f"{p:.4g}" for p in self.unstable_poles[:3])
            facts = (f"the closed loop is unstable, poles {poles}",)
        return brief(self._title(), *facts, then="print(…) shows all")

    def _sheet(self) -> Sheet:
        said = tuple(f"{MARK if finding.limits_numbers else '–'} {finding}" for finding in self.findings)
        if self.stable:
            return Sheet(self._title(), tuple(self._further_facts()), (self._grid(),), said)
        plane, limit = ("z", "|z| < 1") if self.dt else ("s", "Re s < 0")
        poles = ", ".join(f"{p:.6g}" for p in self.unstable_poles)
        unstable = "unstable_poles", f"{plane} = {poles} (stable: {limit})"
        head = f"{self._title()}: none, as the closed loop is unstable"
        return Sheet(head, (unstable, *self._further_facts()), (), said)

    def _title(self) -> str:
        return "margins"

    def _further_facts(self) -> list[tuple[str, str]]:
        """Return further facts of the loop, next to its numbers."""
        return []

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
        limit = min(0.0, float(growth.max(initial=-np.inf))) - NEAR * float(np.abs(poles).max(initial=0.0))
        return tuple(complex(p) for p, g in zip(poles, growth, strict=True) if g >= limit)


Found = TypeVar("Found", bound=StabilityMargins)


class MarginFinder(ABC, Generic[Found]):
    """An analysis of a closed loop. A subclass scans and refines; the numbers are confirmed here."""

    result: type[Any]
    """Class of the result, `Found`."""
    eigenvalues: str = EIGENVALUES
    """Computation that says whether a closed loop is stable."""
    rotated: ClassVar[str] = " with L rotated"

    def __init__(self, r: LoopModel):
        self.r: Any = r
        self.unstable: float = r.count_unstable()

    @abstractmethod
    def find_candidates(self) -> dict[str, Candidate]:
        """Return the numbers of a stable loop by name, scanned and refined."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return the further fields of the result, which an unstable loop has as well."""

    def find_margins(self) -> Found:
        """Return the margins, confirmed; those of an unstable loop are NaN."""
        r = self.r
        poles = r.eigenvalues()
        if self.unstable:
            largest = f" (largest growth {r.growth(poles).max():.3g})" if len(poles) else ""
            count = f"{self.unstable:g}" if np.isfinite(self.unstable) else "infinitely many"
            reason = f"the closed loop is not stable: {count} of its poles are not{largest}"
            names = [f.name for f in fields(self.result) if f.type == "Number"]
            found = {name: Number(np.nan, MARGIN_UNITS.get(name, "1"), np.nan, reason) for name in names}
        else:
            found = {name: candidate.confirmed() for name, candidate in self.find_candidates().items()}
        made: Found = self.result(
            stable=not self.unstable,
            closed_loop_poles=tuple(complex(p) for p in np.sort_complex(poles + 1 if r.dt else poles)),
            dt=r.dt,
            findings=(),
            **found,
            **self.describe(),
        )
        return made

    def limit_gain(
        self, name: str, factor: float, tolerance: float, *, others: Sequence[float] = (), tried: Sequence[float]
    ) -> Candidate:
        """Return a gain margin; 0 or infinite where no factor ends stability."""
        options: dict[str, Any] = {"nominal": 1.0, "others": others, "tried": tried, "is_gain": True}
        return Candidate.of_limit(name, factor, "1", tolerance, self.r.is_stable, self.eigenvalues, **options)

    def limit_rotation(self, degrees: float, tolerance: float, *, others: Sequence[float] = ()) -> Candidate:
        """Return the phase margin; infinite where no rotation ends stability."""

        def stable(degrees: float) -> bool:
            return bool(self.r.is_stable(np.exp(-1j * np.radians(degrees))))

        how = self.eigenvalues + (self.rotated if np.isfinite(degrees) else "")
        others = [*others, *(360 - o for o in (degrees, *others))]  # the same limits, reached by the other direction
        name = "phase_margin_deg"
        return Candidate.of_limit(name, degrees, "deg", tolerance, stable, how, others=others, tried=ROTATIONS)
