"""Loops whose margins have closed forms, with parameters to vary."""

import numpy as np

from loopwright.blocks import Block, Constant, Gain, Input, Integrator, Output, State, parameter
from loopwright.diagrams import Diagram


class Tank(Block):
    """A tank whose outflow goes with the root of its level."""

    inflow = Input()
    level = Output()
    h = State(start="start")
    area: float = parameter(default=1.0)
    outlet: float = parameter(default=1.0)
    start: float = parameter(default=1.0, minimum=0.0)

    def output(self, t, x, u):
        return x.h

    def derivative(self, t, x, u):
        return (u.inflow - self.outlet * np.sqrt(x.h)) / self.area


def make_pi_loop(kp=1.0, ki=0.5, a=2.0):
    """L = (kp s + ki) a/(s (s + a)) in continuous time, cut at u."""
    state, integral = Integrator(name="x"), Integrator(name="i")
    rate, p, i = Gain(gain=a, name="rate"), Gain(gain=kp, name="p"), Gain(gain=ki, name="ki")
    error = Constant(value=0.0, name="r") - state.y
    u = (p(error) + integral(i(error))).named("u")
    return Diagram("pi", state(rate(u - state.y)))


def pi_phase_margin(kp, ki, a):
    """The phase margin in degrees, by the crossover |L| = 1: a quadratic equation in ω²."""
    b, c = a**2 - (kp * a) ** 2, -((ki * a) ** 2)
    w = np.sqrt((-b + np.sqrt(b**2 - 4 * c)) / 2)
    return np.degrees(np.arctan2(kp * w, ki) + np.pi / 2 - np.arctan2(w, a))
