"""A sampled model at a point that moves is the derivative of the run over one period, not a verdict on stability."""

import numpy as np
from scipy.integrate import solve_ivp

from loopwright.blocks import Integrator
from loopwright.diagrams import Diagram, subsystem

T, FRICTION, WIDTH, PUSH = 1e-3, 2.0, 0.01, 50.0


def compensated(start):
    """A mass of 1 kg whose friction F tanh(v/w) a controller adds to a push of 50 − 20 v N, held for a sample."""
    speed = Integrator(initial_value=start, name="speed")

    @subsystem(sample_time=T)
    def controller(v):
        return (PUSH - 20.0 * v + FRICTION * np.tanh(v / WIDTH)).named("force")

    return Diagram("compensated", speed(controller(speed.y) - FRICTION * np.tanh(speed.y / WIDTH)))


def derivative_of_a_period(v):
    """Return v behind one sample, and its derivative by v, from the variational equation."""
    slope = lambda v: FRICTION / WIDTH / np.cosh(v / WIDTH) ** 2  # noqa: E731
    held, held_slope = PUSH - 20.0 * v + FRICTION * np.tanh(v / WIDTH), -20.0 + slope(v)

    def rates(t, y):
        return [held - FRICTION * np.tanh(y[0] / WIDTH), held_slope - slope(y[0]) * y[1]]

    return solve_ivp(rates, (0.0, T), [v, 1.0], method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]


def test_a_pole_outside_the_unit_circle_at_standstill_is_the_friction_that_fades_within_the_sample():
    """The slope of the compensation is held, that of the friction fades as v passes w: at rest it doesn't, at 5 w both do.

    So `experiments.path_following()` has a pole of +22 1/s at t = 0, where it accelerates by 52 m/s², and none at 1 ms.
    """
    behind, moving = derivative_of_a_period(0.0)
    _, later = derivative_of_a_period(behind)
    at_rest = np.exp(-200.0 * T) + (1.0 - np.exp(-200.0 * T)) * 180.0 / 200.0  # no push: both slopes stay
    assert behind > 4.0 * WIDTH
    assert moving > 1.05
    assert max(later, at_rest) < 0.99
    for at, expected in ((0.0, moving), (T, later)):
        model = compensated(0.0).linearize(at)
        assert not model.is_equilibrium
        np.testing.assert_allclose(np.linalg.eigvals(model.A), [expected], rtol=1e-6)
