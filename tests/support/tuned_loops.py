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


class Slide(Block):
    """A mass with viscous friction, and dry friction whose slope falls with speed."""

    force = Input()
    speed = Output()
    v = State(start="start")
    mass: float = parameter(default=2.0)
    viscous: float = parameter(default=0.5)
    coulomb: float = parameter(default=3.0)
    width: float = parameter(default=0.2)
    start: float = parameter(default=0.3)

    def output(self, t, x, u):
        return x.v

    def derivative(self, t, x, u):
        return (u.force - self.viscous * x.v - self.coulomb * np.tanh(x.v / self.width)) / self.mass


def make_slide():
    """L = (6 + 40/s)/(m s + the friction's slope) at 0.3 m/s, in continuous time, cut at u; it starts off its rest."""
    slide, integral = Slide(name="slide"), Integrator(name="i")
    error = Constant(value=0.3, name="wish") - slide.speed
    u = Gain(gain=6.0, name="p")(error) + integral(Gain(gain=40.0, name="ki")(error))
    return Diagram("slide", slide(force=u.named("u")))


def slide_slope(coulomb=3.0, width=0.2):
    """The slope of the friction at 0.3 m/s, in N·s/m."""
    return 0.5 + coulomb / width / np.cosh(0.3 / width) ** 2
