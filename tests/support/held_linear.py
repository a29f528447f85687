"""A linear plant that is stepped from outside, exactly, in Python: x' = A x + B u with u held, y = C x + D u."""

import pickle
from contextlib import contextmanager

import numpy as np
from scipy.linalg import expm

from loopwright.blocks import Block, Input, Output, parameter


class HeldLinear(Block):
    """Linear plant with one input and one output; it says nothing of its feedthrough."""

    stepped = True
    variable_step = True
    A: np.ndarray = parameter(description="states by states")
    B: np.ndarray = parameter(description="states by the input")
    C: np.ndarray = parameter(description="the output by states")
    D: float = parameter(default=0.0, description="the output by the input")
    start: np.ndarray = parameter(description="states at the start")
    u = Input()
    y = Output()

    @contextmanager
    def instantiate(self, wired, stop_time, *, start_time=0.0):
        """Yield the plant."""
        yield HeldLinearPlant(self)


class HeldLinearPlant:
    """One such plant in a run."""

    messages = ()
    failed = False
    can_serialize = True

    def __init__(self, block):
        self.block, self.x = block, np.array(block.start, dtype=float)

    def bind(self, inputs, outputs):
        self.inputs, self.outputs = inputs, outputs

    def exchange(self):
        self.outputs[0] = self.block.C @ self.x + self.block.D * self.inputs[0]

    def begin(self):
        self.exchange()

    def step(self, t, h):
        n = len(self.x)
        big = np.zeros((n + 1, n + 1))
        big[:n, :n], big[:n, n] = self.block.A, self.block.B
        whole = expm(big * h)
        self.x = whole[:n, :n] @ self.x + whole[:n, n] * self.inputs[0]
        self.exchange()

    def operating_point(self):
        return {"t": 0.0, "state": {}, "inputs": {}}

    def serialize(self):
        return pickle.dumps((self.x, self.outputs[0]))

    def deserialize(self, data):
        return pickle.loads(data)

    def restore(self, state):
        self.x, self.outputs[0] = state[0].copy(), state[1]
