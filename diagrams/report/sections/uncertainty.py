"""Effect of the uncertainty of an FMU's linear model on a loop's numbers, and reasons for a loop to have none."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError
from ....fmus.running import DerivativeMethod
from ...frequency import Confirmation, Number, margins
from ...linearization import StepsOnly, linearize
from ..case import Case
from ..pages import Section, Table, Texts
from ..variant import Cut, Variant

PEAKS = ("ms", "mt")
"""The numbers that say how much an error of L is amplified."""
LINEAR = 1e-3
"""A difference between an FMU's step and its equations beyond which it is not the solver's: it moves as it steps."""
NOTHING = 1e-12
"""Size of a loop that is zero but for rounding."""
TEXTS = Texts(__package__, "loops")


def left_out(case: Case, wire: str, on_cycles: Collection[str]) -> list[str]:
    """Return why there are no margins at a wire."""
    said: dict[str, None] = {}
    for v in case.usable():
        try:
            L = v.loop(wire)
            if _is_zero(L):
                said |= dict.fromkeys([_zero(v, wire, on_cycles)])
            else:
                margins(L)
        except LoopwrightError as error:
            said |= dict.fromkeys([f"{wire}, {v.title}: {error.message}"])
    return list(said)


def _is_zero(L: Any) -> bool:
    points = np.exp(1j * np.geomspace(1e-3, 3.0, 9)) if L.dt else 1j * np.geomspace(1e-3, 1e3, 9)
    return all(bool(np.max(np.abs(_response(L, p)), initial=0.0) <= NOTHING) for p in points)


def _zero(v: Variant, wire: str, on_cycles: Collection[str]) -> str:
    names = v.diagram.names
    block = names[wire].block if wire in names else wire.rpartition(".")[0]
    if block not in on_cycles:
        return TEXTS.line("off_loops", wire=wire)
    steps = [str(finding) for finding in v.model.findings if isinstance(finding, StepsOnly)]
    return TEXTS.line("slope_is_zero", wire=wire, steps=steps)


@dataclass(frozen=True)
class LoopPart:
    """The section of a loop.

    Attributes
    ----------
    section : Section
        The section.
    numbers : mapping of (Variant, Cut) to mapping of str to Number
        Those of its numbers that come from each variant's loop, by path behind the key of `cut_key`.
    """

    section: Section
    numbers: Mapping[tuple[Variant, Cut], Mapping[str, Number]]


def cut_key(v: Variant, cut: Cut) -> str:
    """Return the part of dotted paths of a variant's loop, such as ``sampled_d0`` or ``sampled_d0.periodic``."""
    return f"{v.key}.{cut}" if cut else v.key


def widened(wire: str, part: LoopPart) -> Section:
    """Return the section of a loop with tolerances that know how far the linear models of its FMUs are right.

    The error of a response is found at the frequencies of the section: by moving the model's entries by the
    differences' own uncertainty, and by the equations held over a step in place of the step that the FMU's solver
    makes, where it tells them.
    """
    changed: dict[int, Number] = {}
    numbers, text = dict(part.section.numbers), list(part.section.text)
    for (v, cut), own in part.numbers.items():
        exact = all(derivation.is_exact for derivation in v.model.derivations.values())
        if exact and not v.model.uncertainty:
            continue
        w = [n.value for n in own.values() if n.unit == "rad/s" and 0 < n.value < math.inf]
        if not w:
            continue
        error, said = _relative_error(v, wire, cut, np.unique(w))
        text += [f"{v.title}: {said}"] if said else []
        peaks = [own[name].value for name in PEAKS if name in own and math.isfinite(own[name].value)]
        slopes = 1.0 + 2.0 * max([1.0, *peaks])
        for name, n in own.items():
            more = _floor(n, error * slopes)
            if more > n.tolerance:
                why = Confirmation(n.confirmed_by).and_by(
                    f"tolerance: its FMUs' linear models are right to {error:.1e} of L",
                    "tolerance: from the error of its FMUs' linear models",
                )
                new = replace(n, tolerance=more, confirmed_by=why)
                changed[id(n)] = numbers[f"{cut_key(v, cut)}.{name}"] = new
    tables = tuple(_renewed(table, changed) for table in part.section.tables)
    return replace(part.section, numbers=numbers, tables=tables, text=tuple(text))


def _floor(n: Number, error: float) -> float:
    """Return the error of a number that a relative error of L makes."""
    if not math.isfinite(n.value) or n.value == 0.0:
        return 0.0
    if n.unit == "deg":
        return math.degrees(error)
    whole = n.unit == "1" and n.tolerance == 0.0  # counted
    return 0.0 if whole else error * abs(n.value)


def _relative_error(v: Variant, wire: str, cut: Cut, w: np.ndarray) -> tuple[float, str]:
    """Return the largest relative error of L at frequencies, and the notes on it."""
    L = v.loop(wire, cut=cut)
    points = np.exp(1j * w * L.dt) if L.dt else 1j * w
    nominal = [_response(L, p) for p in points]
    sizes = [np.linalg.norm(n) or 1.0 for n in nominal]

    def off(other: Any) -> float:
        moved = [_response(other, p) for p in points]
        return float(np.nanmax([np.linalg.norm(m - n) / s for m, n, s in zip(moved, nominal, sizes, strict=True)]))

    rng = np.random.default_rng(0)
    largest = max([1e-300, *(float(np.max(np.abs(M), initial=0.0)) for M in (L.A, L.B, L.C, L.D))])
    relative = 0.0 if math.isnan(v.model.uncertainty) else v.model.uncertainty / largest  # tolerances are NaN already
    error = 0.0
    for _ in range(4):
        error = max(error, off(_Moved(*(M * (1 + relative * rng.choice([-1, 1], M.shape)) for M in _matrices(L)))))
    if not any(d.method is DerivativeMethod.STEP_DIFFERENCES for d in v.model.derivations.values()):
        return error, ""
    try:
        held = cut.loop(linearize(v.diagram, v.point, plants="equations", stairs=v.stairs), wire)
    except LoopwrightError:
        return error, TEXTS.line("no_equations")
    solver = off(held)
    if solver > LINEAR:
        return error, TEXTS.line("coarse_step", difference=solver)
    return error + solver, ""


class _Moved:
    """A state-space model, no more than its matrices."""

    def __init__(self, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray):
        self.A, self.B, self.C, self.D = A, B, C, D


def _matrices(L: Any) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(M, dtype=float) for M in (L.A, L.B, L.C, L.D))


def _response(L: Any, p: complex) -> np.ndarray:
    try:
        return np.asarray(L.C @ np.linalg.solve(p * np.eye(len(L.A)) - L.A, L.B.astype(complex)) + L.D)
    except np.linalg.LinAlgError:  # on a pole
        return np.full(np.shape(L.D), np.nan + 0j)


def _renewed(table: Table, changed: dict[int, Number]) -> Table:
    return replace(table, rows=tuple(tuple(changed.get(id(cell), cell) for cell in row) for row in table.rows))
