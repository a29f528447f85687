"""Limits of coupled stability, tried in the co-simulation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from ...blocks import Reference
from ...blocks.core import ConfirmationError, LoopwrightError
from ...fmus import Fmu
from ...fmus.models import gantry
from ..contact import SIDES, ContactTrial, PortNames, make_contact, try_limit
from ..diagram import Diagram
from ..frequency import Confirmation, Number
from ..report import Implementation, Section, TableForm, Texts
from .compliance_loop import AdmittanceLoop
from .fig3_admittance import not_shown
from .fig3_case import Fig3Case
from .fig3_wires import Channel, Rig, wire
from .reduced_loops import FRICTION, ReducedLoops, each_implementation

TEXTS = Texts(__package__, "limits_tried")
TITLE = "Limits tried in time domain"
FACTORS = {"below": 0.97, "above": 1.03}
WITHIN = 0.01
"""Largest difference of growth rates in 1/s: the growth factor over 1 s is then within 1 %."""
SAME = 1e-6
"""Relative difference of the limits of a loop and of its gantry's contact, above which they are two."""
TRIED = (
    ("perp", "ke_limit", Implementation.SAMPLED, 10.0),
    ("perp", "ke_limit", Implementation.DELAYED, 0.0),
    ("par", "ke_limit", Implementation.SAMPLED, 10.0),
    ("perp", "ke_limit" + FRICTION, Implementation.SAMPLED, 0.0),
    ("perp", "force_tracking.ke_limit", Implementation.SAMPLED, 10.0),
)
"""Which limits are tried: direction, which of its limits, implementation, damping in N s/m."""

GROWTH = TableForm(
    "Growth",
    {
        "limit": "limit",
        "share of it": "share",
        "k_e [N/m]": "stiffness",
        "growth rate, measured": "measured",
        "predicted [1/s]": "predicted",
    },
    {"measured": "{path}.{where}.growth_rate"},
)


def is_tried(case: Fig3Case) -> bool:
    """Return whether there are limits to try, or it is to be said here why there are none."""
    return isinstance(case.reduced, ReducedLoops) or (case.reduced is not None and "admittance" not in case.keys)


def limits_tried(case: Fig3Case) -> Section:
    """Return the section in which the nonlinear co-simulation is run on both sides of limits."""
    loops = case.reduced
    if not isinstance(loops, ReducedLoops):
        return Section("time_domain", TITLE, not_shown(case))
    text = [*TEXTS.paragraphs("pushed", below=FACTORS["below"], above=FACTORS["above"])]
    if case.plant_model is None:
        return Section("time_domain", TITLE, (*text, TEXTS.line("no_gantry")))
    if case.has_events:
        return Section("time_domain", TITLE, (*text, TEXTS.line("discrete_states")))
    rows: list[dict[str, Any]] = []
    for side, key, implementation, damping in TRIED:
        path = f"{side}.{key}.{implementation}.be_{damping:g}"
        if key not in loops.kinds(side):
            continue
        limit = loops.limit(side, key, implementation, damping).number
        if not math.isfinite(limit.value) or limit.value <= 0.0:
            continue
        loop = each_implementation(loops.kinds(side)[key].loop)[implementation]
        variant = implementation + loops.kinds(side)[key].suffix
        title = case.variants[variant].title if variant in case.variants else variant
        said = TEXTS.line("limit", along=side == "par", tracking="." in key, damping=damping, variant=title)
        try:
            for where, number, trial in _tried(loop, limit, damping, path):
                facts = {"limit": said, "share": trial.factor, "stiffness": trial.value, "predicted": trial.predicted}
                rows.append({**facts, "measured": number, "path": path, "where": where})
        except ConfirmationError:
            raise
        except LoopwrightError as error:
            text.append(f"{path}: {error}")
    return Section("time_domain", TITLE, tuple(text), (GROWTH.fill(rows),))


def _tried(
    loop: AdmittanceLoop, limit: Number, damping: float, path: str
) -> Iterator[tuple[str, Number, ContactTrial]]:
    contact = make_contact(_gantry_diagram(loop).wired, PortNames("plant.external_force"), loop.side, None, {})
    found = contact.stability_limit("stiffness", damping=damping)
    if not abs(found.value - limit.value) <= SAME * limit.value:
        raise ConfirmationError(
            f"found a limit of {limit.value:.9g} N/m, and {found.value:.9g} N/m of the contact with the gantry itself; "
            "expected the same.",
            block=path,
        )
    for where, trial in zip(FACTORS, try_limit(contact, found).trials, strict=True):
        if not abs(trial.measured - trial.predicted) < WITHIN:
            raise ConfirmationError(
                f"found a growth rate of {trial.measured:.5g} 1/s in the co-simulation at {trial.factor:g} of the "
                f"limit {limit.value:.6g} N/m, predicted {trial.predicted:.5g} 1/s; expected them within {WITHIN:g} "
                "1/s.",
                block=path,
            )
        how = Confirmation(
            f"σ = {trial.predicted:.6g} 1/s predicted by the eigenvalues of the reduced loop",
            "the prediction by the eigenvalues of the reduced loop",
        )
        yield where, Number(trial.measured, "1/s", WITHIN, how), trial


def _gantry_diagram(loop: AdmittanceLoop) -> Diagram:
    """Return Fig. 3 with the parameters of a loop, around the FMU of its gantry at rest."""
    robot = loop.true_plant
    start = {name: getattr(robot, name) for name in robot.parameter_specs if not name.startswith("start_")}
    start["position"] = loop.path.to_plane(loop.eta, loop.xi)
    references = (Reference(loop.eta, unit="m", name="eta_d"), Reference(loop.xi, unit="m", name="xi_d"))
    channels = [Channel(reference, loop.filters[side]) for reference, side in zip(references, SIDES, strict=True)]
    rig = Rig(tool_mass=loop.tool_mass, delay=loop.delay, sample_time=loop.sample_time, admittance_method=loop.method)
    plant = Fmu(gantry.build(), name="plant", start=start)
    made = Diagram("tried", wire(plant, loop.path, *channels, model=loop.model, rig=rig))
    return made.replace({f"controller.pid_{side}": pid.replace(name=f"pid_{side}") for side, pid in loop.pids.items()})
