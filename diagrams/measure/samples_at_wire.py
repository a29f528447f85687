"""Samples of a measurement at a wire of a running diagram."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

from ..flat import FlatDiagram
from ..linearization import Tap, ticks_between_renewals, ticks_to_renewal


@dataclass(frozen=True)
class SamplesAtWire:
    """Samples, from one to the next of which a test signal is held where anything is sampled."""

    every: int  # ticks in a sample
    period: Fraction  # s
    wait: int = 0  # ticks until the wire is renewed
    renewals: int = 1  # samples in the period of all clocks
    held: tuple[Fraction, Fraction] | None = None  # period of the test signal and its first time, where it is held

    @classmethod
    def of(cls, flat: FlatDiagram, signal: Tap, tick: int, *, each_renewal: bool = False) -> SamplesAtWire:
        """Return the samples at a wire of a sampled diagram from a tick on: one in the period of all clocks.

        They begin where the wire is renewed, as for its loop's linear model. With ``each_renewal`` they are from one
        renewal to the next, where these are even.
        """
        every = math.lcm(*(clock.every for clock in flat.distinct)) if flat.distinct else 1
        own = ticks_between_renewals(flat, [signal.port]) if each_renewal and every > 1 else None
        renewals = every // own if own and every % own == 0 else 1
        every //= renewals
        wait = ticks_to_renewal(flat, [signal.port], tick) if every > 1 else 0
        period = flat.base * every
        return cls(every, period, wait, renewals, (period, ((tick + wait) % every) * flat.base))

    @property
    def is_renewed_once(self) -> bool:
        """Whether the wire is renewed at the beginning of the period of all clocks, and then alone."""
        return not self.wait and self.renewals == 1
