"""Fig. 3 on a straight path along y, against an environment that is a part of the plant's FMU."""

from functools import cache

import numpy as np

from loopwright.blocks import AdmittanceFilter, ErrorDynamics, Line, Output, Reference, Step, parameter
from loopwright.diagrams import AdmittanceLoop, Channel, Rig, fig3
from loopwright.diagrams.paper.fig3_wires import IMPEDANCE_PAR, IMPEDANCE_PERP, POLES_PAR, POLES_PERP
from loopwright.fmus import Fmu, build, gantry
from loopwright.types import Array

PATH = Line(start=(-1.0, 0.0), end=(1.0, 0.0))  # the tangent is the axis y, the normal the axis z
SIDES = ("par", "perp")
MIDDLE = 1.0  # arc length at the origin
FREE = {"coulomb_friction": (0.0, 0.0), "viscous_friction": (0.0, 0.0)}
ROUGH = gantry.nominal.replace(gravity=0.0)  # with its friction, whose slope is largest at rest
SMOOTH = ROUGH.replace(**FREE)
FORCE_TRACKING = {
    "par": AdmittanceFilter(mass=0.5, stiffness=0.0, damping=AdmittanceFilter(**IMPEDANCE_PAR).effective_damping),
    "perp": AdmittanceFilter(mass=2.0, stiffness=0.0, damping=AdmittanceFilter(**IMPEDANCE_PERP).effective_damping),
}


class Moored(gantry.Gantry):
    """The gantry on a spring and a damper in one direction, with a mass that moves along in it, and a sine force."""

    direction: Array = parameter(default=(1.0, 0.0), shape=(2,), unit="1")
    anchor: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m")
    spring: float = parameter(default=0.0, unit="N/m", minimum=0.0)
    damper: float = parameter(default=0.0, unit="N.s/m", minimum=0.0)
    load: float = parameter(default=0.0, unit="kg", minimum=0.0)
    amplitude: float = parameter(default=0.0, unit="N")
    frequency: float = parameter(default=1.0, unit="rad/s", minimum=0.0)
    contact_force = Output(shape=(2,), unit="N")

    def accelerated(self, t, x, u):
        """Acceleration, and the force on the load: it adds its mass in the direction d alone."""
        d = self.direction
        pulled = self.amplitude * np.sin(self.frequency * t)
        pulled = pulled - self.spring * (d @ (x.position - self.anchor)) - self.damper * (d @ x.velocity)
        a = self.coordinate_acceleration(x.position, x.velocity, u.motor_force, u.external_force + d * pulled)
        return a - d / self.mass * ((d @ a) * self.load / (1.0 + self.load * (d @ (d / self.mass)))), pulled

    def derivative(self, t, x, u):
        return x.velocity, self.accelerated(t, x, u)[0]

    def output(self, t, x, u):
        a, pulled = self.accelerated(t, x, u)
        inertial = np.where(t > 0.0, self.load * (self.direction @ a), 0.0)  # nothing has acted yet at the start
        return a, self.direction * (pulled - inertial)


@cache
def moored():
    return build(Moored(), name="moored", internal_step=1.0 / 10000.0)


@cache
def loop(side="perp", model=SMOOTH, tracking=False, **options):
    """The loop of the diagram below, by its parameters; one object for equal ones, as it finds its contact once."""
    filters = FORCE_TRACKING if tracking else {}
    return AdmittanceLoop(
        options.pop("path", PATH),
        model,
        admittance_par=filters.get("par", AdmittanceFilter(**IMPEDANCE_PAR)),
        admittance_perp=filters.get("perp", AdmittanceFilter(**IMPEDANCE_PERP)),
        pid_par=ErrorDynamics.from_poles(POLES_PAR),
        pid_perp=ErrorDynamics.from_poles(POLES_PERP),
        side=side,
        **{"eta": MIDDLE, **options},
    )


def diagram(model, start, *, desired_force=None, file=None, environment=None):
    """Fig. 3 with the parameters of a reduced model; ``start`` are the FMU's start values."""
    step = {} if desired_force is None else {"desired_force": Step(times=0.0, values=desired_force, unit="N")}
    extra = {side: step if side == model.side else {} for side in ("par", "perp")}
    plant = Fmu(moored() if file is None else file, name="plant", start=start)
    eta_d, xi_d = (Reference(value, unit="m", name=name) for value, name in ((model.eta, "eta_d"), (model.xi, "xi_d")))
    return fig3(
        plant,
        model.path,
        Channel(eta_d, model.admittance_par, **extra["par"]),
        Channel(xi_d, model.admittance_perp, **extra["perp"]),
        environment=environment,
        model=model.model,
        rig=Rig(
            tool_mass=model.tool_mass,
            delay=model.delay,
            sample_time=model.sample_time,
            admittance_method=model.method,
        ),
    )


def parameters(plant):
    """The parameters of a gantry, as start values."""
    return {name: value for name, value in plant.parameters.items() if not name.startswith("start_")}


def moored_start(model, push, **environment):
    """Start values of the plant: at the rest position, with the velocity ``push`` towards the environment."""
    along = model.frame[:, SIDES.index(model.side)]
    at = model.path.to_plane(model.eta, model.xi)
    names = {"stiffness": "spring", "damping": "damper", "mass": "load"}
    start = {names[name]: value for name, value in environment.items()} | {"direction": along, "anchor": at}
    return start | {"position": at, "velocity": push * along, **parameters(model.true_plant)}


def moored_run(model, duration, push=1e-6, **environment):
    """A run from there; ``environment`` as `poles` takes it."""
    model = model.replace(tool_mass=environment.pop("tool_mass", model.tool_mass))
    return diagram(model, moored_start(model, push, **environment)).simulate(duration, progress=False)


def deviation(model, run, signal="position"):
    """A signal of the plant in the direction of the environment, less its value at rest."""
    along = model.frame[:, SIDES.index(model.side)]
    rest = model.path.to_plane(model.eta, model.xi) if signal == "position" else np.zeros(2)
    return (run[f"plant.{signal}"] - rest) @ along


def measured_growth(signal, sample_time, at, span=1.0, window=1.0):
    """Growth rate in 1/s over ``span``, from the energy in two like windows: the same for any phase and frequency."""
    first, shift, length = (round(v / sample_time) for v in (at, span, window))
    weight = np.hanning(length + 2)[1:-1]
    energies = [np.sum(weight * signal[k : k + length] ** 2) for k in (first, first + shift)]
    return 0.5 * np.log(energies[1] / energies[0]) / span


class Pushed:
    """The inputs of a plant with another external force."""

    def __init__(self, u, external_force):
        self.motor_force, self.external_force = u.motor_force, external_force


def moor(plant):
    """A plant of the library on spring, damper and mass in one direction, by its own equations."""

    class MooredPlant(plant):
        direction: Array = parameter(default=(1.0, 0.0), shape=(2,), unit="1")
        anchor: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m")
        spring: float = parameter(default=0.0, unit="N/m", minimum=0.0)
        damper: float = parameter(default=0.0, unit="N.s/m", minimum=0.0)
        load: float = parameter(default=0.0, unit="kg", minimum=0.0)
        contact_force = Output(shape=(2,), unit="N")

        def contact(self, t, x, u):
            """The force of the environment: the acceleration is affine in it, which is solved."""
            d = self.direction
            f = -self.spring * (d @ (x.position - self.anchor)) - self.damper * (d @ x.velocity)
            a0, a1 = (
                d @ plant.derivative(self, t, x, Pushed(u, u.external_force + d * k))[1] for k in (0.0, 1.0)
            )  # the states are position, velocity, …
            return d * ((f - self.load * a0) / (1.0 + self.load * (a1 - a0)))

        def derivative(self, t, x, u):
            return plant.derivative(self, t, x, Pushed(u, u.external_force + self.contact(t, x, u)))

        def output(self, t, x, u):
            force = self.contact(t, x, u)
            found = plant.output(self, t, x, Pushed(u, u.external_force + force))
            found = found if isinstance(found, tuple) else (found,)
            return *found, np.where(t > 0.0, force, 0.0 * force)  # nothing has acted yet at the start

    return MooredPlant
