"""The compliance loop of one direction of Fig. 3 against an environment: its parameters, its diagram and its contact.

Fig. 3 is linear for small motions around rest on, or off, the path. Let p be the displacement in m in the frame of
the path, first along the tangent t, then along the normal n. Then η = p∥/q and ξ = p⊥ with q = 1 − κ ξ₁ (E22), or
w = Q⁻¹ p, Q = diag(q, 1). With E = [t n] and the model (2) of the plant, the mobility is G = Eᵀ G_v E, the inertia
M = G⁻¹, and the slope of the friction C = −M Eᵀ (∂f_v/∂x_v) E. At rest C contains the slope F_c/w of the Coulomb
friction. The controller inverts its own model M̂, Ĉ, with the gains (a₂, a₁, a₀) of the error dynamics and (m, d, k) of
the admittance in its direction:

    M p̈ = u − C ṗ + F                                                                  robot
    m ë = F_meas − d ė − k e                                                           admittance (15)
    v = φ ë − a₂ (ẇ − ė) − a₁ (w − e) − a₀ ∫(w − e) dt                                 error dynamics (12)
    u = M̂ Q v + Ĉ ṗ − β F_meas                                                         linearization (10)

u is the motor force and F any other force; M contains the mass of a tool beyond the sensor. φ = 1 feeds the
acceleration forward by its point value, φ = 0 does not; β = 1 cancels the measured force. There are three
implementations:

``ideal``
    The inner loop is perfect, w = e: (m + q (m_e + m_tool)) ë + (d + q b_e) ė + (k + q k_e) e = 0.
``continuous``
    The equations above. F_meas contains p̈ and p̈ contains F_meas: this algebraic loop is solved as if nothing took
    time, so that the model hides the limits on the masses.
``sampled``
    The plant with its environment runs in continuous time under a held motor force, by the matrix exponential. p̈ in
    F_meas is that at the end of the last step, under the last motor force. The controller computes once a tick what
    its blocks compute: the admittance by the discretization of `AdmittanceFilter`, the integral by Euler's method. u
    acts ``delay`` samples later.

`AdmittanceLoop.contact` is the contact of a diagram: Fig. 3 around robots with these M, C and M̂, Ĉ, at a point with
the same q of a path whose frame is the axes, a line or a circle. One direction is decoupled where M, C, M̂ and Ĉ are
diagonal in the frame of the path, such as at rest on a path along an axis. Elsewhere unequal axes couple the two
directions: the contact then has both, and the environment acts in one.

The loop is exact for small motions if no static force acts or the path is straight. On a curved path the frame turns
under a static force F₀: for each metre along it F∥ changes by κ F₀⊥ and F⊥ by −κ F₀∥. The loop leaves this out, and the
limits of an `AdmittanceFilter`, which small motions don't reach.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Self, cast

import numpy as np

from ...blocks import (
    AdmittanceFilter,
    Circle,
    Constant,
    ErrorDynamics,
    FeedbackLinearization,
    ForceSensor,
    Gain,
    Line,
    Path,
    PlanarModel,
    Reference,
)
from ...blocks.core import (
    Array,
    Block,
    Finding,
    Input,
    Output,
    ParameterError,
    State,
    UnknownNameError,
    Value,
    kinds,
    parameter,
)
from ...blocks.path_following import A_MODEL, A_PATH, planar_slopes
from ...blocks.paths import Frame
from ...blocks.tracing import METHOD
from ..contact import SIDES, Contact, PortNames, Tool, make_contact
from ..diagram import Diagram
from ..flat import WiredDiagram
from ..results import OperatingPoint
from ..wiring import Wire
from .fig3_parts import check_wires, delay_of, find_kinks, plant_path
from .fig3_wires import Channel, Rig, wire
from .restricted_contact import restrict
from .shown_plant import check_plant

IMPLEMENTATIONS = ("ideal", "continuous", "sampled")
_ADMITTANCE = kinds.one_of_class(AdmittanceFilter, "an AdmittanceFilter(…)").worded(step="Give one.")
_PID = kinds.one_of_class(ErrorDynamics, "an ErrorDynamics(…)").worded(step="Give one.")
LINEARIZATION = "controller.feedback_linearization"
HALF = 1.0
"""Half the length in m of a line in whose middle the robot rests."""
_DECOUPLED = 1e-12
"""Size off the diagonal, relative to it, that a rounded tangent leaves."""


class Motion(NamedTuple):
    """Inertia M in kg and friction slope C in N s/m, in the frame of the path."""

    mass: np.ndarray
    damping: np.ndarray


class AdmittanceLoop(Value):
    """One direction of Fig. 3's compliance loop at rest, as its environment feels it; this module has its equations.

    Raises
    ------
    ParameterError
        If a side, implementation or method is unknown, the path has no coordinates at the offset, or a plant or model
        is not Cartesian: its output is not its position, or it changes with the position.
    """

    path: Path = parameter(kw_only=False, description="the path", kind=A_PATH)
    model: PlanarModel = parameter(
        kw_only=False, description="model that the feedback linearization inverts: M̂, Ĉ", kind=A_MODEL
    )
    plant: PlanarModel | None = parameter(
        default=None, description="true robot: M, C; None for the model itself", kind=A_MODEL
    )
    admittance_par: AdmittanceFilter = parameter(description="admittance along the path", kind=_ADMITTANCE)
    admittance_perp: AdmittanceFilter = parameter(description="admittance across the path", kind=_ADMITTANCE)
    pid_par: ErrorDynamics = parameter(description="error dynamics along the path", kind=_PID)
    pid_perp: ErrorDynamics = parameter(description="error dynamics across the path", kind=_PID)
    side: str = parameter(
        default="perp", description="direction of the environment, par or perp", kind=kinds.choice(*SIDES)
    )
    eta: float = parameter(default=0.0, unit="m", description="arc length η₁ of the point on the path")
    xi: float = parameter(default=0.0, unit="m", description="offset ξ₁ of the point from the path")
    velocity: Array = parameter(
        default=(0.0, 0.0),
        shape=(2,),
        unit="m/s",
        description="velocity at which the friction's slope is taken; zero unless the path is straight",
    )
    implementation: str = parameter(
        default="sampled", description="ideal, continuous or sampled", kind=kinds.choice(*IMPLEMENTATIONS)
    )
    sample_time: float = parameter(default=1e-3, unit="s", above=0.0, description="sample time T")
    delay: int = parameter(default=0, minimum=0, maximum=100, description="samples of computational delay")
    method: str = parameter(default="exact", description="discretization of the admittance", kind=METHOD)
    feed_forward: float = parameter(default=1.0, unit="1", description="share φ of ë that is fed forward")
    cancelled: float = parameter(default=1.0, unit="1", description="share β of the measured force that is cancelled")
    tool_mass: float = parameter(default=0.0, unit="kg", minimum=0.0, description="mass beyond the force sensor, of M")
    findings: tuple[Finding, ...] = parameter(default=(), description="kinks and stairs that limit its numbers")

    @classmethod
    def of(cls, diagram: Diagram, side: str = "perp", *, point: OperatingPoint | None = None, **changes: Any) -> Self:
        """Return the loop of a diagram that `fig3` has made, with the diagram's parameters.

        The linear model of the diagram's own plant, at the point and velocity of the loop, is compared with M and C. A
        plant that disagrees is refused.

        Parameters
        ----------
        diagram : Diagram
            A diagram of Fig. 3 with an admittance in both directions.
        side : str, optional
            ``"par"`` or ``"perp"``.
        point : OperatingPoint, optional
            Instant of the diagram that gives the plant's states other than position and velocity, such as contact; the
            start without it.
        **changes
            Parameters that the diagram does not hold, or other values: ``eta`` and ``xi`` of the point on the path,
            ``plant`` for the true robot where the controller inverts another model.

        Raises
        ------
        UnknownNameError
            If a block of Fig. 3 is missing.
        ParameterError
            If the loop contains more than Fig. 3 (an encoder, a filter), or if the plant has no linear model, hidden
            states, a stiffness, or another mass or friction slope than the model. ``AdmittanceLoop(path, model, …)``
            makes a loop of parameters without a diagram.
        """
        wired = diagram.wired
        names = (*(f"{kind}_{s}" for kind in ("admittance", "pid") for s in SIDES),)
        linearization = cast(FeedbackLinearization, diagram["controller.feedback_linearization"])
        sensor, controller = cast(ForceSensor, diagram["sensors.force_sensor"]), diagram.subsystems["controller"]
        found: dict[str, Any] = {name: diagram[f"controller.{name}"] for name in names}
        if controller.sample_time is None:
            raise UnknownNameError(
                "found no sample time; expected that of Fig. 3. Make the diagram with fig3().", block="controller"
            )
        found |= {
            "path": linearization.path,
            "model": linearization.model,
            "sample_time": float(controller.sample_time),
            "method": controller.method,
            "delay": delay_of(wired),
            "tool_mass": sensor.tool_mass,
        }
        check_wires(wired)
        loop = cls(**{**found, "findings": find_kinks(wired, point), "side": side, **changes})
        check_plant(
            wired,
            plant_path(wired),
            loop.true_plant,
            rate=loop.rate,
            frame=loop.frame,
            position=loop.path.to_plane(loop.eta, loop.xi),
            velocity=loop.velocity,
            point=point,
        )
        return loop

    def check(self) -> None:
        """Refuse parameters that don't make a loop."""
        left, right = self.path.reach(self.path.parameter_at(self.eta))
        if not -float(right) < self.xi < float(left) or self.q <= 0.0:
            raise ParameterError(
                f"found {self.xi:g} m; expected an offset within the reach of the path there, from {-float(right):.6g} "
                f"to {float(left):.6g} m. Choose one nearer to the path.",
                block=type(self).__name__,
                port="xi",
            )
        if np.any(self.velocity) and float(self._path_frame.curvature) != 0.0:
            raise ParameterError(
                f"found {self.velocity.tolist()} m/s where the path is curved; expected zero: the model is one at "
                "rest. Choose a straight path, or linearize the diagram along a run.",
                block=type(self).__name__,
                port="velocity",
            )
        _ = self.motions

    @property
    def _path_frame(self) -> Frame:
        return self.path.frame(self.path.parameter_at(self.eta))

    @property
    def true_plant(self) -> PlanarModel:
        """The true robot: ``plant``, or the model where none is given."""
        return self.model if self.plant is None else self.plant

    @property
    def filters(self) -> dict[str, AdmittanceFilter]:
        """The admittances of both directions, by side."""
        return {"par": self.admittance_par, "perp": self.admittance_perp}

    @property
    def pids(self) -> dict[str, ErrorDynamics]:
        """The error dynamics of both directions, by side."""
        return {"par": self.pid_par, "perp": self.pid_perp}

    @property
    def admittance(self) -> AdmittanceFilter:
        """The admittance in the direction of the environment."""
        return self.filters[self.side]

    @property
    def pid(self) -> ErrorDynamics:
        """The error dynamics in the direction of the environment."""
        return self.pids[self.side]

    @property
    def q(self) -> float:
        """1 − κ ξ₁."""
        return 1.0 - float(self._path_frame.curvature) * self.xi

    @property
    def scale(self) -> float:
        """Metres of motion per unit of the coordinate: q along the path, 1 across it (E22)."""
        return self.q if self.side == "par" else 1.0

    @property
    def rate(self) -> float:
        """Rate of the slower error dynamics in 1/s, the measure for errors of a slope."""
        return min(control_rate(pid) for pid in self.pids.values())

    @property
    def label(self) -> str:
        """Name for messages."""
        return type(self).__name__

    @property
    def frame(self) -> np.ndarray:
        """Frame E = [t n] at the point on the path."""
        return np.stack([self._path_frame.tangent, self._path_frame.normal], axis=-1)

    @cached_property
    def both_motions(self) -> tuple[Motion, Motion]:
        """Inertia and friction slope of the plant and of the model, in both directions."""
        return _reduce_to_motion(self, self.true_plant), _reduce_to_motion(self, self.model)

    @cached_property
    def motions(self) -> tuple[Motion, Motion]:
        """Inertia and friction slope of the plant and of the model; of one direction if it is decoupled."""
        both = self.both_motions
        diagonal = all(abs(X[0, 1]) + abs(X[1, 0]) <= _DECOUPLED * np.abs(X).max() for m in both for X in m)
        if diagonal or self.implementation == "ideal":
            i = SIDES.index(self.side)
            plant, model = (Motion(*(X[i : i + 1, i : i + 1] for X in m)) for m in both)
            return plant, model
        return both

    @property
    def directions(self) -> tuple[str, ...]:
        """The directions in the model: one, or both if they are coupled."""
        return (self.side,) if len(self.motions[0].mass) == 1 else SIDES

    @cached_property
    def contact(self) -> Contact:
        """The contact of the environment with Fig. 3, with these parameters."""
        return _contact_of(self)


def control_rate(pid: ErrorDynamics) -> float:
    """Return the rate of an error dynamics in 1/s: the largest of a₂, √a₁ and ∛a₀."""
    return float(max(abs(pid.a2), np.sqrt(abs(pid.a1)), np.cbrt(abs(pid.a0))))


def _reduce_to_motion(loop: AdmittanceLoop, model: PlanarModel) -> Motion:
    """Return M and C in the frame of the path; refuse a model that is not Cartesian."""
    E = loop.frame
    made = planar_slopes(model, loop.path.to_plane(loop.eta, loop.xi), loop.velocity)
    if type(model).h is not PlanarModel.h or np.any(made.by_position):
        raise ParameterError(
            f"found {type(model).__name__}, which is not Cartesian; expected a model whose output is its position and "
            "whose f_v and G_v don't depend on it, such as gantry.nominal. Linearize the diagram instead.",
            block=type(loop).__name__,
            port="model",
        )
    M = np.linalg.inv(E.T @ made.G_v @ E)
    return Motion(M, -M @ E.T @ made.slope @ E)


# ---- the diagram and its contact ----


def _contact_of(loop: AdmittanceLoop) -> Contact:
    """Return the contact of a loop, in its own direction where that is decoupled, else in both."""
    if loop.implementation == "ideal":
        made = make_contact(_perfect_diagram(loop), PortNames("plant.external_force", force=None), [1.0], None, {})
        # the force moves it as its sensor feels it, so that another tool is another mass
        sensed = made.parts.controller._replace(D=np.eye(1))
        parts, direction = replace(made.parts, controller=sensed, force=0.0 * made.parts.force), made.direction
    else:
        axis = np.eye(2)[SIDES.index(loop.side)]
        made = make_contact(_diagram_at_rest(loop), PortNames("plant.external_force"), axis, None, {})
        axes = np.array([SIDES.index(side) for side in loop.directions])
        parts, direction = restrict(replace(made.parts, is_stepped=True), axes), axis[axes]
    parts = replace(parts, tool=Tool(parts.tool.sensor, loop.tool_mass), findings=loop.findings)
    return replace(made, parts=parts, direction=direction, side=loop.side, filter=loop.admittance, scale=loop.scale)


def _perfect_diagram(loop: AdmittanceLoop) -> WiredDiagram:
    a, q = loop.admittance, loop.scale
    mass, damping, stiffness = a.mass / q + loop.tool_mass, float(a.effective_damping) / q, a.stiffness / q
    plant = PerfectRobot(mass=mass, damping=damping, stiffness=stiffness, name="plant")
    return Diagram("compliance", plant(external_force=Constant(value=0.0, unit="N", name="free_space"))).wired


def _diagram_at_rest(loop: AdmittanceLoop) -> WiredDiagram:
    """Return Fig. 3 with the parameters of a loop, around robots that are linear at rest."""
    path, place = _path_like(loop)
    robot, model = (_robot_of(motion, path, place) for motion in loop.both_motions)
    plant: Any = robot.replace(name="plant")
    references = (Reference(v, unit="m", name=f"{n}_d") for v, n in zip(place, ("eta", "xi"), strict=True))
    channels = [Channel(r, _unlimited(loop.filters[side])) for r, side in zip(references, SIDES, strict=True)]
    rig = Rig(tool_mass=loop.tool_mass, sample_time=loop.sample_time, admittance_method=loop.method)
    # the acceleration is that under the new motor force here, so that it is one with the measured force
    made = Diagram("compliance", wire(plant, path, *channels, model=model, rig=rig), loops="solve").wired
    changes: dict[str, Any] = {
        f"controller.pid_{side}": pid.replace(name=f"pid_{side}") for side, pid in loop.pids.items()
    }
    changes[f"{LINEARIZATION}.minimum_determinant"] = 0.0
    is_sampled = loop.implementation == "sampled"
    made = made.replace({**changes, "controller.delay": loop.delay if is_sampled else 0})
    made = made if is_sampled else made.continuous()
    if loop.cancelled != 1.0:
        made = _with_gain(made, LINEARIZATION, "force", loop.cancelled)
    if loop.feed_forward != 1.0:
        for side in SIDES:
            made = _with_gain(made, f"controller.pid_{side}", "reference", np.diag([1.0, 1.0, loop.feed_forward]))
    return made


def _path_like(loop: AdmittanceLoop) -> tuple[Path, tuple[float, float]]:
    """Return a path whose frame is the axes at a point with the q of a loop, and η and ξ of that point."""
    if loop.q == 1.0:
        return Line(start=(-HALF, 0.0), end=(HALF, 0.0)), (HALF, 0.0)
    circle = Circle(radius=1.0, center=(0.0, 1.0))  # the frame is that of the axes three quarters around
    return circle, (0.75 * circle.length, 1.0 - loop.q)


def _robot_of(motion: Motion, path: Path, place: tuple[float, float]) -> RobotAtRest:
    mobility = np.linalg.inv(motion.mass)
    return RobotAtRest(mobility=mobility, slope=-mobility @ motion.damping, start=path.to_plane(*place))


def _unlimited(admittance: AdmittanceFilter) -> AdmittanceFilter:
    return admittance.replace(velocity_limit=None, acceleration_limit=None)


def _with_gain(diagram: WiredDiagram, block: str, port: str, gain: Any) -> WiredDiagram:
    """Return a diagram with a gain on the wire to an input."""
    table, name = diagram.structure.copy(), f"{port}_share_of_{block.rpartition('.')[2]}"
    subsystem = table.subsystem_of[block]
    path = f"{subsystem}.{name}"
    table.blocks[path], table.subsystem_of[path] = Gain(gain=gain, name=name), subsystem
    table.wires[path, "u"], table.wires[block, port] = table.wires[block, port], Wire(path, "y")
    return diagram.with_structure(table)


class RobotAtRest(PlanarModel):
    """A robot that is linear around rest: p̈ = S ṗ + G (u + F)."""

    mobility: Array = parameter(shape=(2, 2), unit="1/kg", description="mobility G = M⁻¹")
    slope: Array = parameter(shape=(2, 2), unit="1/s", description="slope S = −G C of its friction")
    start: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m", description="position at the start")

    motor_force = Input(shape=(2,), unit="N", description="motor force u")
    external_force = Input(shape=(2,), unit="N", description="force F of the environment")
    position = State(unit="m", shape=(2,), start="start", description="position p", output=True)
    velocity = State(unit="m/s", start=(0.0, 0.0), description="velocity ṗ", output=True)
    acceleration = Output(shape=(2,), unit="m/s2", description="acceleration p̈")

    def f_v(self, x_c: Array, x_v: Array) -> Array:
        """Return S ṗ."""
        return self.slope @ x_v

    def G_v(self, x_c: Array) -> Array:  # noqa: N802 - the paper's symbol
        """Return G."""
        return self.mobility

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return velocity and acceleration."""
        return x.velocity, self.output(t, x, u)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the acceleration."""
        return self.coordinate_acceleration(x.position, x.velocity, u.motor_force, u.external_force)


class PerfectRobot(Block):
    """A robot whose inner loop is perfect, in one direction: (m/q + m_tool) p̈ = F − d/q ṗ − k/q p."""

    mass: float = parameter(unit="kg", above=0.0, description="m/q, and the mass of the tool")
    damping: float = parameter(unit="N.s/m", description="d/q")
    stiffness: float = parameter(unit="N/m", description="k/q")

    external_force = Input(unit="N", description="force F of the environment")
    position = State(unit="m", start=0.0, description="position p", output=True)
    velocity = State(unit="m/s", start=0.0, description="velocity ṗ", output=True)

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return velocity and acceleration."""
        force = u.external_force - self.damping * x.velocity - self.stiffness * x.position
        return x.velocity, force / self.mass
