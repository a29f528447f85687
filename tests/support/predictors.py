"""Controllers with a model of their own, a Smith predictor and an observer, with their loops by hand."""

import control
import numpy as np

from loopwright.blocks import PID, Constant, Delay, DiscreteStateSpace, Gain, StateSpace, TransferFunction
from loopwright.diagrams import Diagram, subsystem

T, DEAD, KP, KI = 0.5, 6, 2.0, 0.25
"""Sample time in s, dead time in samples, and the PI law of the predictor."""


def smith(gain=1.3, dead=DEAD):
    """A lag of 5 s with a dead time, whose controller takes a gain of 1 for its gain."""
    plant = TransferFunction(numerator=[gain], denominator=[5.0, 1.0], name="plant")

    @subsystem(sample_time=T)
    def sensor(y):
        return Delay(steps=dead, name="dead_time")(y)

    @subsystem(sample_time=T)
    def controller(y):
        a = np.exp(-T / 5.0)
        model = DiscreteStateSpace(A=[[a]], B=[1.0 - a], C=[1.0], D=0.0, name="model")
        late = Delay(steps=DEAD, name="late")(model.y)
        u = PID(kp=KP, ki=KI, name="pi")(Constant(value=0.0, name="r"), y + model.y - late).named("u")
        model(u)
        return u

    return Diagram("smith", plant(controller(sensor(plant.y))))


def smith_by_hand(gain=1.3, dead=DEAD):
    """Return the loops at the plant's input and behind u for all consumers, by python-control."""
    z = control.tf("z")
    z.dt = T
    a = np.exp(-T / 5.0)
    G0, C = (1 - a) / (z - a), KP + KI * T / (z - 1)
    own = C * G0 * (1 - z**-DEAD)
    at_plant = control.minreal(C / (1 + own) * gain * G0 * z**-dead, verbose=False)
    return at_plant, control.minreal(own + C * gain * G0 * z**-dead, verbose=False)


A, B, C = np.array([[0.0, 1.0], [0.0, -0.5]]), np.array([[0.0], [2.0]]), np.array([[1.0, 0.0]])
K, L = np.array([[4.0, 2.5]]), np.array([[9.0], [20.0]])


def observed(boxed=True):
    """u = −K x̂ of an observer, for a drive: observer and gain in a subsystem, or all blocks side by side."""
    plant = StateSpace(A=A, B=B[:, 0], C=C[0], D=0.0, name="plant")
    observer = StateSpace(A=A - L @ C, B=np.hstack([B, L]), C=-K[0], D=np.zeros(2), name="observer")
    law = Gain(gain=1.0, name="law")

    def regulator(y):
        u = law(observer.y).named("u")
        return u, observer((u, y))

    if not boxed:
        u, estimate = regulator(plant.y)
        return Diagram("observed", plant(u), estimate)
    return Diagram("observed", plant(subsystem(lambda y: regulator(y)[0], name="regulator")(plant.y)))


def observed_by_hand(s):
    """Return L = K (s I − A + B K + L C)⁻¹ L · C (s I − A)⁻¹ B, the loop at the plant's input, for each s of an array."""
    s_eye = np.multiply.outer(s, np.eye(2))
    law = K @ np.linalg.solve(s_eye - A + B @ K + L @ C, L)
    return (law @ C @ np.linalg.solve(s_eye - A, B))[..., 0, 0]
