"""A block alone in a sampled frame, under a wave: for the tests of discretization."""

import numpy as np

from loopwright.blocks import Block, Output
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
    """A run of the block alone in a sampled frame."""

    @subsystem(sample_time=sample_time, method=method)
    def box(u):
        return block(u)

    return Diagram("discretized", box(signal)).simulate(ticks * sample_time, progress=False)
