"""Fig. 3 around four robots at two points of its ellipse: rigid, with elastic screws, with stiction, and an arm."""

from functools import cache

import numpy as np

from loopwright.blocks import (
    AdmittanceFilter,
    Constant,
    Ellipse,
    ErrorDynamics,
    FeedbackLinearization,
    ForceProjection,
    ForceSensor,
    PathProjection,
    Reference,
    TransverseTransform,
)
from loopwright.diagrams import Channel, Diagram, Rig, fig3, subsystem
from loopwright.diagrams.paper.fig3_wires import IMPEDANCE_PAR, IMPEDANCE_PERP, POLES_PAR, POLES_PERP
from loopwright.fmus import Fmu, gantry, gantry_elastic, gantry_stiction, scara

ELLIPSE = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
POINTS = (0.0, 0.5)
"""Arc lengths in m: the ellipse's right end, and a point where it is less curved."""
GANTRIES = {"gantry": gantry, "gantry_elastic": gantry_elastic, "gantry_stiction": gantry_stiction}
ROBOTS = (*GANTRIES, "scara")
PUSH = {"gantry_stiction": 1e-8}
"""Velocity in m/s that sets a robot in motion, where 1e-6 is too fast: the bristles are to hold."""
FRICTIONLESS = {"coulomb_scale": 0.0, "viscous_scale": 0.0}
FRICTIONLESS_ARM = {"coulomb_friction": (0.0, 0.0), "viscous_friction": (0.0, 0.0)}


@cache
def robot(name, eta=0.0, delay=0, friction=True):
    """A diagram at rest at a point of the path, sampled at 1 kHz."""
    at = ELLIPSE.to_plane(eta, 0.0)
    if name == "scara":
        return arm(at, eta, delay, friction=friction)
    start = {"position": at} | ({} if friction else FRICTIONLESS)
    plant = Fmu(GANTRIES[name].build(), name="plant", start=start)
    model = gantry.nominal if friction else gantry.nominal.replace(**FRICTIONLESS)
    par, perp = channels(eta)
    return fig3(plant, ELLIPSE, Channel(*par), Channel(*perp), model=model, rig=Rig(delay=delay), name=name)


def channels(eta):
    return (
        (Reference(eta, unit="m", name="eta_d"), AdmittanceFilter(**IMPEDANCE_PAR, name="admittance_par")),
        (Reference(0.0, unit="m", name="xi_d"), AdmittanceFilter(**IMPEDANCE_PERP, name="admittance_perp")),
    )


def arm(at, eta, delay, *, friction):
    """The arm, with its own model in the controller: it commands torques."""
    q = scara.nominal.joint_angles(at)
    own = {} if friction else FRICTIONLESS_ARM
    plant = Fmu(scara.build(), name="plant", start={"joint_angle": q, **own})
    (eta_d, par), (xi_d, perp) = channels(eta)

    @subsystem(sample_time=1e-3, delay=delay)
    def controller(position, velocity, acceleration, push, angle, rate, eta_d, xi_d):
        force = ForceSensor(name="force_sensor")(push, acceleration).named("force")
        theta = PathProjection(ELLIPSE)(position).named("theta")
        eta, xi = TransverseTransform(ELLIPSE)(theta, position, velocity).named("eta", "xi")
        f_par, f_perp = ForceProjection(ELLIPSE)(theta, force)
        v_par = ErrorDynamics.from_poles(POLES_PAR, name="pid_par")(eta, par(f_par, eta_d).named("eta_p"))
        v_perp = ErrorDynamics.from_poles(POLES_PERP, name="pid_perp")(xi, perp(f_perp, xi_d).named("xi_p"))
        law = FeedbackLinearization(ELLIPSE, scara.nominal.replace(**own))
        return law(theta, angle, rate, force, v_par.named("v_par"), v_perp.named("v_perp"))

    push = Constant(value=(0.0, 0.0), unit="N", name="free_space")
    p = plant
    torque = controller(p.position, p.velocity, p.acceleration, push, p.joint_angle, p.joint_velocity, eta_d, xi_d)
    return Diagram("scara", plant(motor_torque=torque, external_force=push))


@cache
def contact(name, side, eta=0.0, delay=0, friction=True):
    return robot(name, eta, delay, friction).contact("plant.external_force", direction=side)


def regime(name, friction, found):
    """Say at which amplitude a confirmation holds, and in which regime of the friction."""
    fastest, omega = max(t.fastest for t in found.trials), max(found.limit.frequency, 1.0)
    if not friction:
        return f"without friction, speeds up to {fastest:.1g} m/s"
    if name == "gantry_stiction":
        travel = fastest / omega
        return f"bristles hold, motion up to {travel:.1g} m"
    return f"friction's slope at rest, speeds up to {fastest:.1g} m/s"


def is_linear(name, found):
    """Whether a run stayed where its friction is linear: far below the width of 1 cm/s; bristles hold for 30 um."""
    fastest, omega = max(t.fastest for t in found.trials), max(found.limit.frequency, 1.0)
    return bool(fastest < 1e-3 and (name != "gantry_stiction" or np.all(fastest / omega < 1e-7)))
