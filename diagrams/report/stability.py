"""Stability of a variant's linear model with all loops closed, and the poles that end it."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from ..frequency import order_key
from ..report_writing import Section, Texts
from .case import Case
from .section_subject import SUBJECT_TITLE
from .variant import Variant, in_s

TEXTS = Texts(__package__, "poles")
ON_THE_LIMIT = 1e-9
"""A pole no farther than that from the imaginary axis, relative to the fastest pole, is called neither way."""


class Stability(StrEnum):
    """Answer to the question whether a diagram is stable; its value stands in tables."""

    STABLE = "yes"
    UNSTABLE = "no"
    ON_THE_LIMIT = "on the limit"

    @classmethod
    def of(cls, v: Variant) -> Stability:
        """Return the stability of a variant's linear model, memory aside."""
        slowest, margin = float(np.max(_poles(v).real, initial=-np.inf)), _margin(v)
        return cls.STABLE if slowest < -margin else cls.UNSTABLE if slowest > margin else cls.ON_THE_LIMIT


def unstable_first(case: Case) -> Section | None:
    """Return the text that names unstable variants and their poles, None where there are none.

    It is the beginning of a report: margins and other numbers of an unstable diagram mean nothing.
    """
    text = []
    for v in case.usable():
        if Stability.of(v) is Stability.UNSTABLE:
            poles = _poles(v)
            text.append(TEXTS.line("unstable", variant=v.title, poles=show_poles(poles[poles.real > _margin(v)], v)))
    return Section("subject", SUBJECT_TITLE, tuple(text)) if text else None


def show_poles(poles: np.ndarray, v: Variant) -> str:
    """Return poles in 1/s as text, the fastest growing first, a pair as one; those of a sampled model with |z|."""
    shown = []
    for s in sorted(poles, key=lambda s: (-order_key(s.real), order_key(abs(s.imag)))):
        if s.imag < -ON_THE_LIMIT * abs(s):
            continue  # the conjugate is named
        one = abs(s.imag) <= ON_THE_LIMIT * abs(s)
        text = f"{s.real:.6g}" if one else f"{s.real:.6g} ± {s.imag:.6g}j"
        dt = v.model.dt
        shown.append(text + (f" (|z| = {np.exp(s.real * dt):.6g})" if dt else ""))
    return ", ".join(shown)


def without_memory(v: Variant) -> np.ndarray:
    """Return the matrix A of a variant's linear model without the states that are only a warm start."""
    keep = [i for i, name in enumerate(v.model.states) if name not in v.model.memory]
    return np.asarray(v.model.A[np.ix_(keep, keep)])


def scatter(v: Variant) -> float:
    """Return how far the slowest pole in 1/s moves when the model's matrix is rounded, tenfold."""
    A = without_memory(v)
    rng = np.random.default_rng(0)
    moved = np.linalg.eigvals(A * (1 + 1e-15 * rng.standard_normal(A.shape)))
    before = np.linalg.eigvals(A)
    if not v.model.dt:
        return 10 * abs(float(np.max(moved.real) - np.max(before.real))) + 1e-12
    ends = [float(np.log(np.max(np.abs(values)))) / v.model.dt for values in (before, moved)]
    return 10 * abs(ends[1] - ends[0]) + 1e-12


def _poles(v: Variant) -> np.ndarray:
    return in_s(v.model.poles, v.model.dt)


def _margin(v: Variant) -> float:
    """Return the distance from the axis, in 1/s, up to which a pole is called neither way."""
    return max(scatter(v), ON_THE_LIMIT * float(np.max(np.abs(_poles(v)), initial=0.0))) if _poles(v).size else 0.0
