"""Blocks and boxes that the tests of the engine share."""

import numpy as np

from loopwright.blocks import Block, Event, Input, Output, State, Sum, UnitDelay, parameter
from loopwright.diagrams import subsystem

TIGHT = {"rtol": 1e-12, "atol": 1e-13, "solver": "DOP853", "progress": False}


class Lag(Block):
    """ẏ = u − k y."""

    k: float = parameter(default=1.0)
    start: float = parameter(default=0.0)
    u = Input()
    y = State(output=True, start="start")

    def derivative(self, t, x, u):
        return u.u - self.k * x.y


class Ball(Block):
    """A ball that bounces for ever."""

    restitution: float = parameter(default=0.8)
    height = State(start=1.0, output=True)
    velocity = State(output=True)
    impact = Event("falling")

    def derivative(self, t, x, u):
        return x.velocity, -9.81 + 0.0 * t

    def indicators(self, t, x, u):
        return x.height

    def jump(self, t, x, u, fired):
        return 0.0 * x.height, -self.restitution * x.velocity


class Crossings(Block):
    """Counts the crossings of zero of u in a direction, and keeps the time of the last one."""

    direction: str = parameter(default="both")
    hysteresis: float = parameter(default=0.0)
    u = Input()
    count = State(discrete=True, output=True)
    last = State(discrete=True, output=True, start=-1.0)

    @property
    def events(self):
        return {"cross": Event(self.direction, hysteresis=self.hysteresis, name="cross")}

    def indicators(self, t, x, u):
        return u.u

    def jump(self, t, x, u, fired):
        return x.count + 1.0, t + 0.0 * x.last


class Takes(Block):
    """At a rising trigger it takes over the value at u."""

    start: float = parameter(default=0.0)
    u = Input()
    trigger = Input()
    y = State(discrete=True, output=True, start="start")
    take = Event("rising")

    def indicators(self, t, x, u):
        return u.trigger - 0.5

    def jump(self, t, x, u, fired):
        return u.u + 0.0 * x.y


class Falls(Block):
    """Free fall from a height, without a floor."""

    height: float = parameter(default=1.0)
    h = State(start="height", output=True)
    v = State(output=True)

    def derivative(self, t, x, u):
        return x.v, -9.81 + 0.0 * t


class Twice(Block):
    """y = 2 u, without an ``update``: only its output."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return 2.0 * u.u


def counting(sample_time=None, name="counter", start=0.0, **options):
    """Return a box that counts how often it has acted; its output at the first time is 1 more than ``start``."""

    @subsystem(sample_time=sample_time, name=name, **options)
    def box():
        last = UnitDelay(initial_value=start, name="last")
        total = Sum(name="total")
        last(total(last.y, 1.0))
        return total.y.named("n")

    return box


def decay(t, k=1.0):
    return np.exp(-k * np.asarray(t))
