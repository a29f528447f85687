"""Slopes by central differences of fourth order."""

import numpy as np
import pytest

from loopwright.blocks.tracing import differentiate, extrapolate


@pytest.mark.parametrize("at", [0.0, -1.3, 250.0])
def test_a_polynomial_of_fourth_degree_has_its_slope(at):
    p = np.polynomial.Polynomial([3.0, -2.0, 0.5, 1.5, -0.25])
    size = max(abs(at), 1.0)
    (found, other) = differentiate(lambda v: [np.array([p(v), 2.0 * v]), np.array([-p(v)])], at, size)
    rounding = 1e-9 * (abs(p.deriv()(at)) + abs(p(at)) / size + 1.0)
    assert found == pytest.approx([p.deriv()(at), 2.0], abs=rounding)
    assert other == pytest.approx([-p.deriv()(at)], abs=rounding)


def test_the_error_of_extrapolated_quotients_falls_with_the_fourth_power_of_the_step():
    def error(h):
        near, far = ((np.sin(1.0 + step) - np.sin(1.0 - step)) / (2.0 * step) for step in (h, 2.0 * h))
        return abs(extrapolate(near, far) - np.cos(1.0))

    assert np.log2(error(0.2) / error(0.1)) == pytest.approx(4.0, abs=0.05)
