"""Slopes of margins along changes of a loop's matrices, against closed forms and differences of the margins."""

import control
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import ParameterError
from loopwright.diagrams.frequency import margin_slopes, margins, mimo_disk_margin

A = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 2.0], [0.0, 0.0, -5.0]])
B = np.array([[0.0], [0.0], [3.0]])
C = np.array([[1.0, 0.3, 0.0]])


def hold(T):
    both = expm(np.block([[A, B], [np.zeros((1, 4))]]) * T)
    return both[:3, :3], both[:3, 3:], C, np.zeros((1, 1))


def make_changes(matrices, count, seed=3):
    """Return random changes that keep the poles at s = 0 and z = 1."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        a, b, c, d = (rng.normal(size=M.shape) * np.abs(M).max(initial=0.0) for M in matrices)
        a[:, 0] = 0.0
        found.append((0.1 * a, b, c, d))
    return found


def test_a_gain_moves_the_margins_of_an_integrator_with_a_lag_by_closed_forms():
    """L = k/(s (s + 1)): φ = 180° − 90° − atan ω, ω² = (√(1 + 4k²) − 1)/2; T = k/(s² + s + k)."""
    k = 1.3
    loop = control.ss([[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[k, 0.0]], 0.0)
    by_k = (np.zeros((2, 2)), np.zeros((2, 1)), np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    found = margin_slopes(loop, [by_k])
    w = np.sqrt((np.sqrt(1 + 4 * k**2) - 1) / 2)
    dw = k / (w * np.sqrt(1 + 4 * k**2))
    lag, dlag = np.pi / 2 - np.arctan(w), -dw / (1 + w**2)
    zeta = 1 / (2 * np.sqrt(k))
    mt = 1 / (2 * zeta * np.sqrt(1 - zeta**2))
    dmt = -(1 - 2 * zeta**2) / (2 * zeta**2 * (1 - zeta**2) ** 1.5) * (-0.25 * k**-1.5)
    assert found["phase_margin_deg"].slopes[0] == pytest.approx(np.degrees(dlag), rel=1e-9)
    assert found["delay_margin_s"].slopes[0] == pytest.approx((dlag * w - lag * dw) / w**2, rel=1e-9)
    assert found["mt"].number.value == pytest.approx(mt, rel=1e-9)
    assert found["mt"].slopes[0] == pytest.approx(dmt, rel=1e-8)
    root = np.sqrt((1 - 2 * k) ** 2 + 4 * k**2)  # of |T|² = 1/2 in ω²
    bandwidth = np.sqrt((2 * k - 1 + root) / 2)
    dsquare = 0.5 * (2 + (-2 * (1 - 2 * k) + 4 * k) / root)
    assert found["bandwidth"].number.value == pytest.approx(bandwidth, rel=1e-9)
    assert found["bandwidth"].slopes[0] == pytest.approx(dsquare / (2 * bandwidth), rel=1e-8)
    assert np.isnan(found["gain_margin_high"].slopes[0])  # no gain ends stability


def test_a_gain_divides_the_gain_margin_of_a_sampled_integrator():
    """L = k T/(z − 1): the gain margin is 2/(k T), at z = −1."""
    T, k = 0.1, 3.0
    loop = control.ss([[1.0]], [[T]], [[k]], 0.0, T)
    by_k = (np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    found = margin_slopes(loop, [by_k])["gain_margin_high"]
    assert found.number.value == pytest.approx(2 / (k * T), rel=1e-12)
    assert found.slopes[0] == pytest.approx(-2 / (k**2 * T), rel=1e-12)


@pytest.mark.parametrize(("T", "delay", "skew"), [(0.0, 0, 0.3), (0.05, 0, 0.0), (0.05, 2, -0.5)])
@pytest.mark.slow
def test_slopes_are_the_differences_of_margins(T, delay, skew):
    matrices = hold(T) if T else (A, B, C, np.zeros((1, 1)))
    changes = make_changes(matrices, 3)
    found = margin_slopes(control.ss(*matrices, T), changes, delay=delay, skew=skew)
    h = 1e-4
    for i, change in enumerate(changes):
        made = [
            margins(
                control.ss(*(M + s * h * d for M, d in zip(matrices, change, strict=True)), T), delay=delay, skew=skew
            )
            for s in (1.0, -1.0, 2.0, -2.0)
        ]
        for name, one in found.items():
            a, b, c, d = (getattr(m, name).value for m in made)
            if np.isfinite([a, b, c, d]).all() and a > 0:
                assert one.slopes[i] == pytest.approx((8 * (a - b) - (c - d)) / (12 * h), rel=1e-6, abs=1e-8), name
                assert not one.kink


@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_disk_margin_of_several_channels_has_slopes(n):
    rng = np.random.default_rng(7)
    matrices = (np.diag([-1.0, -2.0, -3.0]), rng.normal(size=(3, n)), rng.normal(size=(n, 3)), np.zeros((n, n)))
    change = (*(rng.normal(size=M.shape) for M in matrices[:3]), np.zeros((n, n)))
    found = margin_slopes(control.ss(*matrices), [change])["disk_margin"]
    h = 1e-3
    a, b, c, d = (
        mimo_disk_margin(control.ss(*(M + s * h * e for M, e in zip(matrices, change, strict=True)))).alpha.value
        for s in (1.0, -1.0, 2.0, -2.0)
    )
    assert found.slopes[0] == pytest.approx((8 * (a - b) - (c - d)) / (12 * h), rel=1e-6)


def test_an_unstable_loop_has_no_slopes():
    loop = control.ss([[1.0]], [[1.0]], [[0.5]], 0.0)
    found = margin_slopes(loop, [(np.eye(1), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))])
    assert all(np.isnan(one.slopes[0]) for one in found.values())


def test_a_change_of_another_shape_is_refused():
    loop = control.ss([[-1.0]], [[1.0]], [[0.5]], 0.0)
    with pytest.raises(ParameterError, match="expected those of the loop"):
        margin_slopes(loop, [(np.eye(2), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))])
