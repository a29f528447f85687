"""Robots that are linear around rest, which stand for the plant and the model of a compliance loop."""

from __future__ import annotations

from typing import Any

from ...blocks import PlanarModel
from ...blocks.core import Array, Block, Input, Output, State, parameter


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
