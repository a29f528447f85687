"""A gantry with an environment inside its FMU: what stability limits are tried with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...blocks import Array, Output, Reference, parameter
from ...fmus import Fmu, build
from ...fmus.models import Gantry
from ..contact import SIDES
from ..diagram import Diagram
from .compliance_loop import AdmittanceLoop
from .wires import Channel, Rig, wire

INTERNAL_STEP = 1e-4


class MooredGantry(Gantry):
    """The gantry on a spring and a damper in one direction, with a mass that moves along in it."""

    direction: Array = parameter(default=(1.0, 0.0), shape=(2,), unit="1", description="unit vector of the direction")
    anchor: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m", description="where the spring is relaxed")
    spring: float = parameter(default=0.0, unit="N/m", minimum=0.0, description="stiffness k_e")
    damper: float = parameter(default=0.0, unit="N.s/m", minimum=0.0, description="damping b_e")
    load: float = parameter(default=0.0, unit="kg", minimum=0.0, description="mass m_e")
    contact_force = Output(shape=(2,), unit="N", description="force of the environment on the robot")

    def accelerated(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the acceleration, and the force of spring and damper; the load adds mass in one direction."""
        d = self.direction
        pulled = -self.spring * (d @ (x.position - self.anchor)) - self.damper * (d @ x.velocity)
        a = self.coordinate_acceleration(x.position, x.velocity, u.motor_force, u.external_force + d * pulled)
        return a - d / self.mass * ((d @ a) * self.load / (1.0 + self.load * (d @ (d / self.mass)))), pulled

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return velocity and acceleration."""
        return x.velocity, self.accelerated(x, u)[0]

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return acceleration and contact force."""
        a, pulled = self.accelerated(x, u)
        inertial = np.where(t > 0.0, self.load * (self.direction @ a), 0.0)  # nothing has acted yet at the start
        return a, self.direction * (pulled - inertial)


def moored() -> Path:
    """Return the FMU, built once."""
    return build(MooredGantry(), name="moored_gantry", internal_step=INTERNAL_STEP)


def moored_diagram(loop: AdmittanceLoop, push: float, **environment: float) -> Diagram:
    """Return Fig. 3 with the parameters of a loop against an environment, started with a velocity towards it.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    push : float
        The velocity in m/s.
    **environment
        ``stiffness``, ``damping`` and ``mass``.
    """
    along = loop.frame[:, SIDES.index(loop.side)]
    at = loop.path.to_plane(loop.eta, loop.xi)
    names = {"stiffness": "spring", "damping": "damper", "mass": "load"}
    start: dict[str, Any] = {names[name]: value for name, value in environment.items()}
    robot: Any = loop.true_plant
    start |= {n: getattr(robot, n) for n in Gantry.parameter_specs if not n.startswith("start_")}
    start |= {"direction": along, "anchor": at, "position": at, "velocity": push * along}
    filters = {side: getattr(loop, f"admittance_{side}") for side in SIDES}
    references = {"par": Reference(loop.eta, unit="m", name="eta_d"), "perp": Reference(loop.xi, unit="m", name="xi_d")}
    channels = [Channel(references[side], filters[side]) for side in SIDES]
    rig = Rig(tool_mass=loop.tool_mass, delay=loop.delay, sample_time=loop.sample_time, admittance_method=loop.method)
    plant = Fmu(moored(), name="plant", start=start)
    made = Diagram("moored", wire(plant, loop.path, *channels, model=loop.model, rig=rig))
    pids: dict[str, Any] = {
        f"controller.pid_{side}": getattr(loop, f"pid_{side}").replace(name=f"pid_{side}") for side in SIDES
    }
    return made.replace(pids)


def deviation(loop: AdmittanceLoop, run: Any) -> np.ndarray:
    """Return the position towards the environment, less that at rest."""
    along = loop.frame[:, SIDES.index(loop.side)]
    return np.asarray((run["plant.position"] - loop.path.to_plane(loop.eta, loop.xi)) @ along)


def measured_growth(signal: np.ndarray, sample_time: float, at: float, span: float, window: float) -> float:
    """Return the growth rate in 1/s over ``span``, from the energy in two like windows: the same for any phase."""
    first, shift, length = (round(v / sample_time) for v in (at, span, window))
    weight = np.hanning(length + 2)[1:-1]
    energies = [float(np.sum(weight * signal[k : k + length] ** 2)) for k in (first, first + shift)]
    return 0.5 * float(np.log(energies[1] / energies[0])) / span
