"""The blocks and wires of the paper's Fig. 3: path following and compliance control around a plant."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks import (
    AdmittanceFilter,
    Constant,
    Encoder,
    ErrorDynamics,
    FeedbackLinearization,
    ForceProjection,
    ForceSensor,
    Path,
    PathProjection,
    PlanarModel,
    Saturation,
    TransverseTransform,
    UnitDelay,
)
from ...blocks.core import Input, Output, ShapeError, UnknownNameError, explain_calls
from ...fmus import Fmu
from ...fmus.fmu_block import suggest_names
from ...fmus.models import gantry
from ..wiring import subsystem

POLES_PAR, POLES_PERP = (-20.0,) * 3, (-40.0,) * 3
"""Poles of the error dynamics in 1/s (section V)."""
IMPEDANCE_PAR = {"mass": 0.5, "damping_ratio": 0.6, "stiffness": 10.0}
IMPEDANCE_PERP = {"mass": 2.0, "damping_ratio": 0.3, "stiffness": 200.0}
"""Table III, with d = 2 ζ √(m k) (E7)."""

INPUTS: Mapping[str, str] = MappingProxyType({"motor_force": "N", "external_force": "N"})
"""Inputs that a plant must have, each of two entries (axes y and z), with their units."""
OUTPUTS: Mapping[str, str] = MappingProxyType({"position": "m", "velocity": "m/s", "acceleration": "m/s2"})
"""Outputs that a plant must have."""
OPTIONAL: Mapping[str, str] = MappingProxyType({"contact_force": "N"})
"""Outputs that a plant may have."""


@explain_calls
@dataclass(frozen=True)
class Rig:
    """Effects of a real rig that the ideal loop lacks; all are off by default.

    Attributes
    ----------
    tool_mass : float
        Mass beyond the force sensor in kg.
    encoder : float
        Quantum of the position encoder in m; velocities then come from differences.
    delay : int
        Samples of computational delay, 0 or 1.
    motor_force_limit : float or pair, optional
        Largest motor force of each axis in N; None in a pair is no limit.
    sample_time : float
        Sample time of the controller in s.
    admittance_method : str
        Discretization of the admittance, ``"exact"`` or ``"semi_implicit"``.
    """

    tool_mass: float = 0.0
    encoder: float = 0.0
    delay: int = 0
    motor_force_limit: Any = None
    sample_time: float = 1e-3
    admittance_method: str = "exact"


IDEAL = Rig()
"""The ideal loop."""


@explain_calls
@dataclass(frozen=True)
class Channel:
    """Reference and admittance of one direction of the controller.

    Attributes
    ----------
    reference : source
        The reference with its derivatives; it is the path reference itself where there is no admittance.
    admittance : AdmittanceFilter, optional
        The admittance filter, without which the reference is followed directly.
    desired_force : source, optional
        F^d in N, subtracted from the measured force (E16).
    offset : source, optional
        A set-point without derivatives, relative to the reference, in m (E27).
    """

    reference: Any
    admittance: AdmittanceFilter | None = None
    desired_force: Any = None
    offset: Any = None

    def extras(self) -> dict[str, Any]:
        """Return the optional inputs of the admittance that are wired."""
        pairs = {"desired_force": self.desired_force, "offset": self.offset}
        return {name: source for name, source in pairs.items() if source is not None}


def wire(
    plant: Fmu,
    path: Path,
    par: Channel,
    perp: Channel,
    *,
    environment: Callable[[Any], Any] | None = None,
    model: PlanarModel = gantry.nominal,
    rig: Rig = IDEAL,
) -> Any:
    """Return the call of the plant that closes the diagram of Fig. 3; see `fig3` for the parameters."""
    check_plant(plant)
    position, velocity = plant.position.named("position"), plant.velocity.named("velocity")
    if environment is None:
        external_force = Constant(value=(0.0, 0.0), unit="N", name="free_space")
    else:
        external_force = environment(position)

    @subsystem(sample_time=rig.sample_time)
    def sensors(position, velocity, acceleration, force, contact_force=None):  # type: ignore[no-untyped-def]
        if rig.encoder:
            position, velocity = Encoder(quantum=rig.encoder)(position, velocity)
        contact = {} if contact_force is None else {"contact_force": contact_force}
        measured = ForceSensor(tool_mass=rig.tool_mass)(force, acceleration, **contact)
        return {"measured_position": position, "measured_velocity": velocity, "measured_force": measured.named("force")}

    @subsystem(sample_time=rig.sample_time, method=rig.admittance_method)
    def controller(position, velocity, force, eta_d, xi_d, **extras):  # type: ignore[no-untyped-def]
        theta = PathProjection(path)(position).named("theta")
        eta, xi = TransverseTransform(path)(theta, position, velocity).named("eta", "xi")
        f_par, f_perp = ForceProjection(path)(theta, force)

        linearization = FeedbackLinearization(path, model)
        saturation = None if rig.motor_force_limit is None else Saturation(limit=_limits(rig.motor_force_limit))
        excess = {} if saturation is None else {"excess": saturation.excess}

        eta_p = _path_reference(par, "par", f_par, eta_d, extras).named("eta_p")
        xi_p = _path_reference(perp, "perp", f_perp, xi_d, extras).named("xi_p")
        v_par = ErrorDynamics.from_poles(POLES_PAR, name="pid_par")(eta, eta_p, **excess).named("v_par")
        v_perp = ErrorDynamics.from_poles(POLES_PERP, name="pid_perp")(xi, xi_p, **excess).named("v_perp")

        motor_force = linearization(theta, position, velocity, force, v_par, v_perp)
        if saturation is not None:
            motor_force = saturation(motor_force)
        if rig.delay:
            motor_force = UnitDelay(name="computation")(motor_force)
        return motor_force.named("motor_force")

    contact = {"contact_force": plant.contact_force} if "contact_force" in plant.outputs else {}
    sensed = sensors(position, velocity, plant.acceleration, external_force, **contact)
    extras = {f"{k}_{side}": v for side, channel in (("par", par), ("perp", perp)) for k, v in channel.extras().items()}
    motor_force = controller(*sensed, par.reference, perp.reference, **extras)
    return plant(motor_force=motor_force.named("motor_force"), external_force=external_force)


def check_plant(plant: Fmu) -> None:
    """Refuse a plant without the ports that Fig. 3 wires, and say which they are."""
    inputs, outputs = plant.inputs, plant.outputs
    missing = [f"input {n!r}" for n in INPUTS if n not in inputs] + [
        f"output {n!r}" for n in OUTPUTS if n not in outputs
    ]
    shapes = {n: p.shape for n, p in inputs.items() if n in INPUTS}
    shapes |= {n: p.shape for n, p in outputs.items() if n in OUTPUTS or n in OPTIONAL}
    wrong = [f"{n!r} of shape {shape}" for n, shape in shapes.items() if shape not in ((2,), None)]
    if not missing and not wrong:
        return

    def listed(names: Mapping[str, str]) -> str:
        return ", ".join(f"{name} [2] in {unit}" for name, unit in names.items())

    suggested = suggest_names(
        plant,
        {n: Input(shape=(2,), unit=unit, name=n) for n, unit in INPUTS.items()},
        {n: Output(shape=(2,), unit=unit, name=n) for n, unit in OUTPUTS.items()},
    )
    rename = {**plant.rename, **suggested} if suggested else {"name in the FMU": "position"}
    one = "=".join(next(iter(rename.items())))
    scalars = any("[" in new for new in suggested.values())
    found = f"it has no {', no '.join(missing)}" if missing else f"it has {', '.join(wrong)}"
    raise (UnknownNameError if missing else ShapeError)(
        f"{found}. Fig. 3 needs a plant with the inputs {listed(INPUTS)}, and the outputs {listed(OUTPUTS)}; "
        f"{listed(OPTIONAL)} is optional (axes y and z). This one has the inputs {', '.join(inputs) or '(none)'}, "
        f"and the outputs {', '.join(outputs) or '(none)'}. Where only a name differs"
        f"{', or scalars are its elements' * scalars}, give it the expected one, in Python: "
        f"Fmu(file, rename={rename!r}). On the command line: --rename {shlex.quote(one)}, once for each.",
        block=plant.label,
    )


def _limits(limit: Any) -> Any:
    """Return limits as a saturation takes them: where there is none, the largest number."""
    entries = [np.finfo(float).max if v is None or v == np.inf else v for v in np.ravel(np.array(limit, dtype=object))]
    return entries if np.ndim(limit) else entries[0]


def _path_reference(channel: Channel, side: str, force: Any, reference: Any, extras: dict[str, Any]) -> Any:
    """Return the path reference: the admittance's, or the reference itself."""
    if channel.admittance is None:
        return reference
    wired = {name: extras[f"{name}_{side}"] for name in channel.extras()}
    return channel.admittance.replace(name=f"admittance_{side}")(force, reference, **wired)
