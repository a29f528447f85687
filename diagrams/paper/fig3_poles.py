"""The poles that the error dynamics of Fig. 3 ask for, and those that they get."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...blocks import ErrorDynamics
from ...blocks.core import LoopwrightError
from ..frequency import Number, Realization, relative_difference, sampled_gains, sampled_poles, with_findings
from ..report import POLES_TITLE, Section, Table, Texts, Variant, in_s, list_poles
from .fig3_case import Fig3Case

TEXTS = Texts(__package__, "poles")
SAME = 1e-6
"""Difference of polynomials beyond which a loop is not the sampled chain of integrators: the closed form is another
plant's, and its poles and gains are no numbers of this diagram."""


def poles_asked(case: Fig3Case) -> Section:
    """Return the tables of poles asked and got, and the gains with which a sampled loop would get them."""
    numbers: dict[str, Number] = {}
    tables: list[Table] = []
    for side, wire in case.loop_wires().items():
        block: Any = case.diagram.blocks[f"controller.pid_{side}"]
        tables += _asked(case, side, wire, block, numbers)
    return Section("poles", POLES_TITLE, TEXTS.paragraphs("asked"), tuple(tables), (), numbers)


def _asked(case: Fig3Case, side: str, wire: str, block: ErrorDynamics, numbers: dict[str, Number]) -> Iterator[Table]:
    """Yield what one error dynamics asks for and gets, and the gains with which a sampled one would get it."""
    asked = np.array([1.0, block.a2, block.a1, block.a0])
    wanted = np.sort_complex(np.roots(asked))
    centre = -float(block.a2) / 3
    numbers[f"{side}.asked.mean"] = Number(centre, "1/s", 1e-15 * abs(centre), "given: −a₂/3", given=True)

    def keep(v: Variant, name: str, number: Number) -> None:
        numbers[f"{side}.{v.key}.{name}"] = with_findings(number, v.findings(wire))

    rows: list[tuple[Any, ...]] = [("asked", list_poles(_cleaned(asked, wanted)), "")]
    gains: list[tuple[Any, ...]] = []
    for v in case.usable():
        try:
            r = Realization.of(v.loop(wire))
        except LoopwrightError:
            continue
        if not r.dt:
            got = np.poly(r.closed_matrix())
            how = "characteristic polynomials of the loop at the virtual input"
            off = _off(got, asked)
            if len(got) != len(asked) and not off <= SAME:  # the plant has dynamics of its own
                rows.append((v.title, list_poles(np.roots(got)), ""))
                continue
            keep(v, "polynomial_difference", Number(off, "1", 1e-9, how))
            if len(got) == len(asked):
                keep(v, "mean", Number(-got[1] / 3, "1/s", 1e-9 * abs(got[1]), "the trace of A"))
            rows.append((v.title, list_poles(np.roots(got)), numbers[f"{side}.{v.key}.polynomial_difference"]))
            continue
        if not v.is_design:
            rows.append((v.title, list_poles(in_s(1 + np.linalg.eigvals(r.closed_matrix()), r.dt), r.dt), ""))
            continue
        design = sampled_poles([block.a0, block.a1, block.a2], r.dt, delay=v.implementation.delay)
        got = np.poly(r.closed_matrix())
        formula = np.array(design.polynomial) * r.dt ** np.arange(len(design.polynomial))
        formula = formula / formula[0]  # in z − 1 in place of (z − 1)/T
        off = _off(got, formula)
        how = "closed form of the sampled chain of integrators against the diagram's own loop"
        if not off <= SAME:
            rows.append((v.title, list_poles(in_s(1 + np.linalg.eigvals(r.closed_matrix()), r.dt), r.dt), ""))
            continue
        keep(v, "polynomial_difference", Number(off, "1", 1e-9, how))
        for i, s in enumerate(design.poles[:3], 1):
            keep(v, f"pole_{i}_real", Number(s.real, "1/s", 1e-6 * abs(s), how))
            keep(v, f"pole_{i}_imag", Number(abs(s.imag), "rad/s", 1e-6 * abs(s), how))
        rows.append((v.title, list_poles(design.poles, r.dt), numbers[f"{side}.{v.key}.polynomial_difference"]))
        try:
            better = sampled_gains(tuple(_cleaned(asked, wanted)), r.dt, delay=v.implementation.delay)
        except LoopwrightError as error:
            gains.append((v.title, error.message, "", ""))
            continue
        for name, value in zip(("a0", "a1", "a2"), better.gains, strict=True):
            unit = {"a0": "1/s3", "a1": "1/s2", "a2": "1/s"}[name]
            numbers[f"{side}.{v.key}.gain_{name}"] = Number(
                value, unit, 1e-9 * abs(value), "the polynomial with these gains"
            )
        gains.append((v.title, *(numbers[f"{side}.{v.key}.gain_{a}"] for a in ("a2", "a1", "a0"))))
    columns = ("variant", "poles [1/s]", "difference of polynomials")
    note = TEXTS.line("compared")
    yield Table(f"Error dynamics {side}: poles", columns, tuple(rows), note)
    if gains:
        now = ("as they are", *(f"{getattr(block, a):.9g}" for a in ("a2", "a1", "a0")))
        title = f"Error dynamics {side}: gains that put the sampled poles where they were asked"
        yield Table(title, ("variant", "a₂ [1/s]", "a₁ [1/s²]", "a₀ [1/s³]"), (now, *gains))


def _off(got: np.ndarray, formula: np.ndarray) -> float:
    """Return the difference of a polynomial from another one; NaN where it has a lower order.

    A loop of a higher order has modes besides, factors of its polynomial where they are hidden: the remainder of the
    division is told, over the quotient, on circles of the size of the roots that are looked for.
    """
    if len(got) <= len(formula):
        return relative_difference(got, formula) if len(got) == len(formula) else np.nan
    besides, rest = np.polydiv(got, formula)
    circle = np.exp(2j * np.pi * (np.arange(16) + 0.5) / 16)
    on = np.abs(np.roots(formula))[:, None] * circle  # a circle for each: a delay's root is far from the others
    left = np.abs(np.polyval(rest, on)) / np.abs(np.polyval(besides, on))
    return float(np.max(np.max(left, axis=1) / np.max(np.abs(np.polyval(formula, on)), axis=1)))


def _cleaned(polynomial: np.ndarray, roots: np.ndarray) -> np.ndarray:
    """Return roots with a triple one exact where the polynomial is its cube, else as they are."""
    p = -polynomial[1] / 3
    exact = np.array([p, p, p], dtype=complex)
    return exact if relative_difference(np.poly(exact), polynomial) < 1e-12 else roots
