"""Noise that is the same in every run, whatever the solver: a function of the time and a seed."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np

from ..core import Array, Output, Source, next_edge, parameter, period_of

_HALF = 2.0**24  # counters are mixed in two halves, since products of two such numbers are exact
_ROUNDS = 10


class BandLimitedNoise(Source):
    """Normal noise, white up to its band: a new independent value every ``sample_time`` T, held in between.

    y(t) = mean + √variance n(k), k = ⌊t/T⌋, n(k) standard normal. Its two-sided spectral density is
    variance · T sinc²(f T): flat, in its unit squared per Hz, to 4 % up to f = 0.1/T. ``from_density`` takes that
    density instead of the variance. n(k) is a function of k and ``seed`` alone (a counter is mixed by a Feistel network
    in exact arithmetic, then Box and Muller's transform): the same in every run, from any t on, in any solver, however
    often and in whatever order it is evaluated. It repeats after 2⁴⁸ values; |n| is at most 5.9.
    """

    sample_time: float = parameter(unit="s", above=0.0, description="time between two values, T")
    variance: float = parameter(default=1.0, minimum=0.0, description="variance, in the unit squared")
    mean: float = parameter(default=0.0, description="mean value")
    seed: int = parameter(default=0, minimum=0, description="another seed gives another, independent noise")
    y = Output()
    computed_from = frozenset({"seed"})

    @classmethod
    def from_density(cls, *, density: float, sample_time: float, **parameters: Any) -> Self:
        """Return noise of a given two-sided spectral density at low frequency, in its unit squared per Hz."""
        return cls(variance=density / sample_time, sample_time=sample_time, **parameters)

    def next_instant(self, t: float) -> float:
        """Return the time of the next value."""
        return next_edge(t, self.sample_time, 0.0)

    def constants(self, T: float, method: str) -> dict[str, np.ndarray]:
        """Return the keys of the rounds: numbers of a run, so that another seed changes no code."""
        return {"keys": np.array(_keys(self.seed))}

    @cached_property
    def keys(self) -> np.ndarray:
        """The keys of the rounds, of 24 bits each."""
        return np.array(_keys(self.seed))

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value that is held at t."""
        number, _, _ = period_of(t, self.sample_time, 0.0)
        low, high = number, np.floor(number / _HALF)
        low = low - _HALF * high
        high = high - _HALF * np.floor(high / _HALF)
        for k in range(_ROUNDS):
            v = low + self.keys[k]
            v = v - _HALF * np.floor(v / _HALF)
            v = high + np.floor(v * (2.0 * v + 1.0) / 4096.0)  # the middle bits of a product depend on all of v
            high, low = low, v - _HALF * np.floor(v / _HALF)
        radius = np.sqrt(-2.0 * np.log((high + 0.5) / _HALF))
        return self.mean + np.sqrt(self.variance) * radius * np.cos(2.0 * np.pi * (low + 0.5) / _HALF)


@lru_cache(maxsize=256)
def _keys(seed: int) -> tuple[float, ...]:
    """Return the keys of the rounds, of 24 bits each."""
    return tuple(float(key >> 8) for key in np.random.SeedSequence(seed).generate_state(_ROUNDS))
