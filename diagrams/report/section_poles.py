"""Poles of the closed loops of a diagram, and those that are only memory."""

from __future__ import annotations

import numpy as np

from ..frequency import Number, with_findings
from ..report_writing import Section, Table, Texts
from .case import Case
from .stability import ON_THE_LIMIT, Stability, scatter
from .variant import in_s

TEXTS = Texts(__package__, "poles")
POLES_TITLE = "Closed-loop poles"


def closed_loops(case: Case) -> Section:
    """Return the table of each variant's slowest and fastest poles, all loops closed."""
    numbers: dict[str, Number] = {}
    rows = []
    for v in case.usable():
        s = in_s(v.model.poles, v.model.dt)
        if s.size:
            slowest, fastest = float(np.max(s.real)), float(np.min(s.real))
            number = Number(slowest, "1/s", scatter(v), "eigenvalues; tolerance by perturbing the matrix")
            number = with_findings(number, v.model.findings_on_loops)
            numbers[f"{v.key}.slowest"] = number
            rows.append((v.title, len(s), Stability.of(v), number, fastest))
    columns = ("variant", "poles", "stable", "largest Re s", "smallest Re s [1/s]")
    table = Table("Closed loop", columns, tuple(rows), TEXTS.line("closed_loop", limit=ON_THE_LIMIT))
    return Section("poles", POLES_TITLE, (), (table,), (), numbers)


def memory(case: Case) -> Section | None:
    """Return the text on states that are only a warm start, None where there are none."""
    states = sorted({name for v in case.usable() for name in v.model.memory})
    return Section("poles", POLES_TITLE, TEXTS.paragraphs("memory", states=states)) if states else None
