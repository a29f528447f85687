"""A drive whose run, models and studies are looked at as tables and as short texts."""

import numpy as np

from loopwright.blocks import Gain, Integrator, StateSpace, Step
from loopwright.diagrams import Diagram, subsystem


def drive(ki=0.3):
    """Return a sampled PI controller around an oscillator of 3 rad/s with damping 0.1."""
    A, B = np.array([[0.0, 1.0], [-9.0, -0.6]]), np.array([0.0, 9.0])
    plant = StateSpace(A=A, B=B, C=np.array([1.0, 0.0]), D=0.0, name="plant")

    @subsystem(sample_time=0.02)
    def control(e):
        return Gain(gain=0.2, name="kp")(e) + Gain(gain=ki, name="ki")(Integrator(name="i")(e))

    e = (Step(times=0.1, values=1.0, name="step") - plant.y).named("e")
    return Diagram("drive", plant(control(e).named("u")).named("y"))
