"""Poles asked and got, and the paper's claims about them: decoupling, independence of path point and offset."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...blocks import ErrorDynamics
from ...blocks.core.errors import LoopwrightError
from ..frequency.number import Number
from ..frequency.pole_placement import relative_difference, sampled_gains, sampled_poles
from ..frequency.realization import Realization
from .case import COORDINATES, FRICTION, SIDES, Case, Variant, in_s, with_parameters
from .model import Section, Table
from .section_loops import places

TEXT = (
    "Asked is the characteristic polynomial s³ + a₂ s² + a₁ s + a₀ of each error dynamics (E5). Polynomials are "
    "compared, not eigenvalues: a triple pole scatters by 1e-5 of itself and more where the polynomial is "
    "right to 1e-15. "
    "The difference is the largest of a coefficient, time scaled by the size of the poles, relative to the largest. "
    "Held over samples the same gains give other poles; they are told as s = log(z)/T."
)

SAME = 1e-6
"""Difference of polynomials beyond which a loop is not the sampled chain of integrators: the closed form is another
plant's, and its poles and gains are no numbers of this diagram."""
ON_THE_LIMIT = 1e-9
"""A pole no farther than that from the imaginary axis, relative to the fastest pole, is called neither way."""
MASSES = (
    ("mass_10", (1.1, 1.1), "+10 %"),
    ("mass_m10", (0.9, 0.9), "−10 %"),
    ("mass_unequal", (1.1, 0.9), "+10 % in y, −10 % in z"),
)


def poles(case: Case) -> Section | None:
    """Return the section about poles, None where nothing was placed."""
    blocks = {path: b for path, b in case.diagram.blocks.items() if isinstance(b, ErrorDynamics)}
    numbers: dict[str, Number] = {}
    tables = [_closed_loops(case, numbers)]
    text: list[str] = []
    if blocks:
        text.append(TEXT)
    if case.is_fig3:
        for side, wire in SIDES.items():
            tables += _asked(case, side, f"controller.{wire}", case.diagram.blocks[f"controller.pid_{side}"], numbers)
    memory = sorted({name for v in case.usable() for name in v.model.memory})
    if memory:
        text.append(
            f"Only a warm start, and no design poles: the states {', '.join(memory)}. Their poles at z = 0 are the "
            "controller's memory, and are left out here."
        )
    sections = tuple(_claims(case)) if case.is_fig3 else ()
    return Section("poles", "Poles asked and got", tuple(text), tuple(tables), (), numbers, sections)


def _closed_loops(case: Case, numbers: dict[str, Number]) -> Table:
    rows = []
    for v in case.usable():
        s = in_s(v.model.poles, v.model.dt)
        if s.size:
            slowest, fastest = float(np.max(s.real)), float(np.min(s.real))
            scatter = _scatter(v)
            margin = max(scatter, ON_THE_LIMIT * float(np.max(np.abs(s))))
            stable = "yes" if slowest < -margin else "no" if slowest > margin else "on the limit"
            numbers[f"{v.key}.slowest"] = Number(
                slowest, "1/s", scatter, "eigenvalues; tolerance by perturbing the matrix"
            )
            rows.append((v.title, len(s), stable, numbers[f"{v.key}.slowest"], f"{fastest:.6g} 1/s"))
    note = (
        "Of the whole diagram, all loops closed, memory aside; s = log(z)/T where sampled. On the limit: within "
        f"rounding, and {ON_THE_LIMIT:g} of the fastest pole, on the imaginary axis, as an integrator is that nothing "
        "feeds back."
    )
    return Table("Closed loop", ("variant", "poles", "stable", "largest Re s", "smallest Re s"), tuple(rows), note)


def _scatter(v: Variant) -> float:
    """Return how far the slowest pole moves when the model's matrix is rounded, tenfold."""
    keep = [i for i, name in enumerate(v.model.states) if name not in v.model.memory]
    A = v.model.A[np.ix_(keep, keep)]
    rng = np.random.default_rng(0)
    moved = np.linalg.eigvals(A * (1 + 1e-15 * rng.standard_normal(A.shape)))
    before = np.linalg.eigvals(A)
    if not v.model.dt:
        return 10 * abs(float(np.max(moved.real) - np.max(before.real))) + 1e-12
    ends = [float(np.log(np.max(np.abs(values)))) / v.model.dt for values in (before, moved)]
    return 10 * abs(ends[1] - ends[0]) + 1e-12


def _asked(case: Case, side: str, wire: str, block: Any, numbers: dict[str, Number]) -> Iterator[Table]:
    """Yield what one error dynamics asks for and gets, and the gains with which a sampled one would get it."""
    asked = np.array([1.0, block.a2, block.a1, block.a0])
    wanted = np.sort_complex(np.roots(asked))
    centre = -float(block.a2) / 3
    numbers[f"{side}.asked.mean"] = Number(centre, "1/s", 1e-15 * abs(centre), "given: −a₂/3", given=True)
    rows: list[tuple[Any, ...]] = [("asked", _listed(_cleaned(asked, wanted)), "")]
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
                rows.append((v.title, _listed(np.roots(got)), ""))
                continue
            numbers[f"{side}.{v.key}.polynomial_difference"] = Number(off, "1", 1e-9, how)
            if len(got) == len(asked):
                numbers[f"{side}.{v.key}.mean"] = Number(-got[1] / 3, "1/s", 1e-9 * abs(got[1]), "the trace of A")
            rows.append((v.title, _listed(np.roots(got)), numbers[f"{side}.{v.key}.polynomial_difference"]))
            continue
        if v.key.endswith(FRICTION):
            rows.append((v.title, _listed(in_s(1 + np.linalg.eigvals(r.closed_matrix()), r.dt)), ""))
            continue
        design = sampled_poles([block.a0, block.a1, block.a2], r.dt, delay=v.delay)
        got, formula = (
            np.poly(r.closed_matrix()),
            np.array(design.polynomial) * r.dt ** np.arange(len(design.polynomial)),
        )
        formula = formula / formula[0]  # in z − 1 in place of (z − 1)/T
        off = _off(got, formula)
        how = "closed form of the sampled chain of integrators against the diagram's own loop"
        if not off <= SAME:
            rows.append((v.title, _listed(in_s(1 + np.linalg.eigvals(r.closed_matrix()), r.dt)), ""))
            continue
        numbers[f"{side}.{v.key}.polynomial_difference"] = Number(off, "1", 1e-9, how)
        for i, s in enumerate(design.poles[:3], 1):
            numbers[f"{side}.{v.key}.pole_{i}_real"] = Number(s.real, "1/s", 1e-6 * abs(s), how)
            numbers[f"{side}.{v.key}.pole_{i}_imag"] = Number(abs(s.imag), "rad/s", 1e-6 * abs(s), how)
        rows.append((v.title, _listed(design.poles), numbers[f"{side}.{v.key}.polynomial_difference"]))
        try:
            better = sampled_gains(tuple(_cleaned(asked, wanted)), r.dt, delay=v.delay)
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
    note = (
        "Continuous: from the one asked for. Sampled: from the closed form of the sampled chain of integrators; empty "
        "where the loop is not that chain, and has other poles."
    )
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


def _listed(values: Any) -> str:
    values = np.asarray(values, dtype=complex)
    values = values[np.isfinite(values)]
    values = values[np.lexsort((-values.imag, np.abs(values)))]
    shown = []
    for v in values:
        if abs(v.imag) <= 1e-9 * abs(v):
            shown.append(f"{v.real:.6g}")
        elif v.imag > 0:
            shown.append(f"{v.real:.6g} ± {v.imag:.6g}j")
        elif not np.any(np.abs(values - v.conjugate()) < 1e-6 * abs(v)):
            shown.append(f"{v.real:.6g} − {-v.imag:.6g}j")
    return ", ".join(shown)


# --- the paper's claims ----------------------------------------------------------------------------------------------


def _claims(case: Case) -> Iterator[Section]:
    """Yield decoupling and independence of the point, with matched parameters, and how a mismatch breaks them."""
    claims = _Claims(case)
    for v in case.usable("continuous", "sampled_d0", "continuous" + FRICTION, "sampled_d0" + FRICTION):
        claims.judge(v, v.key, v.title + (", as it is" if case.plant_model is None else ", matched"))
    bases = {v.key: v for v in case.usable("continuous", "sampled_d0", "sampled_d0" + FRICTION)}
    plain = bases.get("sampled_d0", bases.get("continuous"))
    if plain is not None and {"translational_mass", "equivalent_mass"} <= set(case.model.parameter_specs):
        model = inverted(plain)
        for name, share, text in MASSES:
            more = model.mass * (np.array(share) - 1.0)  # where it weighs nothing
            changed = model.replace(equivalent_mass=model.equivalent_mass + more)
            claims.judge(with_model(plain, changed), name, f"{plain.title}, model's mass {text}", plain.key)
    rough = bases.get("sampled_d0" + FRICTION)
    if rough is not None:
        model = inverted(rough)
        for name, left in (("friction_10", 1.1), ("friction_m10", 0.9), ("friction_m100", 0.0)):
            scales = {n: getattr(model, n) * left for n in ("coulomb_scale", "viscous_scale")}
            title = f"{rough.title}, model's friction {100 * (left - 1):+.0f} %"
            claims.judge(with_model(rough, model.replace(**scales)), name, title, rough.key)
    if claims.rows:
        yield claims.section()


def inverted(v: Variant) -> Any:
    """Return the model that a variant's feedback linearization inverts."""
    block: Any = v.diagram["controller.feedback_linearization"]
    return block.model


def with_model(v: Variant, model: Any) -> Variant:
    """Return a variant whose feedback linearization inverts another model."""
    return with_parameters(v, {"controller.feedback_linearization.model": model})


class _Claims:
    """Numbers and rows about the claims, variant by variant, each at several points beside the path."""

    def __init__(self, case: Case):
        self.case = case
        self.numbers: dict[str, Number] = {}
        self.rows: list[tuple[Any, ...]] = []
        self.matched: dict[str, list[np.ndarray]] = {}

    def judge(self, v: Variant, key: str, title: str, base: str | None = None) -> None:
        """Take a variant in; ``base`` is the matched one that it is compared with."""
        try:
            at = [w for _, eta, xi in places(self.case)[1:5] if (w := self.case.at(v, eta, xi)) is not None]
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
                max(map(_scatter, at)),
                "eigenvalues at all points",
            ),
        }
        if base is not None and len(self.matched.get(base, ())) == len(at):
            away = max(relative_difference(p, q) for p, q in zip(polynomials, self.matched[base], strict=True))
            found["from_matched"] = Number(away, "1", 1e-9, "characteristic polynomials at all the points")
        self.numbers |= {f"{key}.{name}": number for name, number in found.items()}
        shown = (found.get(name, "–") for name in ("coupling", "polynomial_spread", "from_matched", "slowest"))
        self.rows.append((title, *shown, len(at)))

    def section(self) -> Section:
        """Return the section."""
        columns = ("variant", "coupling", "between points", "from matched", "largest Re s", "points")
        note = (
            "Coupling: largest |G⊥∥| and |G∥⊥| over frequency, from a virtual input to the other direction's "
            "coordinate, relative to the largest of its own direction. Between points, and from matched: largest "
            "difference of characteristic polynomials of the whole closed loop. Points: beside the path, with and "
            "without offset, where the diagram is at rest."
        )
        text = (
            (
                "The paper claims that exact linearization decouples the directions, and that the poles "
                "depend neither on "
                "the path point nor on the offset. Both hold for the continuous design with matched parameters; the "
                "numbers say how well, what sampling leaves of it, and what a mismatch does."
            ),
        )
        table = Table("Claims", columns, tuple(self.rows), note)
        return Section("claims", "The paper's claims", text, (table,), (), self.numbers)


def polynomial(v: Variant) -> np.ndarray:
    """Return the closed loop's characteristic polynomial in s, or in w = (z − 1)/T, without memory."""
    keep = [i for i, name in enumerate(v.model.states) if name not in v.model.memory]
    A = v.model.A[np.ix_(keep, keep)]
    return np.poly((A - np.eye(len(A))) / v.model.dt if v.model.dt else A)


def coupling(v: Variant) -> float:
    """Return how much of a virtual input appears in the other direction's coordinate, relative to its own one's."""
    model = v.model
    rows = [next(i for i, n in enumerate(model.outputs) if n.startswith(name)) for name in COORDINATES]
    w = np.geomspace(1.0, min(1e3, 0.99 * np.pi / model.dt) if model.dt else 1e3, 60)
    p = np.exp(1j * w * model.dt) if model.dt else 1j * w
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(z * eye - model.A, model.B.astype(complex)) + model.D for z in p])[:, rows]
    size = np.abs(G).max(axis=0)
    return float(max(size[1, 0] / size[0, 0], size[0, 1] / size[1, 1]))
