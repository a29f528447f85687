"""A block alone in a sampled subsystem, under a wave: for the tests of discretization."""

import numpy as np

from loopwright.blocks import Block, Input, Output, State, parameter
from loopwright.diagrams import Diagram, subsystem

T, TICKS = 0.02, 150


class Wave(Block):
    """An input that changes from tick to tick."""

    y = Output(shape=(2,))

    def output(self, t, x, u):
        return np.stack([2.0 * np.sin(5.0 * t + 0.3), np.cos(3.0 * t)])


def wave(t):
    return np.array([2.0 * np.sin(5.0 * t + 0.3), np.cos(3.0 * t)])


def run_of(block, signal, method="exact", sample_time=T, ticks=TICKS):
    """A run of the block alone in a sampled subsystem."""

    @subsystem(sample_time=sample_time, method=method)
    def box(u):
        return block(u)

    return Diagram("discretized", box(signal)).simulate(ticks * sample_time, progress=False)


class Pendulum(Block):
    """A damped pendulum with a torque; the torque acts with a factor that depends on time."""

    stiffness: float = parameter(default=9.0)
    damping: float = parameter(default=0.4)
    torque = Input()
    angle = State(start=1.2, output=True)
    rate = State(start=-0.5, output=True)

    def derivative(self, t, x, u):
        return x.rate, -self.stiffness * np.sin(x.angle) - self.damping * x.rate + (1.0 + 0.5 * t) * u.torque


class Rotor(Block):
    """Euler's equations of a rigid body: each rate needs both other states. The first two are one vector."""

    torque = Input(shape=(2,))
    across = State(start=(1.0, -0.4), output=True)
    along = State(start=2.0, output=True)

    def derivative(self, t, x, u):
        a, b = x.across[0], x.across[1]
        return np.stack([0.7 * b * x.along, -0.9 * x.along * a]) + u.torque, 0.3 * a * b


def states(run, *names):
    return np.concatenate([run[name].reshape(len(run.t), -1) for name in names], axis=1)


class Network(Block):
    """A linear network: x' = A x + B u + g, as one vector."""

    A: np.ndarray = parameter()
    B: np.ndarray = parameter()
    g: np.ndarray = parameter()
    start: np.ndarray = parameter()
    u = Input(shape=(2,))
    x = State(start="start", output=True)

    def derivative(self, t, x, u):
        return self.A @ x.x + self.B @ u.u + self.g


def network(seed, n=3):
    """A stable network with zeros in its matrices, and what defines it."""
    rng = np.random.default_rng(seed)
    A = 4.0 * rng.standard_normal((n, n))
    A[0, 1] = A[2, 0] = 0.0
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(n)
    B, g, start = 3.0 * rng.standard_normal((n, 2)), rng.standard_normal(n), rng.standard_normal(n)
    B[1, 0] = g[2] = 0.0
    return Network(A=A, B=B, g=g, start=start)
