"""Poles of Fig. 3 with a tool beyond the force sensor, against the admittances' closed forms (E25)."""

import numpy as np
import pytest

from loopwright.diagrams.paper.experiments import compliance


def slowest_pairs(diagram):
    model = diagram.linearize()
    poles = model.poles
    s = np.log(poles[np.abs(poles) > 1e-9].astype(complex)) / model.dt if model.dt else poles
    return np.sort(s.real)[::-1]


@pytest.mark.parametrize("tool", [0.3, pytest.param(3.0, marks=pytest.mark.slow)])
def test_without_sampling_a_tool_adds_to_the_virtual_masses(tool):
    """−d/(2 (m_d + m)) of m_d = 0.5 kg, ζ = 0.6, k = 10 N/m along the path and 2 kg, 0.3, 200 N/m across it.

    The sensor feeds the linearizing law, too, whose error dynamics move the modes by a part of themselves that grows with
    the tool: 2e-5 with 0.3 kg, 5e-4 with 3 kg.
    """
    found = slowest_pairs(compliance(tool_mass=tool).diagram.continuous())
    exact = []
    for m, zeta, k in ((0.5, 0.6, 10.0), (2.0, 0.3, 200.0)):
        exact += 2 * [-2 * zeta * np.sqrt(k * m) / (2 * (m + tool))]
    np.testing.assert_allclose(found[:4], np.sort(exact)[::-1], rtol=2e-4 * max(tool, 0.5))


@pytest.mark.parametrize(("tool", "stable"), [(0.3, True), (1.0, False)])
def test_the_sampled_loop_tolerates_about_the_virtual_mass(tool, stable):
    found = slowest_pairs(compliance(tool_mass=tool).diagram)
    assert (found[0] < 0.0) == stable
    if not stable:
        assert found[0] > 100.0  # from one sample to the next: a gain of m / m_d
