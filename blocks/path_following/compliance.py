"""Compliance: the error dynamics of section III-B, and the admittance of section IV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np

from ..core import Array, Block, Event, Input, Output, ParameterError, State, clip, parameter
from ..tracing import find_hold


class ErrorDynamics(Block):
    """PID error dynamics (12): v = r̈ − a₂ ė − a₁ e − a₀ ∫e dt, e = y − r.

    Behind `FeedbackLinearization` it makes e⁽³⁾ + a₂ ë + a₁ ė + a₀ e = 0 (E5). Inputs are the coordinate (y, ẏ) and the
    path reference (r, ṙ, r̈). Anti-windup: the integral holds while ``excess``, the part of the motor force that a
    saturation cut off, is not zero.
    """

    a2: float = parameter(unit="1/s", description="gain of the rate error")
    a1: float = parameter(unit="1/s2", description="gain of the error")
    a0: float = parameter(unit="1/s3", description="gain of the integral")
    coordinate = Input(shape=(2,), unit=("m", "m/s"), description="η or ξ: value and rate")
    reference = Input(shape=(3,), unit=("m", "m/s", "m/s2"), description="path reference: value, rate, acceleration")
    excess = Input(shape=None, default=0.0, description="part that a saturation cut off, of any shape")
    v = Output(unit="m/s2", description="virtual input v∥ or v⊥")
    integral = State(unit="m.s", description="∫e dt")

    @classmethod
    def from_poles(cls, poles: Sequence[complex], *, name: str | None = None) -> Self:
        """Return the error dynamics with three given poles.

        Parameters
        ----------
        poles : sequence of 3 numbers
            Poles in 1/s, real or in conjugate pairs, in the left half plane.
        name : str, optional
            Name of the block.

        Raises
        ------
        ParameterError
            Unless there are three, in the left half plane, complex ones in conjugate pairs.
        """
        try:
            p = np.asarray(poles, dtype=complex)
        except (TypeError, ValueError):
            p = np.zeros(0, dtype=complex)
        coefficients = np.poly(p) if p.shape == (3,) else p
        if (
            p.shape != (3,)
            or np.any(p.real >= 0)
            or np.max(np.abs(np.imag(coefficients))) > 1e-9 * np.abs(p).max() ** 3
        ):
            raise ParameterError(
                f"found {poles!r}; expected three poles in the left half plane, complex ones in conjugate pairs. Give "
                "three, such as [-20, -20, -20].",
                block=name or cls.__name__,
                port="poles",
            )
        _, a2, a1, a0 = np.real(coefficients)
        return cls(a2=a2, a1=a1, a0=a0, name=name)

    @property
    def poles(self) -> np.ndarray:
        """The three poles in 1/s."""
        return np.roots([1.0, self.a2, self.a1, self.a0])

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return v of (12)."""
        e, e_rate = u.coordinate[0] - u.reference[0], u.coordinate[1] - u.reference[1]
        return u.reference[2] - self.a2 * e_rate - self.a1 * e - self.a0 * x.integral

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the error, or zero while the motor force is cut."""
        return np.where(np.sum(np.abs(u.excess)) > 0.0, 0.0, u.coordinate[0] - u.reference[0])


class AdmittanceFilter(Block):
    """Admittance control law (15): the path reference yields to a force like m ë + d ė + k e = F − F^d, (14).

    r̈^p = r̈^d + (F − F^d − d ė − k e)/m, where e = r^p − r^d is the deviation of the path reference from the given
    reference and d = 2 ζ √(m k) (E7). Force tracking (section IV-B) is the case k = 0 with a desired force; then the
    damping must be given (E8). ``offset`` is a set-point without derivatives, measured from the reference; it adds
    k·offset to the force (E27).

    ``velocity_limit`` and ``acceleration_limit`` bound the path reference by conditional integration (end of section
    IV-A). In a tick in which one would be exceeded, the acceleration a of r^p is cut to the admissible value and held
    over the tick; r^p and ṙ^p advance by v T + a T²/2 and a T. The prediction takes ṙ^d + r̈^d T for the rate of the
    reference at the next tick; a reference with a jerk differs from it (by T² times the jerk), and the difference is
    cut from ṙ^p at the next tick. In a continuous subsystem a is cut all the time. The speed limit is an event, and so
    is the acceleration's turn inward, which releases ṙ^p. With a speed limit the state is r^p itself, so it does not
    jump where the reference does.
    """

    mass: float = parameter(unit="kg", above=0.0, description="rendered mass m")
    stiffness: float = parameter(unit="N/m", minimum=0.0, description="rendered stiffness k")
    damping_ratio: float | None = parameter(default=None, minimum=0.0, description="ζ; or give damping")
    damping: float | None = parameter(default=None, unit="N.s/m", minimum=0.0, description="rendered damping d")
    velocity_limit: float | None = parameter(default=None, unit="m/s", above=0.0, description="largest speed of r^p")
    acceleration_limit: float | None = parameter(default=None, unit="m/s2", above=0.0, description="largest |r̈^p|")
    force = Input(unit="N", description="force on the robot in this direction")
    reference = Input(shape=(3,), unit=("m", "m/s", "m/s2"), description="r^d: value, rate, acceleration")
    desired_force = Input(unit="N", default=0.0, description="F^d, subtracted from the force (E16)")
    offset = Input(unit="m", default=0.0, description="set-point without derivatives, relative to the reference")
    path_reference = Output(shape=(3,), unit=("m", "m/s", "m/s2"), description="r^p: value, rate, acceleration")
    transition: ClassVar[Array]  # computed by constants
    forcing: ClassVar[Array]
    error = State(unit="m", description="e")
    error_rate = State(unit="m/s", description="ė")
    limited = State(
        description="1 after a tick in which a limit acted: the states are then r^p and ṙ^p, not e and ė; in a "
        "continuous subsystem 1 with a speed limit, 2 while ṙ^p is held at it",
    )
    reached = Event("rising", "the speed limit is reached; with velocity_limit", only_if="has_speed_limit")
    released = Event("rising", "the acceleration turns inward; with velocity_limit", only_if="has_speed_limit")

    @property
    def has_limits(self) -> bool:
        """Whether the path reference is bounded."""
        return self.velocity_limit is not None or self.acceleration_limit is not None

    @property
    def has_speed_limit(self) -> bool:
        """Whether the speed of the path reference is bounded, by events in a continuous subsystem."""
        return self.velocity_limit is not None

    @property
    def states(self) -> Mapping[str, State]:  # type: ignore[override]
        """``error``, ``error_rate``, and with limits ``limited``, which events change where the speed is limited."""
        cls = type(self)
        free = {"error": cls.error, "error_rate": cls.error_rate}
        if not self.has_limits:
            return free
        about = cls.limited.description
        return {**free, "limited": State(None, about, discrete=self.has_speed_limit, name="limited")}

    @property
    def starts_from_inputs(self) -> bool:
        """Whether the states are r^p and ṙ^p from the start."""
        return self.has_speed_limit

    def initial(self, u: Any) -> tuple[Any, ...]:
        """Return r^p, an admissible ṙ^p, and 1."""
        top: Any = self.velocity_limit
        return u.reference[0], clip(u.reference[1], -top, top), 1.0

    def check(self) -> None:
        """Refuse a damping that is given twice, or not at all."""
        if (self.damping is None) == (self.damping_ratio is None):
            found = "neither damping_ratio nor damping" if self.damping is None else "damping_ratio and damping"
            raise ParameterError(f"found {found}; expected one of them. Give one.", port="damping")
        if self.stiffness == 0 and self.damping is None:
            raise ParameterError(
                f"found stiffness=0 with damping_ratio={self.damping_ratio:g}; 2 ζ √(m k) would be zero. Give "
                "damping=… in N.s/m, such as the value with the former stiffness.",
                port="damping",
            )

    @property
    def effective_damping(self) -> Array:
        """Damping d in N s/m, 2 ζ √(m k) where the ratio is given."""
        if self.damping_ratio is None:
            return self.damping
        return 2.0 * self.damping_ratio * np.sqrt(self.mass * self.stiffness)

    def constants(self, T: float, method: str) -> dict[str, np.ndarray]:
        """Return transition and forcing of the free filter over one sample."""
        A = [[0.0, 1.0], [-self.stiffness / self.mass, -self.effective_damping / self.mass]]
        transition, forcing = find_hold(A, T, method)
        return {"transition": transition, "forcing": forcing}

    def driving_acceleration(self, u: Any) -> Array:
        """Return the part of ë that the force and the set-point make."""
        return (u.force - u.desired_force + self.stiffness * u.offset) / self.mass

    def acceleration(self, e: Array, e_rate: Array, drive: Array) -> Array:
        """Return ë of (15) while no limit acts."""
        return drive - (self.effective_damping * e_rate + self.stiffness * e) / self.mass

    def deviation(self, x: Any, u: Any, T: Array = None) -> tuple[Array, Array]:
        """Return e and ė at this instant."""
        if not self.has_limits or (T is None and self.velocity_limit is None):
            return x.error, x.error_rate
        after_cut = x.limited > 0.5
        e = np.where(after_cut, x.error - u.reference[0], x.error)
        e_rate = np.where(after_cut, x.error_rate - u.reference[1], x.error_rate)
        if self.velocity_limit is not None:
            v = u.reference[1] + e_rate
            admissible = clip(v, -self.velocity_limit, self.velocity_limit)
            e_rate = np.where(v == admissible, e_rate, admissible - u.reference[1])
        return e, e_rate

    def step(self, x: Any, u: Any, T: Array) -> tuple[tuple[Array, ...], Array]:
        """Return the states at the next tick, and the ë that is held over this tick."""
        e, e_rate = self.deviation(x, u, T)
        drive = self.driving_acceleration(u)
        a = self.acceleration(e, e_rate, drive)
        free = self.transition @ np.stack([e, e_rate]) + self.forcing @ np.stack([0.0 * drive, drive])
        if not self.has_limits:
            return (free[0], free[1]), a
        r_d, v_d, a_d = u.reference[0], u.reference[1], u.reference[2]
        p, v, wanted = r_d + e, v_d + e_rate, a_d + a
        cut, acts = wanted, wanted != wanted
        if self.velocity_limit is not None:
            acts = np.abs(v_d + a_d * T + free[1]) > self.velocity_limit
            cut = clip(cut, (-self.velocity_limit - v) / T, (self.velocity_limit - v) / T)
        if self.acceleration_limit is not None:
            acts = np.logical_or(acts, np.abs(wanted) > self.acceleration_limit)
            cut = clip(cut, -self.acceleration_limit, self.acceleration_limit)
        new = (
            np.where(acts, p + v * T + 0.5 * cut * T**2, free[0]),
            np.where(acts, v + cut * T, free[1]),
            np.where(acts, 1.0, 0.0),
        )
        return new, np.where(acts, cut - a_d, a)

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return r^p with its derivatives."""
        if T is None:
            return u.reference + np.stack([*self.deviation(x, u), self.limited_acceleration(x, u) - u.reference[2]])
        return u.reference + np.stack([*self.deviation(x, u, T), self.step(x, u, T)[1]])

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, ...]:
        """Return ė and ë, or with a speed limit ṙ^p and r̈^p."""
        if not self.has_limits:
            return x.error_rate, self.acceleration(x.error, x.error_rate, self.driving_acceleration(u))
        a = self.limited_acceleration(x, u)
        if self.velocity_limit is None:
            return x.error_rate, a - u.reference[2], 0.0 * t
        return x.error_rate, np.where(x.limited > 0.5, a, a - u.reference[2])

    def wanted_acceleration(self, x: Any, u: Any) -> Array:
        """Return r̈^p of (15), within its limit."""
        e, e_rate = self.deviation(x, u)
        wanted = u.reference[2] + self.acceleration(e, e_rate, self.driving_acceleration(u))
        if self.acceleration_limit is None:
            return wanted
        return clip(wanted, -self.acceleration_limit, self.acceleration_limit)

    def limited_acceleration(self, x: Any, u: Any) -> Array:
        """Return r̈^p in continuous time: zero while ṙ^p is held at its limit."""
        wanted = self.wanted_acceleration(x, u)
        return wanted if self.velocity_limit is None else np.where(x.limited > 1.5, 0.0, wanted)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the excess of ṙ^p over its limit, and r̈^p inward; an event that can't happen now has −1."""
        held, inward = x.limited > 1.5, -np.sign(x.error_rate) * self.wanted_acceleration(x, u)
        top: Any = self.velocity_limit
        beyond = np.abs(x.error_rate) - (1.0 + 1e-12) * top  # the rounding of a speed just released is not beyond
        return np.where(held, -1.0, beyond), np.where(held, inward, -1.0)

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array, Array]:
        """Hold ṙ^p at the limit, or release it."""
        reached, released = fired.reached > 0.5, fired.released > 0.5
        top: Any = self.velocity_limit
        onto = np.where(x.error_rate > 0.0, top, -top)
        held = np.where(reached, 2.0, np.where(released, 1.0, x.limited))
        return x.error, np.where(reached, onto, x.error_rate), held

    def update(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, ...]:
        """Return the states at the next tick."""
        return self.step(x, u, T)[0]
