"""Direct-current motor with permanent magnets, driven by a voltage against a load.

    L i̇ = u − R i − K ω
    J ω̇ = K i − b ω − τ_L
    φ̇ = ω

Rotor and load are one inertia, J.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...blocks.core import Array, Block, Input, Output, State, parameter
from ..export import build as _build

__all__ = ["DcMotor", "build", "nominal"]


class DcMotor(Block):
    """Direct-current motor with permanent magnets, driven by a voltage against a load."""

    resistance: float = parameter(default=1.2, unit="Ohm", above=0.0, description="resistance R of the armature")
    inductance: float = parameter(default=2e-3, unit="H", above=0.0, description="inductance L of the armature")
    motor_constant: float = parameter(
        default=0.05, unit="N.m/A", above=0.0, description="K: torque per current, and voltage per speed"
    )
    inertia: float = parameter(default=2e-5, unit="kg.m2", above=0.0, description="inertia J of rotor and load")
    friction: float = parameter(default=1e-5, unit="N.m.s/rad", minimum=0.0, description="viscous friction b")

    voltage = Input(unit="V", description="voltage u on the armature")
    load_torque = Input(unit="N.m", description="torque τ_L of the load, against the rotation")
    current = State(unit="A", description="current i in the armature", output=True)
    speed = State(unit="rad/s", description="speed ω of the rotor", output=True)
    angle = State(unit="rad", description="angle φ of the rotor", output=True)
    torque = Output(unit="N.m", description="torque K i of the motor")

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return the rates of current, speed and angle."""
        induced = self.motor_constant * x.speed
        accelerating = self.motor_constant * x.current - self.friction * x.speed - u.load_torque
        return (
            (u.voltage - self.resistance * x.current - induced) / self.inductance,
            accelerating / self.inertia,
            x.speed,
        )

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the motor's torque."""
        return self.motor_constant * x.current


nominal = DcMotor()
"""A motor of some 100 W: 1.7 ms electrical, 9.6 ms mechanical time constant (our choice)."""


def build(
    model: DcMotor = nominal,
    out: Path | str | None = None,
    *,
    name: str = "dc_motor",
    internal_step: float = 1e-4,
    **options: Any,
) -> Path:
    """Export it as an FMU, ``dc_motor.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, stop_time=0.2, **options)
