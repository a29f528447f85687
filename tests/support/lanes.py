"""Diagrams whose runs go side by side in vector lanes."""

import functools

import casadi as ca
import numpy as np

from loopwright.blocks import BandLimitedNoise, Compare, Constant, Gain, Step, StopCondition, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, ModelSpec, Variable, build_fmu
from loopwright.fmus.models import dc_motor, mass_spring_damper, scara

QUIET = {"progress": False}
T, STEP = 0.01, 2.5e-3
"""Sample time of the controllers, and internal step of the lag, in s."""


@functools.lru_cache(maxsize=1)
def lag():
    """An FMU of dx/dt = (gain u − x − bend x²) / lag, x(0) = 0, that puts out x, 2 x + u and x + 1."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p", 3)
    numbers = {"gain": ("tunable", 1.0), "lag": ("tunable", 0.2), "bend": ("fixed", 0.0)}
    return build_fmu(
        ModelSpec(
            name="lag",
            description="A lag",
            inputs=(Variable("u", "input"),),
            outputs=(Variable("mixed", "output"), Variable("shifted", "output")),
            parameters=tuple(Variable(name, "parameter", kind, start=v) for name, (kind, v) in numbers.items()),
            states=(Variable("x", "output", start=0.0, state=True),),
            derivative=ca.Function("f", [t, x, u, p], [(p[0] * u - x - p[2] * x * x) / p[1]]),
            output=ca.Function("g", [t, x, u, p], [ca.vertcat(2.0 * x + u, x + 1.0)]),
            internal_step=STEP,
        )
    )


def loop(*, stops=False, slow=1, more=None, loops="error"):
    """The lag under a proportional controller of reference 1, with a counter at a lower rate."""
    plant = Fmu(lag(), name="plant")

    @subsystem(sample_time=T, name="box")
    def box(x, reference):
        u = Gain(gain=2.0, name="kp")(reference - x)
        if stops:
            StopCondition(name="stop")(Compare(">", name="above")(x, 0.5))
        return u if more is None else more(u)

    @subsystem(sample_time=slow * T, offset=T if slow > 1 else 0.0, name="slow")
    def counter(x):
        kept = UnitDelay(initial_value=0.1, name="kept")
        kept(x + 0.5 * kept.y)
        return kept.y

    force = box(plant.x, Step(times=0.0, values=1.0, name="reference"))
    call = plant(u=force)
    signals = (
        plant.x.named("x"),
        plant.mixed.named("mixed"),
        plant.shifted.named("shifted"),
        force.named("u"),
        counter(plant.x).named("k"),
    )
    return Diagram("lag_loop", call, *signals, loops=loops)


def three_plants():
    """An arm, a motor and a mass, the motor of FMI 2, in two rates; the arm's external force is no port."""
    arm, motor, mass = (
        Fmu(model.build(fmi=fmi), name=model.__name__.rpartition(".")[2], start=start, ports=ports)
        for model, fmi, start, ports in (
            (scara, 3, {"external_force": [0.5, -1.0]}, ["motor_torque", "joint_angle", "position"]),
            (dc_motor, 2, {"load_torque": 0.01}, ["voltage", "speed", "angle", "torque"]),
            (mass_spring_damper, 3, {}, None),
        )
    )

    @subsystem(sample_time=T, name="box")
    def box(angle, speed, position, reference):
        torque = Gain(gain=np.diag([3.0, 2.0]), name="arm_gain")(reference - angle)
        return torque, Gain(gain=0.2, name="motor_gain")(8.0 - speed), -4.0 * position

    @subsystem(sample_time=2 * T, name="slow")
    def slow(position):
        return Gain(gain=0.1, name="slow_gain")(position)

    angle, reference = arm.joint_angle, Constant(value=(0.3, -0.4), name="reference")
    torque, voltage, force = box(angle, motor.speed, mass.position, reference + slow(arm.position))
    calls = arm(motor_torque=torque), motor(voltage=voltage), mass(force=force)
    signals = arm.position.named("tip"), motor.angle.named("angle"), mass.acceleration.named("a")
    return Diagram("three", *calls, *signals)


def noisy():
    """The lag under noise of a seed, in two rates."""

    noise = BandLimitedNoise(sample_time=3 * T, variance=0.04, seed=5, name="noise")
    return loop(more=lambda u: u + noise.y, slow=3)
