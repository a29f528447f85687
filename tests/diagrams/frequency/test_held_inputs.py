"""Linear systems over a time with held inputs."""

import numpy as np
from scipy.integrate import solve_ivp

from loopwright.diagrams.frequency import advance_held, hold_inputs


def test_a_double_integrator_moves_as_by_hand_for_every_system_of_a_batch():
    T, gains = 0.3, np.array([0.5, 2.0, -4.0])
    A = np.broadcast_to([[0.0, 1.0], [0.0, 0.0]], (3, 2, 2))
    B = gains[:, None, None] * np.array([[0.0], [1.0]])
    Ad, Bd = hold_inputs(A, B, T)
    np.testing.assert_allclose(Ad, np.broadcast_to([[1.0, T], [0.0, 1.0]], (3, 2, 2)), rtol=1e-14)
    np.testing.assert_allclose(Bd[..., 0], gains[:, None] * np.array([T**2 / 2, T]), rtol=1e-14)


def test_a_complex_system_with_two_inputs_moves_as_its_integral():
    rng = np.random.default_rng(3)
    A, B = (rng.standard_normal((3, n)) + 1j * rng.standard_normal((3, n)) for n in (3, 2))
    x, u, T = rng.standard_normal(3) + 0j, rng.standard_normal(2), 0.7
    moved = advance_held(A, B, T) @ np.concatenate([x, u])
    run = solve_ivp(lambda _, x: A @ x + B @ u, (0.0, T), x, method="DOP853", rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(moved, np.concatenate([run.y[:, -1], u]), rtol=1e-9)
