"""The compliance loop of one direction against an environment, reduced to a linear model.

At rest on (or beside) the path, Fig. 3 is linear for small motions, and what an environment feels is this. Let p be the
displacement in m along the frame of the path, first the tangent t, then the normal n; then η = p∥/q and ξ = p⊥ with
q = 1 − κ ξ₁ (E22), or w = Q⁻¹ p, Q = diag(q, 1). With E = [t n] and the model (2) of the plant, the mobility is
G = Eᵀ G_v E, the inertia M = G⁻¹, and the slope of its friction C = −M Eᵀ (∂f_v/∂x_v) E, which at rest holds the slope
F_c/w of the Coulomb friction. Robot and environment are one continuous system:

    (M + m_e) p̈ = u − (C + b_e) ṗ − k_e p + F                                          plant
    F_meas = F − k_e p − b_e ṗ − (m_e + m_tool) p̈                                      force sensor

u is the motor force, F what else pushes, and a tool beyond the sensor is a part of M. The controller inverts its own
model M̂, Ĉ, with the gains (a₂, a₁, a₀) of the error dynamics and (m, d, k) of the admittance in its direction:

    m ë = F_meas − d ė − k e                                                           admittance (15)
    v = φ ë − a₂ (ẇ − ė) − a₁ (w − e) − a₀ ∫(w − e) dt                                 error dynamics (12)
    u = M̂ Q v + Ĉ ṗ − β F_meas                                                         linearization (10)

φ = 1 is the acceleration feed-forward by its point value, φ = 0 none; β = 1 cancels the measured force. Three
implementations are told apart:

``ideal``
    The inner loop is perfect, w = e: (m + q (m_e + m_tool)) ë + (d + q b_e) ė + (k + q k_e) e = 0.
``continuous``
    The equations as they stand. F_meas contains p̈ and p̈ contains F_meas: solved, as if nothing took time, so that this
    model hides the limits on the masses.
``sampled``
    The plant with its environment in continuous time under a held motor force, by the matrix exponential; p̈ in F_meas
    is that at the end of the last step, under the last motor force. The controller is what the blocks compute in a
    tick: the admittance by the discretization of `AdmittanceFilter`, the integral by Euler, and ``delay`` samples
    before u acts.

Where M, C, M̂ and Ĉ are diagonal in the frame of the path, at rest on a path along an axis, say, one direction stands
alone. Elsewhere unequal axes couple the two; both are then in the model, and the environment acts in one.

The reduction is exact for small motions where no static force acts, or the path is straight. On a curved path the frame
turns under a static force F₀: for each metre along it F∥ changes by κ F₀⊥ and F⊥ by −κ F₀∥, which is not modelled. Nor
are the limits of an `AdmittanceFilter`, which small motions don't reach.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple, Self, cast

import numpy as np

from ...blocks import AdmittanceFilter, ErrorDynamics, Path, PlanarModel
from ...blocks.core.errors import ParameterError, UnknownNameError
from ...blocks.core.values import Array, Value, parameter
from ...blocks.path_following.transverse import expect_model, expect_path
from ...blocks.tracing.discretization import check_method
from ..flat.wired_diagram import WiredDiagram
from ..results.operating_point import OperatingPoint
from .fig3_parts import check_wires, delay_of, plant_path
from .planar import slopes
from .shown_plant import show_plant

SIDES = ("par", "perp")
IMPLEMENTATIONS = ("ideal", "continuous", "sampled")
_DECOUPLED = 1e-12  # off the diagonal, relative to it: what a rounded tangent leaves


class Linear(NamedTuple):
    """State-space matrices; leading axes are those of a batch."""

    A: Array
    B: Array
    C: Array
    D: Array


class Motion(NamedTuple):
    """Inertia M in kg and friction slope C in N s/m, in the frame of the path."""

    mass: Array
    damping: Array


class AdmittanceLoop(Value):
    """One direction of Fig. 3's compliance loop at rest, as its environment feels it; the module derives it.

    Raises
    ------
    ParameterError
        A side, implementation or method that isn't one, an offset at which the path has no coordinates, or a plant or
        model that is not Cartesian: its output is not its position, or it changes with the position.
    """

    path: Path = parameter(kw_only=False, description="the path")
    model: PlanarModel = parameter(kw_only=False, description="what the feedback linearization inverts: M̂, Ĉ")
    plant: PlanarModel | None = parameter(default=None, description="the robot as it is: M, C; None: the model itself")
    admittance_par: AdmittanceFilter = parameter(description="admittance along the path")
    admittance_perp: AdmittanceFilter = parameter(description="admittance across the path")
    pid_par: ErrorDynamics = parameter(description="error dynamics along the path")
    pid_perp: ErrorDynamics = parameter(description="error dynamics across the path")
    side: str = parameter(default="perp", description="direction of the environment, par or perp")
    eta: float = parameter(default=0.0, unit="m", description="arc length η₁ of the point on the path")
    xi: float = parameter(default=0.0, unit="m", description="offset ξ₁ from the path")
    velocity: Array = parameter(
        default=(0.0, 0.0),
        shape=(2,),
        unit="m/s",
        description="velocity at which the friction's slope is taken; other than zero only along a straight path",
    )
    implementation: str = parameter(default="sampled", description="ideal, continuous or sampled")
    sample_time: float = parameter(default=1e-3, unit="s", above=0.0, description="sample time T")
    delay: int = parameter(default=0, minimum=0, maximum=100, description="samples of computational delay")
    method: str = parameter(default="exact", description="discretization of the admittance")
    feed_forward: float = parameter(default=1.0, unit="1", description="share φ of ë that is fed forward")
    cancelled: float = parameter(default=1.0, unit="1", description="share β of the measured force that is cancelled")
    tool_mass: float = parameter(default=0.0, unit="kg", minimum=0.0, description="mass beyond the force sensor, of M")

    @classmethod
    def of(
        cls, diagram: WiredDiagram, side: str = "perp", *, point: OperatingPoint | None = None, **changes: Any
    ) -> Self:
        """Return the loop of a diagram that `fig3` made, with its parameters.

        The diagram's plant is compared with the reduced model: its own linear model, at the point and velocity of the
        loop, with M and C. A plant that is not shown to be the reduced model has no such loop.

        Parameters
        ----------
        diagram : Diagram
            A diagram of Fig. 3 with an admittance in both directions.
        side : str, optional
            ``"par"`` or ``"perp"``.
        point : OperatingPoint, optional
            An instant of the diagram. From it come the states of the plant that its position doesn't tell, such as
            contact; without it they are those of the start.
        **changes
            Parameters that the diagram does not hold (``eta``, ``xi``; ``plant``, a model with which the diagram's
            plant agrees, where the controller inverts another one), or that are to differ.

        Raises
        ------
        UnknownNameError
            If a block of Fig. 3 is missing.
        ParameterError
            If there is more in the loop than in Fig. 3 (an encoder, a filter), or if the plant has no linear model,
            hidden states, a stiffness, or another mass or friction slope than the model. A loop of parameters that no
            diagram holds is made by hand: ``AdmittanceLoop(path, model, …)``.
        """
        names = (*(f"{kind}_{s}" for kind in ("admittance", "pid") for s in SIDES),)
        linearization, frame = diagram["controller.feedback_linearization"], diagram.frames["controller"]
        found: dict[str, Any] = {name: diagram[f"controller.{name}"] for name in names}
        if frame.sample_time is None:
            raise UnknownNameError(
                "its controller has no sample time; make the diagram with fig3().", block="controller"
            )
        found |= {
            "path": linearization.path,
            "model": linearization.model,
            "sample_time": float(frame.sample_time),
            "method": frame.method,
            "delay": delay_of(diagram),
            "tool_mass": diagram["sensors.force_sensor"].tool_mass,
        }
        check_wires(diagram)
        loop = cls(**{**found, "side": side, **changes})
        show_plant(
            diagram,
            plant_path(diagram),
            loop.true_plant,
            rate=loop.rate,
            frame=loop.frame,
            position=loop.path.to_plane(loop.eta, loop.xi),
            velocity=loop.velocity,
            point=point,
        )
        return loop

    def check(self) -> None:
        """Refuse what can't be reduced."""
        who = type(self).__name__
        expect_path(cast(Any, self))
        kinds: dict[str, Any] = {"par": self.admittance_par, "perp": self.admittance_perp}
        for side, block in kinds.items():
            if not isinstance(block, AdmittanceFilter):
                raise _wrong(f"admittance_{side}", block, "an AdmittanceFilter(…)")
        for side, pid in {"par": self.pid_par, "perp": self.pid_perp}.items():
            if not isinstance(pid, ErrorDynamics):
                raise _wrong(f"pid_{side}", pid, "an ErrorDynamics(…)")
        if self.side not in SIDES:
            raise _wrong("side", self.side, "'par' or 'perp'")
        if self.implementation not in IMPLEMENTATIONS:
            raise _wrong("implementation", self.implementation, "'ideal', 'continuous' or 'sampled'")
        check_method(self.method)
        left, right = self.path.reach(self.path.parameter_at(self.eta))
        if not -float(right) < self.xi < float(left) or self.q <= 0.0:
            raise ParameterError(
                f"found {self.xi:g} m; expected an offset within the reach of the path there, from {-float(right):.6g} "
                f"to {float(left):.6g} m. Choose one nearer to the path.",
                block=who,
                port="xi",
            )
        if np.any(self.velocity) and float(self._at.curvature) != 0.0:
            raise ParameterError(
                f"found {self.velocity.tolist()} m/s where the path is curved; expected zero there: it is a model "
                "at rest. Choose a straight path, or linearize the diagram along a run.",
                block=who,
                port="velocity",
            )
        for model in (self.model, self.true_plant):
            expect_model(cast(Any, self), model)
        _ = self.motions

    @property
    def _at(self) -> Any:
        return self.path.frame(self.path.parameter_at(self.eta))

    @property
    def true_plant(self) -> PlanarModel:
        """The robot as it is."""
        return self.model if self.plant is None else self.plant

    @property
    def admittance(self) -> AdmittanceFilter:
        """The admittance in the direction of the environment."""
        return self.admittance_par if self.side == "par" else self.admittance_perp

    @property
    def pid(self) -> ErrorDynamics:
        """The error dynamics in the direction of the environment."""
        return self.pid_par if self.side == "par" else self.pid_perp

    @property
    def q(self) -> float:
        """1 − κ ξ₁."""
        return 1.0 - float(self._at.curvature) * self.xi

    @property
    def scale(self) -> float:
        """Metres of motion per unit of the coordinate: q along the path, 1 across it (E22)."""
        return self.q if self.side == "par" else 1.0

    @property
    def rate(self) -> float:
        """Rate of the slower error dynamics in 1/s, beside which an error of a slope is small or not."""
        return min(control_rate(pid) for pid in (self.pid_par, self.pid_perp))

    @property
    def label(self) -> str:
        """Name for messages."""
        return type(self).__name__

    @property
    def frame(self) -> np.ndarray:
        """E = [t n] at the point on the path."""
        return np.stack([self._at.tangent, self._at.normal], axis=-1)

    @cached_property
    def motions(self) -> tuple[Motion, Motion]:
        """Inertia and friction slope of the plant and of the model, of one direction where it stands alone."""
        both = tuple(_motion(self, m) for m in (self.true_plant, self.model))
        diagonal = all(abs(X[0, 1]) + abs(X[1, 0]) <= _DECOUPLED * np.abs(X).max() for m in both for X in m)
        if diagonal or self.implementation == "ideal":
            i = SIDES.index(self.side)
            both = tuple(Motion(*(X[i : i + 1, i : i + 1] for X in m)) for m in both)
        return both[0], both[1]

    @property
    def directions(self) -> tuple[str, ...]:
        """The directions in the model: one, or both where they are coupled."""
        return (self.side,) if len(self.motions[0].mass) == 1 else SIDES

    @property
    def drifting(self) -> int:
        """Number of coupled directions without environment and without stiffness: each has one pole of pure drift."""
        filters = {"par": self.admittance_par, "perp": self.admittance_perp}
        return sum(filters[s].stiffness == 0.0 for s in self.directions if s != self.side)

    def plant_matrices(
        self, stiffness: Array = 0.0, damping: Array = 0.0, mass: Array = 0.0, tool_mass: Array | None = None
    ) -> Linear:
        """Return robot and environment as (p, ṗ) driven by (u, F), with the outputs (p, ṗ, F_meas).

        Each argument may be an array: the matrices then have its axes in front.
        """
        check_environment(stiffness=stiffness, damping=damping, mass=mass, tool_mass=tool_mass)
        n = len(self.directions)
        M, C = self.motions[0]
        there = np.diag([float(s == self.side) for s in self.directions])  # where the environment acts
        tool = self.tool_mass if tool_mass is None else tool_mass
        k, b, m, tool = (
            v[..., None, None] for v in np.broadcast_arrays(*map(_float, (stiffness, damping, mass, tool)))
        )
        eye, zero = np.eye(n), np.zeros((*k.shape[:-2], n, n))
        W = np.linalg.inv(M + m * there)
        on_p, on_v = -W @ (k * there), -W @ (C + b * there)  # p̈ = on_p p + on_v ṗ + W (u + F)
        felt = m * there + tool * eye
        A = _blocks([[zero, zero + eye], [on_p, on_v]])
        B = _blocks([[zero, zero], [W, W]])
        C_ = _blocks([[zero + eye, zero], [zero, zero + eye], [-k * there - felt @ on_p, -b * there - felt @ on_v]])
        D = _blocks([[zero, zero], [zero, zero], [-felt @ W, eye - felt @ W]])
        return Linear(A, B, C_, D)

    @cached_property
    def controller_matrices(self) -> Linear:
        """The controller from (p, ṗ, F_meas) to u: its states are the integrals, e, ė, and what the delay holds."""
        n, T = len(self.directions), self.sample_time
        eye, zero = np.eye(n), np.zeros((n, n))
        Q_inv = np.diag([1.0 / self.q if s == "par" else 1.0 for s in self.directions])
        pids = [getattr(self, f"pid_{s}") for s in self.directions]
        filters = [getattr(self, f"admittance_{s}") for s in self.directions]
        a2, a1, a0 = (np.diag([getattr(pid, a) for pid in pids]) for a in ("a2", "a1", "a0"))
        m_inv, k = np.diag([1.0 / a.mass for a in filters]), np.diag([a.stiffness for a in filters])
        d = np.diag([a.effective_damping for a in filters])
        M, C = self.motions[1]
        MQ = M @ np.linalg.inv(Q_inv)
        phi = self.feed_forward * m_inv
        D = np.hstack([-MQ @ a1 @ Q_inv, -MQ @ a2 @ Q_inv + C, MQ @ phi - self.cancelled * eye])
        C_ = MQ @ np.hstack([-a0, a1 - phi @ k, a2 - phi @ d])
        if self.implementation != "sampled":
            A = np.block([[zero, -eye, zero], [zero, zero, eye], [zero, -m_inv @ k, -m_inv @ d]])
            B = np.block([[Q_inv, zero, zero], [zero, zero, zero], [zero, zero, m_inv]])
            return Linear(A, B, C_, D)
        made = [a.constants(T, self.method) for a in filters]
        step = [[np.diag([c["transition"][i, j] for c in made]) for j in range(2)] for i in range(2)]
        push = [np.diag([c["forcing"][i, 1] for c in made]) @ m_inv for i in range(2)]
        A = np.block([[eye, -T * eye, zero], [zero, *step[0]], [zero, *step[1]]])
        B = np.block([[T * Q_inv, zero, zero], [zero, zero, push[0]], [zero, zero, push[1]]])
        for _ in range(self.delay):  # u waits one more sample
            A = np.block([[A, np.zeros((len(A), n))], [C_, np.zeros((n, n))]])
            B, C_ = np.vstack([B, D]), np.hstack([np.zeros((n, len(A) - n)), eye])
            D = np.zeros((n, 3 * n))
        return Linear(A, B, C_, D)


def control_rate(pid: ErrorDynamics) -> float:
    """Return the rate of an error dynamics in 1/s: the largest of a₂, √a₁ and ∛a₀."""
    return float(max(abs(pid.a2), np.sqrt(abs(pid.a1)), np.cbrt(abs(pid.a0))))


def check_environment(**values: Any) -> None:
    """Refuse an environment that is not one: NaN, infinite or negative."""
    for name, value in values.items():
        if value is not None and not np.all((_float(value) >= 0.0) & np.isfinite(_float(value))):
            raise ParameterError(
                f"found {value!r}; expected finite numbers that are not negative.", block="environment", port=name
            )


def held(plant: Linear, T: float, n: int) -> Linear:
    """Return the plant under a motor force that is held over T, its last value a state: it made the last p̈."""
    from scipy.linalg import expm

    A, B = plant.A, plant.B[..., :n]
    batch, x = A.shape[:-2], A.shape[-1]
    whole = np.zeros((*batch, x + n, x + n))
    whole[..., :x, :x], whole[..., :x, x:] = A, B
    whole = expm(whole * T)
    none = np.zeros((*batch, n, n))
    A = _blocks([[whole[..., :x, :x], np.zeros((*batch, x, n))], [np.zeros((*batch, n, x)), none]])
    B = _blocks([[whole[..., :x, x:]], [none + np.eye(n)]])
    return Linear(A, B, _blocks([[plant.C, plant.D[..., :n]]]), np.zeros((*batch, 3 * n, n)))


def _blocks(rows: list[list[Array]]) -> Array:
    return np.concatenate([np.concatenate(row, axis=-1) for row in rows], axis=-2)


def _float(value: Any) -> np.ndarray:
    return np.asarray(value, dtype=float)


def _wrong(port: str, found: Any, expected: str) -> ParameterError:
    return ParameterError(f"found {found!r}; expected {expected}.", block=AdmittanceLoop.__name__, port=port)


def _motion(loop: AdmittanceLoop, model: PlanarModel) -> Motion:
    """Return M and C in the frame of the path, after refusing a model that is not Cartesian."""
    E = loop.frame
    made = slopes(model, loop.path.to_plane(loop.eta, loop.xi), loop.velocity)
    if type(model).h is not PlanarModel.h or np.any(made.moved):
        raise ParameterError(
            f"found {type(model).__name__}, which is not Cartesian; expected a model whose output is its position, and "
            "whose f_v and G_v don't change with it, such as gantry.nominal. Linearize the diagram instead.",
            block=type(loop).__name__,
            port="model",
        )
    M = np.linalg.inv(E.T @ made.G_v @ E)
    return Motion(M, -M @ E.T @ made.slope @ E)
