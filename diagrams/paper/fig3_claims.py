"""The paper's claims about Fig. 3: directions are decoupled, and poles don't depend on path point and offset."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...blocks import PlanarModel
from ...blocks.core import LoopwrightError
from ...fmus.models import Gantry
from ..frequency import Number, relative_difference, with_findings
from ..report import POLES_TITLE, Implementation, Section, Table, Texts, Variant, in_s, scatter, without_memory
from .fig3_case import COORDINATES, Fig3Case, linearization_of

TEXTS = Texts(__package__, "poles")
CONTINUOUS, SAMPLED = Implementation.CONTINUOUS, Implementation.SAMPLED
MASSES = (
    ("mass_10", (1.1, 1.1), "+10 %"),
    ("mass_m10", (0.9, 0.9), "−10 %"),
    ("mass_unequal", (1.1, 0.9), "+10 % in y, −10 % in z"),
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
    """Numbers and rows about the claims, variant by variant, each at several points beside the path."""

    def __init__(self, case: Fig3Case):
        self.case = case
        self.numbers: dict[str, Number] = {}
        self.rows: list[tuple[Any, ...]] = []
        self.matched: dict[str, list[np.ndarray]] = {}

    def judge(self, v: Variant, key: str, title: str, base: str | None = None) -> None:
        """Take a variant in; ``base`` is the matched one that it is compared with."""
        try:
            at = [w for _, eta, xi in self.case.places()[1:5] if (w := self.case.at(v, eta, xi)) is not None]
            polynomials = [polynomial(w) for w in at]
            coupled = [coupling(w) for w in at]
        except LoopwrightError as error:
            self.rows.append((title, error.message, "", "", "", ""))
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
        self.numbers |= {f"{key}.{name}": number for name, number in found.items()}
        shown = (found.get(name) for name in ("coupling", "polynomial_spread", "from_matched", "slowest"))
        self.rows.append((title, *shown, len(at)))

    def section(self) -> Section:
        """Return the section that is added to that on poles."""
        columns = ("variant", "coupling", "between points", "from matched", "largest Re s", "points")
        table = Table("Claims", columns, tuple(self.rows), TEXTS.line("columns"))
        part = Section("claims", "The paper's claims", TEXTS.paragraphs("claims"), (table,), (), self.numbers)
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
