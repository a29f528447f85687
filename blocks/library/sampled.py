"""Blocks of sampled subsystems: unit delay, hold, encoder, force sensor."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

from ..core import Array, Block, Input, Output, State, parameter
from .remembered_inputs import StartsAtInput


class UnitDelay(StartsAtInput, Block):
    """Delay by one sample: y[k] = u[k − 1].

    The first output is ``initial_value``; without it, the input just before t = 0. That is u[0], which then acts in
    both of the first two ticks, unless a source jumps at t = 0: then it is the value before the jump.

    Raises
    ------
    ShapeError
        For an ``initial_value`` of another shape than the input's, when the diagram is built; a number fits any.
    """

    initial_value: Array | None = parameter(default=None, description="first output; None: u just before t = 0")
    u = Input(shape=None, description="signal to delay, of any shape")
    y = Output(like="u", description="the input one tick ago")
    last = State(start="initial_value", like="u", description="the last input")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the last input."""
        return x.last

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the input."""
        return u.u


class Hold(Block):
    """Zero-order hold: y = u at the ticks of its subsystem, held in between.

    It brings a signal to the rate of its subsystem, and shows that in the drawing.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    """

    u = Input(shape=None, description="signal to sample, of any shape")
    y = Output(like="u", description="the input at the last tick")

    def output(self, t: Array, x: Any, u: Any, T: Array) -> Array:
        """Return the input."""
        return u.u


class Encoder(Block):
    """Position encoder: quantized positions, velocities by differences.

    p = Δ ⌊position / Δ + ½⌋, v = (p[k] − p[k − 1]) / T; at the first tick v is the true velocity. An operating point at
    the start is past that tick: p[k − 1] = p[k] − T v. Linear models have the mean slopes of the stairs, 1 and, from
    one tick to the next, 1/T, which hold for motions of many quanta. The block is part of the rig
    (docs/reference/experiments.md), not of the paper.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    """

    quanta = MappingProxyType({"position": "quantum"})
    quantum: float = parameter(above=0.0, description="smallest step Δ, in the position's unit")
    position = Input(shape=None, description="true position")
    velocity = Input(shape=None, description="true velocity, used at the first tick only", at_start_only=True)
    measured_position = Output(like="position", description="p, whole quanta")
    measured_velocity = Output(like="velocity", description="v, whole quanta per tick")
    last = State(like="position", description="last measured position")
    running = State(description="0 before the first tick, then 1")

    def output(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return the measured position and velocity."""
        p = self.quantum * np.floor(u.position / self.quantum + 0.5)
        return p, np.where(x.running > 0.5, (p - x.last) / T, u.velocity)

    def update(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Keep the measured position."""
        return self.quantum * np.floor(u.position / self.quantum + 0.5), 1.0 + 0.0 * t

    def after_start(self, x: Any, u: Any, T: float) -> tuple[Array, Array]:
        """Return the states as after the first tick: with them the measured velocity is the true one."""
        p = self.quantum * np.floor(u.position / self.quantum + 0.5)
        return np.where(x.running > 0.5, x.last, p - T * u.velocity), np.ones(())


class ForceSensor(Block):
    """Force sensor between the robot and its tool, which also measures the tool's inertia (E25).

    F = force + contact force − m_tool · acceleration; the gravity part is tared. At t = 0 the acceleration counts as
    zero in a run, since no force has acted yet; linear models at t = 0 have the tool's inertia.
    """

    tool_mass: float = parameter(default=0.0, unit="kg", minimum=0.0, description="mass on the far side of the sensor")
    force = Input(shape=(2,), unit="N", description="external force on the robot")
    acceleration = Input(shape=(2,), unit="m/s2", description="acceleration at the end of the last step")
    contact_force = Input(shape=(2,), unit="N", default=(0.0, 0.0), description="force of a contact inside the plant")
    measured = Output(shape=(2,), unit="N", description="measured force F")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the measured force."""
        return u.force + u.contact_force - self.tool_mass * np.where(t > 0.0, u.acceleration, 0.0)

    def after_start(self, x: Any, u: Any, T: float | None) -> tuple[()]:
        """Return no states: the branch of the start is ``t > 0``."""
        return ()
