"""Diagrams for sweeps in other processes, which import this module: a block that may end its process, one that holds it."""

import os
import signal
from itertools import repeat

from loopwright.blocks import Block, Input, Output, Ramp, parameter
from loopwright.diagrams import Diagram, subsystem


class Fragile(Block):
    """Twice its input; evaluated by Python, and with ``kill`` it ends its process."""

    opaque = True
    kill: float = parameter(default=0.0)
    gain: float = parameter(default=2.0)
    u = Input()
    y = Output()

    def output(self, t, x, u):
        if self.kill > 0.5 and u.u > 0.05:
            print("about to end", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        return self.gain * u.u


def fragile():
    @subsystem(sample_time=0.01, name="box")
    def box(u):
        return Fragile(name="fragile")(u)

    return Diagram("fragile", box(Ramp(slope=1.0, name="ramp")).named("y"))


def double_end(run):
    """Twice the last sample."""
    return 2.0 * run["y"][-1]


class Held(Block):
    """Runs in C for hours and holds the interpreter lock; each process notes before that it does."""

    opaque = True
    gain: float = parameter(default=1.0)
    u = Input()
    y = Output()

    def output(self, t, x, u):
        if u.u > 0.05:
            with open(os.path.join(os.environ["HELD_FOLDER"], str(os.getpid())), "w"):
                pass
            sum(repeat(1, 10**13))
        return self.gain * u.u


def held():
    @subsystem(sample_time=0.01, name="box")
    def box(u):
        return Held(name="held")(u)

    return Diagram("held", box(Ramp(slope=1.0, name="ramp")).named("y"))
