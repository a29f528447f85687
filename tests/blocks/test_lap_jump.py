"""A foot point that Newton's method has not reached stops the run, although all else looks valid."""

import numpy as np
import pytest

from loopwright.blocks import Block, Ellipse, Output, PathDomainError, PathProjection, parameter
from loopwright.diagrams import Diagram, subsystem

A, B, XI = 0.3, 0.15, 0.01
PATH = Ellipse(semi_axes=(A, B), center=(0.5, 0.5))


def beside_the_ellipse(theta):
    """The point 10 mm inside of the foot point theta: far from the medial axis, whose least distance is b^2/a = 75 mm."""
    c, s = np.cos(theta), np.sin(theta)
    inwards = -np.array([B * c, A * s]) / np.hypot(B * c, A * s)
    return np.array([0.5 + A * c, 0.5 + B * s]) + XI * inwards


class Jump(Block):
    """At rest beside theta = 0, from 3 ms on beside another point."""

    to: np.ndarray = parameter()
    y = Output(shape=(2,), unit="m")

    def output(self, t, x, u):
        return np.where(t > 0.0025, self.to, beside_the_ellipse(0.0))


def run_of(block, to, duration=6e-3):
    @subsystem(sample_time=1e-3)
    def box(position):
        return block(position)

    return Diagram("jump", *box(Jump(to=beside_the_ellipse(to))())).simulate(duration, progress=False)


@pytest.mark.parametrize("jump", [0.74, -0.74])
def test_a_jump_never_ends_in_another_lap(jump):
    # Newton's method from 0.74 rad off converges, but one lap away: eta would jump by the length of the path
    with pytest.raises(PathDomainError, match="the foot point jumped"):
        run_of(PathProjection(PATH, name="tracked"), jump)
