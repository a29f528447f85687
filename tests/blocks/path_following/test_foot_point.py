"""A foot point that Newton's method has not reached stops the run, although all else looks valid."""

import numpy as np
import pytest

from loopwright.blocks import Block, Ellipse, HandForce, Output, PathDomainError, PathProjection, PathSpring, parameter
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


@pytest.mark.parametrize("block", [PathProjection, HandForce, PathSpring])
@pytest.mark.parametrize("jump", [0.5, -0.5])
def test_a_foot_point_not_reached_within_the_tick_stops_the_run(block, jump):
    # Four steps of Newton's method from 0.5 rad off end 3.5e-4 rad off: near enough for q and for the medial axis to be
    # valid there (q > 0.9, 87 mm), and for the next tick to find the foot point, but 0.1 mm wrong along the path.
    with pytest.raises(
        PathDomainError,
        match=r"the foot point jumped by .* m along the path: the position moved too far within one tick",
    ) as e:
        run_of(block(PATH, name="tracked"), jump)
    assert (e.value.block, e.value.t) == ("box.tracked", 0.003)
    assert e.value.theta % (2 * np.pi) == pytest.approx(jump % (2 * np.pi), abs=1e-9)
    assert e.value.xi == pytest.approx(XI, abs=1e-12)
    assert e.value.reach == pytest.approx(B / A * np.hypot(A * np.sin(jump), B * np.cos(jump)), rel=1e-9)
    assert len(e.value.run.t) == 3


@pytest.mark.parametrize("jump", [0.2, -0.2])
def test_a_foot_point_that_is_reached_goes_on(jump):
    run = run_of(PathProjection(PATH, name="tracked"), jump)
    np.testing.assert_allclose(run["tracked.theta"], np.where(run.t > 0.0025, jump, 0.0), rtol=0, atol=1e-9 * 2 * np.pi)
    w = np.hypot(A * np.sin(jump), B * np.cos(jump))
    assert run["tracked.q"][-1] == pytest.approx(1.0 - A * B / w**3 * XI, abs=1e-9)


@pytest.mark.parametrize("jump", [0.74, -0.74])
def test_a_jump_never_ends_in_another_lap(jump):
    # Newton's method from 0.74 rad off converges, but one lap away: eta would jump by the length of the path
    with pytest.raises(PathDomainError, match="the foot point jumped"):
        run_of(PathProjection(PATH, name="tracked"), jump)
