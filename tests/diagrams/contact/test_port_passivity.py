"""Passivity of contacts against all passive environments: Colgate's condition, a fine grid, and closed forms."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import Constant, Gain
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.contact.port_passivity import PassivityReason, find_zeros_of_real_part
from support.haptic import DRAG, HANDLE, MASS, Handle, T, haptic


def colgate(stiffness, damping, delay):
    """1 − T/(2 b) Re((1 − 1/z) H(z))/(1 − cos ωT), the least one over the frequencies."""
    angle = np.linspace(1e-3 * math.pi, math.pi, 20001)
    z = np.exp(1j * angle)
    H = (stiffness + damping * (1.0 - 1.0 / z) / T) * z**-delay
    return float(np.min(1.0 - T / (2.0 * DRAG) * ((1.0 - 1.0 / z) * H).real / (1.0 - np.cos(angle))))


@pytest.mark.parametrize(("damping", "delay"), [(0.0, 0), (0.3, 0), (-0.2, 0), (0.0, 1), (0.2, 1)])
@pytest.mark.drawn(1)
def test_a_virtual_wall_is_passive_against_everything_up_to_the_condition_of_colgate(damping, delay):
    limit = brentq(lambda K: colgate(K, damping, delay), 1.0, 1e5)
    for factor in (0.95, 0.9999, 1.0001):
        stiffness = factor * limit
        found = haptic(stiffness, damping, delay).contact("handle.push", direction=[1.0], **HANDLE).passivity().port
        assert found.passive is (factor < 1.0)
        assert found.margin == pytest.approx(colgate(stiffness, damping, delay), abs=1e-6)
        assert found.reason is PassivityReason.COMPUTED


def test_the_aliases_disprove_what_the_fundamental_does_not_show():
    limit = 2.0 * (DRAG - 0.3) / T  # b = K T/2 + B, at the Nyquist frequency
    found = haptic(1.2 * limit, 0.3).contact("handle.push", direction=[1.0], **HANDLE).passivity()
    assert found.frequency == math.inf
    assert found.port.passive is False
    assert found.port.frequency == pytest.approx(math.pi / T, rel=1e-3)
    assert found.port.margin == pytest.approx(-0.2 * 0.7, abs=1e-6)


@pytest.mark.parametrize(
    ("rate", "reason"), [(True, PassivityReason.VELOCITY_SAMPLED), (False, PassivityReason.FORCE_SAMPLED)]
)
def test_a_force_or_a_velocity_without_a_filter_is_passive_against_no_environment_at_all(rate, reason):
    handle, hand = Handle(name="handle"), Constant(value=0.0, unit="N", name="hand")

    @subsystem(sample_time=T)
    def drive(u):
        return Gain(gain=-0.1 if rate else 0.1, name="k")(u)

    made = Diagram("handle", handle(motor=drive(handle.velocity if rate else hand), push=hand))
    force = {**HANDLE, "force": None if rate else "hand.y"}
    found = made.contact("handle.push", direction=[1.0], **force).passivity().port
    assert (found.passive, found.reason) == (False, reason)


@pytest.mark.parametrize("gain", [0.0, -0.5, -0.99, -1.01, 3.0])
def test_a_continuous_contact_is_passive_as_long_as_its_damping_is(gain):
    """m s + b (1 + gain): passive for gain ≥ −1; a gain below destabilizes it."""
    handle, hand = Handle(name="handle"), Constant(value=0.0, unit="N", name="hand")
    drive = Gain(gain=-gain * DRAG, name="drag")(handle.velocity)
    made = Diagram("handle", handle(motor=drive, push=hand))
    found = made.contact("handle.push", direction=[1.0], **HANDLE).passivity().port
    assert found.passive is (gain > -1.0)
    if gain > -1.0:  # the margin is Re Y, and as near to 0 as 1e-9 of |Y| counts as 0
        Y = 1.0 / (1j * found.frequency * MASS + DRAG * (1.0 + gain))
        assert (found.margin, found.tolerance) == pytest.approx((Y.real, 1e-9 * abs(Y)), rel=1e-6)


def test_zeros_of_the_real_part_are_those_of_its_polynomial():
    """Y = s (s² + c s + 1)/((s² + d s + 4)(s + 1)(s + 2)), Re Y(jω) by polynomials in ω²; a narrow dip, between the points of a grid."""
    c, d = 1e-4, 0.02
    numerator = np.polymul([1.0, 0.0], [1.0, c, 1.0])
    denominator = np.polymul([1.0, d, 4.0], np.polymul([1.0, 1.0], [1.0, 2.0]))
    n = len(denominator) - 1
    A = np.vstack([-denominator[1:], np.eye(n - 1, n)])
    B, C = np.eye(n, 1), np.concatenate([np.zeros(n - len(numerator)), numerator])[None, :]
    found = find_zeros_of_real_part(A, B, C)

    def real(w):
        return (np.polyval(numerator, 1j * w) * np.conj(np.polyval(denominator, 1j * w))).real

    w = np.linspace(1e-3, 50.0, 400001)
    y = real(w)
    expected = [brentq(real, w[i], w[i + 1]) for i in np.flatnonzero(y[:-1] * y[1:] < 0.0)]
    assert len(expected) >= 2
    for one in expected:
        assert np.min(np.abs(found - one)) < 1e-8 * one
