"""Stability of a variant's linear model with all loops closed, and the poles that end it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from enum import StrEnum

import numpy as np

from ...blocks.core import LoopwrightError
from ..linearization import FreeMotion
from .pages import Texts
from .variant import Variant, in_s

TEXTS = Texts(__package__, "stability")

ON_THE_LIMIT = 1e-9
"""A pole no farther than that from the imaginary axis, relative to the fastest pole, is called neither way."""


class Stability(StrEnum):
    """Answer to the question whether a diagram is stable; its value is in tables."""

    STABLE = "yes"
    UNSTABLE = "no"
    ON_THE_LIMIT = "on the limit"

    @classmethod
    def of(cls, v: Variant) -> Stability:
        """Return the stability of a variant's linear model, memory and free motions aside."""
        delays = v.model.delays
        if delays is not None and (count := v.model.characteristic_without(v.free).count_unstable()) == 0:
            return cls.STABLE  # by the argument: infinitely many poles are not looked at one by one
        if delays is not None and math.isinf(count):
            return cls.UNSTABLE
        slowest, margin = float(np.max(poles_in_s(v).real, initial=-np.inf)), stability_margin(v)
        return cls.STABLE if slowest < -margin else cls.UNSTABLE if slowest > margin else cls.ON_THE_LIMIT


def why_unstable(v: Variant) -> str:
    """Return why a variant is unstable where its poles alone don't say it; empty where they do."""
    blocks = v.model.neutral_blocks
    if not blocks:
        return ""
    gain = v.model.characteristic.gain_at_infinity
    return TEXTS.line("neutral", gain=gain, blocks=blocks)


def free_motions(variants: Iterable[Variant]) -> tuple[FreeMotion, ...]:
    """Return the free motions of some variants, each state once."""
    found: dict[str, FreeMotion] = {}
    for v in variants:
        try:
            motions = () if v.problem else v.free.motions
        except LoopwrightError:  # its model can't be made, which its rows say
            continue
        for motion in motions:
            found.setdefault(motion.state, motion)
    return tuple(found.values())


def without_memory(v: Variant) -> np.ndarray:
    """Return the matrix A of a variant's linear model without the states that are only a warm start."""
    keep = [i for i, name in enumerate(v.model.states) if name not in v.model.memory]
    return np.asarray(v.model.A[np.ix_(keep, keep)])


def scatter(v: Variant) -> float:
    """Return how far the slowest pole in 1/s moves when the model's matrix is rounded, tenfold."""
    if v.model.delays is not None:
        return 1e-10 * (1.0 + abs(float(np.max(v.poles.real, initial=0.0))))
    A = v.free.reduce(v.model.A) if v.free else without_memory(v)
    if not len(A):
        return 0.0
    rng = np.random.default_rng(0)
    moved = np.linalg.eigvals(A * (1 + 1e-15 * rng.standard_normal(A.shape)))
    before = np.linalg.eigvals(A)
    if not v.model.dt:
        return 10 * abs(float(np.max(moved.real) - np.max(before.real))) + 1e-12
    ends = [float(np.log(np.max(np.abs(values)))) / v.model.dt for values in (before, moved)]
    return 10 * abs(ends[1] - ends[0]) + 1e-12


def poles_in_s(v: Variant) -> np.ndarray:
    """Return the poles of a variant's linear model in 1/s, memory and free motions aside."""
    return in_s(v.poles, v.model.dt)


def stability_margin(v: Variant) -> float:
    """Return the distance from the axis, in 1/s, up to which a pole is called neither way."""
    return (
        max(scatter(v), ON_THE_LIMIT * float(np.max(np.abs(poles_in_s(v)), initial=0.0))) if poles_in_s(v).size else 0.0
    )
