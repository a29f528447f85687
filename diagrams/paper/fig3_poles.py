"""The poles that the error dynamics of Fig. 3 ask for and get, and the paper's claims about them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...blocks import ErrorDynamics, ForceSensor, PlanarModel
from ...blocks.core import LoopwrightError
from ...fmus.models import Gantry
from ..frequency import Number, Realization, relative_difference, sampled_gains, sampled_poles, with_findings
from ..report import (
    POLES_TITLE,
    Implementation,
    Section,
    Table,
    TableForm,
    Texts,
    Variant,
    in_s,
    list_poles,
    scatter,
    without_memory,
)
from .fig3_case import COORDINATES, Fig3Case, linearization_of

TEXTS = Texts(__package__, "poles")
SAME = 1e-6
"""Difference of polynomials beyond which a loop is not the sampled chain of integrators: the closed form is another
plant's, and its poles and gains are no numbers of this diagram."""
CONTINUOUS, SAMPLED = Implementation.CONTINUOUS, Implementation.SAMPLED
MASSES = (
    ("mass_10", (1.1, 1.1), "+10 %"),
    ("mass_m10", (0.9, 0.9), "−10 %"),
    ("mass_unequal", (1.1, 0.9), "+10 % in y, −10 % in z"),
)


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
            if len(got) != len(asked) and not off <= SAME:  # the plant has its own dynamics
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

    A loop of a higher order has more modes, factors of its polynomial where they are hidden. Then the remainder of the
    division counts, over the quotient, on circles of the size of the roots that are looked for.
    """
    if len(got) <= len(formula):
        return relative_difference(got, formula) if len(got) == len(formula) else np.nan
    others, rest = np.polydiv(got, formula)
    circle = np.exp(2j * np.pi * (np.arange(16) + 0.5) / 16)
    on = np.abs(np.roots(formula))[:, None] * circle  # a circle for each: a delay's root is far from the others
    left = np.abs(np.polyval(rest, on)) / np.abs(np.polyval(others, on))
    return float(np.max(np.max(left, axis=1) / np.max(np.abs(np.polyval(formula, on)), axis=1)))


def _cleaned(polynomial: np.ndarray, roots: np.ndarray) -> np.ndarray:
    """Return roots with a triple one exact where the polynomial is its cube, else as they are."""
    p = -polynomial[1] / 3
    exact = np.array([p, p, p], dtype=complex)
    return exact if relative_difference(np.poly(exact), polynomial) < 1e-12 else roots


# --- the paper's claims -----------------------------------------------------------------------------------------------

CLAIMS = TableForm(
    "Claims",
    {
        "variant": "variant",
        "coupling": "coupling",
        "between points": "polynomial_spread",
        "from matched": "from_matched",
        "largest Re s": "slowest",
        "points": "points",
    },
    {name: f"{{key}}.{name}" for name in ("coupling", "polynomial_spread", "slowest", "from_matched")},
)


def claims(case: Fig3Case) -> Section | None:
    """Return decoupling and independence of the point, with matched parameters, and how a mismatch breaks them."""
    found = _Claims(case)
    known = {(v.is_design, v.implementation): v for v in case.usable(CONTINUOUS, SAMPLED)}
    for v in known.values():
        found.judge(v, v.key, v.title + (", as it is" if case.plant_model is None else ", matched"))
    plain = known.get((True, SAMPLED), known.get((True, CONTINUOUS)))
    if plain is not None and isinstance(model := linearization_of(plain.diagram).model, Gantry):
        for name, share, text in MASSES:
            more = model.mass * (np.array(share) - 1.0)  # where it weighs nothing
            changed = model.replace(equivalent_mass=model.equivalent_mass + more)
            found.judge(with_model(plain, changed), name, f"{plain.title}, model's mass {text}", plain.key)
    rough = known.get((False, SAMPLED))
    if rough is not None and isinstance(model := linearization_of(rough.diagram).model, Gantry):
        for name, left in (("friction_10", 1.1), ("friction_m10", 0.9), ("friction_m100", 0.0)):
            scales = {n: getattr(model, n) * left for n in ("coulomb_scale", "viscous_scale")}
            title = f"{rough.title}, model's friction {100 * (left - 1):+.0f} %"
            found.judge(with_model(rough, model.replace(**scales)), name, title, rough.key)
    return found.section() if found.rows else None


def with_model(v: Variant, model: PlanarModel) -> Variant:
    """Return a variant whose feedback linearization inverts another model."""
    return v.with_parameters({"controller.feedback_linearization.model": model})


class _Claims:
    """Numbers and rows about the claims, variant by variant, each at several points off the path."""

    def __init__(self, case: Fig3Case):
        self.case = case
        self.rows: list[dict[str, Any]] = []
        self.matched: dict[str, list[np.ndarray]] = {}

    def judge(self, v: Variant, key: str, title: str, base: str | None = None) -> None:
        """Take a variant in; ``base`` is the matched one that it is compared with."""
        try:
            at = [w for _, eta, xi in self.case.places()[1:5] if (w := self.case.at(v, eta, xi)) is not None]
            polynomials = [polynomial(w) for w in at]
            coupled = [coupling(w) for w in at]
        except LoopwrightError as error:
            self.rows.append({"variant": title, "key": key, "coupling": error.message})
            return
        if not at:
            return
        self.matched.setdefault(key, polynomials)
        spread = max(relative_difference(p, polynomials[0]) for p in polynomials)
        found = {
            "coupling": Number(max(coupled), "1", 1e-9, "frequency responses on a grid, at all the points"),
            "polynomial_spread": Number(spread, "1", 1e-9, "characteristic polynomials at all the points"),
            "slowest": Number(
                max(float(np.max(in_s(w.model.poles, w.model.dt).real)) for w in at),
                "1/s",
                max(map(scatter, at)),
                "eigenvalues at all points",
            ),
        }
        if base is not None and len(self.matched.get(base, ())) == len(at):
            away = max(relative_difference(p, q) for p, q in zip(polynomials, self.matched[base], strict=True))
            found["from_matched"] = Number(away, "1", 1e-9, "characteristic polynomials at all the points")
        found = with_findings(found, tuple(f for w in at for f in w.model.findings_on_loops))
        self.rows.append({"variant": title, "key": key, **found, "points": len(at)})

    def section(self) -> Section:
        """Return the section that is added to that on poles."""
        table = CLAIMS.fill(self.rows, TEXTS.line("columns"))
        blocks = self.case.diagram.blocks.values()
        tool = max((block.tool_mass for block in blocks if isinstance(block, ForceSensor)), default=0.0)
        text = [*TEXTS.paragraphs("claims"), *([TEXTS.line("claims_with_tool", tool=tool)] if tool else [])]
        part = Section("claims", "The paper's claims", tuple(text), (table,))
        return Section("poles", POLES_TITLE, sections=(part,))


def polynomial(v: Variant) -> np.ndarray:
    """Return the closed loop's characteristic polynomial in s, or in w = (z − 1)/T, without memory."""
    A = without_memory(v)
    return np.poly((A - np.eye(len(A))) / v.model.dt if v.model.dt else A)


def coupling(v: Variant) -> float:
    """Return how much of a virtual input appears in the other direction's coordinate, relative to its own one's."""
    model = v.model
    rows = [model.outputs.index(f"{name}[1]") for name in COORDINATES]
    w = np.geomspace(1.0, min(1e3, 0.99 * np.pi / model.dt) if model.dt else 1e3, 60)
    p = np.exp(1j * w * model.dt) if model.dt else 1j * w
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(z * eye - model.A, model.B.astype(complex)) + model.D for z in p])[:, rows]
    size = np.abs(G).max(axis=0)
    return float(max(size[1, 0] / size[0, 0], size[0, 1] / size[1, 1]))
