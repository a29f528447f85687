"""Target and rendered admittance, passivity, and the environments that Fig. 3's compliance loop can touch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...blocks.core.errors import LoopwrightError
from ..admittance.compliance_loop import SIDES, AdmittanceLoop
from ..admittance.coupled import growth_rate
from ..admittance.rendered import passivity, rendered_admittance, target_admittance
from ..admittance.stability_limits import StabilityLimit, stability_limit
from ..frequency.number import Number
from ..report import plots as figures
from ..report.case import FRICTION, NO_FRICTION, Case
from ..report.model import Plot, Section, Table

DAMPINGS = (0.0, 10.0, 100.0)
SPRING = 10.0  # N/m, that holds a mass where the admittance has no stiffness
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "continuous": {"implementation": "continuous", "delay": 0},
    "sampled_d0": {"implementation": "sampled", "delay": 0},
    "sampled_d1": {"implementation": "sampled", "delay": 1},
}
TITLE = "Admittance and coupled stability"
WITHOUT = (
    "This report has no admittances, no limits of coupled stability, and none tried in time domain. They would be "
    "those of a rigid robot, M p̈ = u − C ṗ + F, under Fig. 3's controller. This diagram is not shown to be that: the "
    "plant's own linear model is compared with M and C, and the wires with those of Fig. 3. Found was this:"
)
TEXT = (
    (
        "What an environment feels of the robot, at rest at the operating point: Y(jω) is velocity over "
        "force. The coupled "
        "loop of robot and environment, a mass m_e, a damper b_e and a spring k_e, is stable where the growth "
        "rate σ of its "
        "slowest pole is negative. A limit is the first change of its sign on a scan from below; ∞ means "
        "none on the scan "
        "(stiffness up to 1e8 N/m, masses up to 1e4 kg), not that there is none. The rule of thumb beside it is "
        "k_e ≈ (d + b_e)/T_d, T_d = T/2 and a sample more for the delay."
    ),
    (
        "The continuous model hides both mass limits and all stiffness limits: they come from sampling. "
        "Friction that is "
        "compensated has its largest slope at rest; limits with it are told apart, as the diagram is in "
        "contact at rest."
    ),
)


class Loops:
    """The reduced loops of a case: by direction, with or without friction, impedance control or force tracking.

    Raises
    ------
    ParameterError
        If the plant is not shown to be the reduced model.
    """

    def __init__(self, case: Case):
        self.case = case
        where = next(case.usable("sampled_d0", "continuous"))
        values = where.point.values
        eta, xi = (float(np.ravel(values[f"controller.transverse_transform.{n}"])[0]) for n in ("eta", "xi"))
        period = case.path.length if case.path.period is not None else None
        at: dict[str, Any] = {"eta": eta % period if period else eta, "xi": xi, "implementation": "sampled", "delay": 0}
        at["point"] = where.point
        plant = case.plant_model
        self.plain: dict[str, AdmittanceLoop] = {}
        self.rough: dict[str, AdmittanceLoop] = {}
        for side in SIDES:
            if case.smooth is not None:
                bare = plant.replace(**NO_FRICTION)
                self.plain[side] = AdmittanceLoop.of(case.smooth, side, plant=bare, **at)
                self.rough[side] = AdmittanceLoop.of(case.base, side, plant=plant, **at)
            else:
                self.plain[side] = AdmittanceLoop.of(case.base, side, plant=plant, **at)

    def kinds(self, side: str) -> Iterator[tuple[str, str, AdmittanceLoop]]:
        """Yield the key of the limits, a title and the loop."""
        sets = [("", "", self.plain[side])]
        if side in self.rough:
            sets.append((FRICTION, ", friction slope at rest", self.rough[side]))
        for suffix, title, loop in sets:
            kind = "impedance control" if loop.admittance.stiffness > 0 else "force tracking"
            yield f"ke_limit{suffix}", kind + title, loop
            if loop.admittance.stiffness > 0:
                yield f"force_tracking.ke_limit{suffix}", "force tracking, k = 0" + title, tracking(loop)


def tracking(loop: AdmittanceLoop) -> AdmittanceLoop:
    """Return the loop with force tracking in its direction: no stiffness, the same damping."""
    a = loop.admittance
    free = a.replace(stiffness=0.0, damping=float(a.effective_damping), damping_ratio=None)
    return loop.replace(**{f"admittance_{loop.side}": free})


def admittance(case: Case) -> tuple[Section, Loops | None] | None:
    """Return the section about the admittances, and their loops; None where the diagram has none.

    Where the diagram has friction, ``ke_limit`` is that of the design without it, and ``ke_limit_friction`` that of
    ``stiffness_limits(AdmittanceLoop.of(diagram))``. Where the plant is not shown to be the reduced model, there are no
    loops, and the section says why in place of numbers.
    """
    if not case.is_fig3 or any(f"controller.admittance_{s}" not in case.diagram.blocks for s in SIDES):
        return None
    try:
        loops = Loops(case)
    except StopIteration:  # no variant could be analysed, which the notes say
        return None
    except LoopwrightError as error:
        return Section("admittance", TITLE, (WITHOUT, str(error))), None
    parts = tuple(_side(loops, side) for side in SIDES)
    return Section("admittance", TITLE, TEXT, sections=parts), loops


def _side(loops: Loops, side: str) -> Section:
    loop = loops.plain[side]
    numbers: dict[str, Number] = {}
    a = loop.admittance
    for name, value, unit in (
        ("mass", a.mass, "kg"),
        ("damping", float(a.effective_damping), "N.s/m"),
        ("stiffness", a.stiffness, "N/m"),
    ):
        numbers[f"target.{name}"] = Number(value, unit, 1e-15 * abs(value), "given", given=True)
    tables = [_passivity(loops, side, numbers), *_limits(loops, side, numbers), *_masses(loops, side, numbers)]
    plots = (_rendered(loops, side), _map(loops, side))
    symbol = "along the path, ∥" if side == "par" else "across the path, ⊥"
    text = (
        f"Asked: m = {a.mass:g} kg, d = {float(a.effective_damping):.6g} N s/m, k = {a.stiffness:g} N/m; at η = "
        f"{loop.eta:.4g} m, ξ = {loop.xi:.4g} m" + ("" if loop.scale == 1.0 else f", q = {loop.scale:.6g} (E22)") + ".",
        _caveat(loop),
    )
    return Section(side, f"Direction {symbol}", text, tuple(tables), plots, numbers)


def _caveat(loop: AdmittanceLoop) -> str:
    return passivity(loop).caveat


def _variants(loop: AdmittanceLoop) -> Iterator[tuple[str, AdmittanceLoop]]:
    for name, options in VARIANTS.items():
        yield name, loop.replace(**options)


def _passivity(loops: Loops, side: str, numbers: dict[str, Number]) -> Table:
    rows = []
    sets = [("", loops.plain[side]), (FRICTION, loops.rough.get(side))]
    for suffix, loop in sets:
        for name, variant in _variants(loop) if loop is not None else ():
            p = passivity(variant)
            how = "sign of Re Y just below and just above"
            if math.isfinite(p.frequency):
                values = [float(rendered_admittance(variant, p.frequency * f).real) for f in (1 - 1e-6, 1 + 1e-6)]
                if not values[0] > 0 > values[1] and p.frequency > p.scanned[0]:
                    how = "Re Y changes its sign within rounding there"
            else:
                how = f"Re Y ≥ 0 on the whole scan up to {p.scanned[1]:.6g} rad/s"
            path = f"first_non_passive.{name}{suffix}"
            error = p.tolerance * p.frequency if math.isfinite(p.frequency) else 0.0
            numbers[path] = Number(p.frequency, "rad/s", error, how)
            spans = ", ".join(f"{low:.5g} … {high:.5g}" for low, high in p.intervals) or "none"
            rows.append((name + suffix, numbers[path], spans, "yes" if p.stable else "no"))
    columns = ("variant", "first Re Y < 0 at", "all of Re Y < 0 [rad/s]", "stable alone")
    return Table("Sign of Re Y(jω)", columns, tuple(rows))


def _limits(loops: Loops, side: str, numbers: dict[str, Number]) -> Iterator[Table]:
    for key, title, loop in loops.kinds(side):
        rows = []
        for name, variant in _variants(loop):
            for b in DAMPINGS:
                found = stability_limit(variant, damping=b)
                path = f"{key}.{name}.be_{b:g}"
                numbers[path] = found.number
                rule, frequency = path.replace("ke_limit", "rule_of_thumb"), path.replace("ke_limit", "ke_frequency")
                numbers[rule] = Number(found.rule_of_thumb, "N/m", 0.0, "closed form (d + b_e)/T_d")
                if math.isfinite(found.frequency):
                    numbers[frequency] = Number(found.frequency, "rad/s", 1e-6 * found.frequency, found.confirmed_by)
                rows.append(
                    (name, f"{b:g} N s/m", numbers[path], numbers[rule], numbers.get(frequency, "–"), _again(found))
                )
        columns = ("variant", "b_e", "largest k_e", "rule of thumb", "oscillates at", "stable again")
        yield Table(f"Largest stiffness of the environment, {title}", columns, tuple(rows))


def _again(found: StabilityLimit) -> str:
    if not found.restabilizes:
        return "no"
    text, values = [], list(found.restabilizes)
    for low, high in zip(values[::2], [*values[1::2], None], strict=False):
        text.append(f"from {low:.6g}" + (f" to {high:.6g}" if high is not None else "") + f" {found.unit}")
    return ", ".join(text)


def _masses(loops: Loops, side: str, numbers: dict[str, Number]) -> Iterator[Table]:
    rows = []
    sets = [("", loops.plain[side]), (FRICTION, loops.rough.get(side))]
    # without any stiffness the robot drifts, and there is no limit to lose
    moored: dict[str, Any] = {} if loops.plain[side].admittance.stiffness > 0 else {"stiffness": SPRING}
    for suffix, loop in sets:
        for name, variant in _variants(loop) if loop is not None else ():
            shown = []
            for over, key in (("mass", "me_limit"), ("tool_mass", "tool_mass_limit")):
                found = stability_limit(variant, over, **moored)
                path = f"{key}{suffix}.{name}"
                numbers[path] = found.number
                shown += [numbers[path], _again(found)]
            rows.append((name + suffix, *shown))
    columns = ("variant", "largest m_e", "stable again", "largest tool mass", "stable again")
    how = f"on a spring of {SPRING:g} N/m" if moored else "without spring and damper"
    yield Table(f"Largest masses, {how}", columns, tuple(rows))


def _rendered(loops: Loops, side: str) -> Plot:
    loop = loops.plain[side]
    a = loop.admittance
    centre = math.sqrt(a.stiffness / a.mass) if a.stiffness > 0 else float(a.effective_damping) / a.mass
    w = np.geomspace(centre / 50, 0.999 * math.pi / loop.sample_time, 500)
    curves: dict[str, tuple[str, np.ndarray]] = {"target": ("target", target_admittance(loop, w))}
    for name, variant in _variants(loop):
        curves[name] = (name.replace("_", " "), rendered_admittance(variant, w))
    if side in loops.rough:
        curves["friction"] = ("sampled d0, friction slope at rest", rendered_admittance(loops.rough[side], w))
    return figures.admittances(f"admittance_{side}", side, w, curves)


def _map(loops: Loops, side: str) -> Plot:
    loop = loops.plain[side]
    k, b = np.geomspace(10.0, 1e6, 120), np.geomspace(0.1, 1e3, 41)

    def growth(of: AdmittanceLoop) -> np.ndarray:
        return np.asarray(growth_rate(of, stiffness=k[None, :], damping=b[:, None]))

    shown = growth(loop)
    lines = {"sampled d0": (_first(k, shown), b), "sampled d1": (_first(k, growth(loop.replace(delay=1))), b)}
    if side in loops.rough:
        lines["sampled d0, friction slope at rest"] = (_first(k, growth(loops.rough[side])), b)
    d = float(loop.admittance.effective_damping) / loop.scale
    lines["rule of thumb, d0"] = ((d + b) / (0.5 * loop.sample_time), b)
    return figures.stability(f"stability_{side}", side, (k, b, shown), lines)


def _first(k: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """Return where each row of growth rates first becomes positive, interpolated; NaN where it doesn't."""
    found = np.full(len(growth), np.nan)
    for row, sigma in enumerate(growth):
        beyond = np.flatnonzero(sigma > 0)
        if len(beyond) and beyond[0] > 0:
            i = beyond[0]
            share = sigma[i - 1] / (sigma[i - 1] - sigma[i])
            found[row] = math.exp((1 - share) * math.log(k[i - 1]) + share * math.log(k[i]))
    return found
