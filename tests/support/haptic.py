"""A haptic device: a mass with friction, and a virtual wall that is sampled."""

from loopwright.blocks import Block, Constant, Gain, Input, Output, State
from loopwright.diagrams import Diagram, subsystem

MASS, DRAG, T = 0.3, 1.0, 1e-3
HANDLE = {"position": "handle.position", "velocity": "handle.velocity", "force": None}


class Handle(Block):
    motor = Input(unit="N")
    push = Input(unit="N")
    position = State(unit="m", start=0.0, output=True)
    velocity = State(unit="m/s", start=0.0, output=True)

    def derivative(self, t, x, u):
        return x.velocity, (u.motor + u.push - DRAG * x.velocity) / MASS


class Difference(Block):
    u = Input()
    y = Output()
    last = State(start=0.0)

    def output(self, t, x, u, T):
        return (u.u - x.last) / T

    def update(self, t, x, u, T):
        return u.u


def haptic(stiffness, damping=0.0, delay=0):
    """A virtual wall K + B (1 − 1/z)/T, sampled at 1 kHz: no force sensor."""
    handle, hand = Handle(name="handle"), Constant(value=0.0, unit="N", name="hand")

    @subsystem(sample_time=T, delay=delay)
    def wall(position):
        rate = Difference(name="difference")(position)
        return -(Gain(gain=stiffness, name="k")(position) + Gain(gain=damping, name="b")(rate))

    return Diagram("haptic", handle(motor=wall(handle.position), push=hand))
