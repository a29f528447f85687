"""The independent solution's own integrator, against SciPy's at tight tolerance."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from support import oracle


@pytest.mark.drawn(1)
@pytest.mark.parametrize("width", [0.1, 0.01, 0.001])
def test_the_plant_of_the_independent_solution_moves_as_scipy_says(width):
    plant, rng = oracle.Plant(oracle.Options(friction_width=width)), np.random.default_rng(5)
    state = exact = np.array([0.5, 0.6, 0.02, -0.03])
    reversals = 0
    for _ in range(60):  # through zero again and again, where friction is steep
        motor, external = (rng.normal(size=2) * 400.0 + oracle.WEIGHT, rng.normal(size=2) * 5.0)
        state = plant.advance(state, tuple(motor), tuple(external), 1e-3)

        def rate(t, x, force=motor + external):
            friction = oracle.COULOMB * np.tanh(x[2:] / width) + np.multiply(oracle.VISCOUS, x[2:])
            return np.concatenate([x[2:], (force - friction - oracle.WEIGHT) / oracle.MASS])

        before = exact
        exact = solve_ivp(rate, (0.0, 1e-3), exact, "DOP853", rtol=1e-12, atol=1e-15, max_step=5e-5).y[:, -1]
        reversals += int(np.sum(before[2:] * exact[2:] < 0))
        assert np.abs(state - exact)[:2].max() < 1e-9  # a hundredth of what the experiments are compared to
        assert np.abs(state - exact)[2:].max() < 1e-7
        np.testing.assert_allclose(plant.acceleration(exact), rate(0.0, exact)[2:], rtol=1e-13)
    assert reversals >= 10
