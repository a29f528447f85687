"""Poles of the closed loops of a diagram, and those that are only memory."""

from __future__ import annotations

import numpy as np

from ..document import Section, Table, Texts
from ..frequency import Number
from .case import Case
from .variant import Variant, in_s

TEXTS = Texts(__package__, "poles")
POLES_TITLE = "Poles asked and got"
ON_THE_LIMIT = 1e-9
"""A pole no farther than that from the imaginary axis, relative to the fastest pole, is called neither way."""


def closed_loops(case: Case) -> Section:
    """Return the table of each variant's slowest and fastest poles, all loops closed."""
    numbers: dict[str, Number] = {}
    rows = []
    for v in case.usable():
        s = in_s(v.model.poles, v.model.dt)
        if s.size:
            slowest, fastest = float(np.max(s.real)), float(np.min(s.real))
            error = scatter(v)
            margin = max(error, ON_THE_LIMIT * float(np.max(np.abs(s))))
            stable = "yes" if slowest < -margin else "no" if slowest > margin else "on the limit"
            number = Number(slowest, "1/s", error, "eigenvalues; tolerance by perturbing the matrix")
            numbers[f"{v.key}.slowest"] = number
            rows.append((v.title, len(s), stable, number, f"{fastest:.6g} 1/s"))
    columns = ("variant", "poles", "stable", "largest Re s", "smallest Re s")
    table = Table("Closed loop", columns, tuple(rows), TEXTS.line("closed_loop", limit=ON_THE_LIMIT))
    return Section("poles", POLES_TITLE, (), (table,), (), numbers)


def memory(case: Case) -> Section | None:
    """Return the text on states that are only a warm start, None where there are none."""
    states = sorted({name for v in case.usable() for name in v.model.memory})
    return Section("poles", POLES_TITLE, TEXTS.paragraphs("memory", states=states)) if states else None


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
