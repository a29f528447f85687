"""A plant that is no FMU, as a user writes one."""

import struct
from contextlib import contextmanager

from loopwright.blocks import Block, Input, Output, parameter


class Tank(Block):
    """Level of a tank, held in Python: y(t + h) = y(t) + h u(t) / area."""

    stepped = True
    area: float = parameter(above=0.0, description="of the surface, m²")
    level: float = parameter(default=0.0, description="at the start, m")
    u = Input(unit="m^3/s")
    y = Output(unit="m")

    @contextmanager
    def instantiate(self, wired, stop_time, *, start_time=0.0):
        """Yield the plant."""
        plant = TankPlant(self, wired)
        yield plant
        CALLS.append("freed")


CALLS = []
"""Steps of all tanks, as (t, h), and "freed" at the end of a run."""


class TankPlant:
    """One tank in a run."""

    messages = ()
    failed = False
    can_serialize = True

    def __init__(self, block, wired):
        assert list(wired) == ["u"]
        self.area, self.level, self.t = block.area, block.level, 0.0

    def bind(self, inputs, outputs):
        self.inputs, self.outputs = inputs, outputs
        self._put_out()

    def _put_out(self):
        self.outputs[0] = self.level

    exchange = begin = _put_out

    def step(self, t, h):
        CALLS.append((t, h))
        self.level += h * self.inputs[0] / self.area
        self.t = t + h
        self._put_out()

    def operating_point(self):
        return {"t": self.t, "state": {"level": self.level}, "inputs": {"u": self.inputs.copy()}}

    def serialize(self):
        return struct.pack("<2d", self.t, self.level)

    def deserialize(self, data):
        return struct.unpack("<2d", data)

    def restore(self, state):
        self.t, self.level = state
        self._put_out()
