"""Limits of four robots in both directions, each confirmed twice: by python-control's poles, and by runs."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.diagrams import AdmittanceLoop
from loopwright.fmus import gantry, scara
from support.reduced_loop import stability_limit
from support.robots import POINTS, PUSH, ROBOTS, contact, is_linear, regime, robot

ENVIRONMENTS = [("stiffness", {"damping": b}) for b in (0.0, 10.0, 50.0)] + [("mass", {"stiffness": 100.0})]
SIDES, DELAYS = ("par", "perp"), (0, 1)
IMPEDANCE = {"par": 0.5, "perp": 2.0}
"""Mass of the admittance in kg, Table III."""


@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("eta", POINTS)
@pytest.mark.parametrize("friction", [True, False])
@pytest.mark.parametrize(("vary", "held"), ENVIRONMENTS)
def test_limits_are_confirmed_by_poles_and_by_runs(name, side, delay, eta, friction, vary, held):
    here = contact(name, side, eta, delay, friction)
    limit = here.stability_limit(vary, **held)
    if limit.value == math.inf:  # an arm that is lighter than twice the impedance's mass
        assert (name, vary) == ("scara", "mass")
        assert mass_by_hand(here, side) == math.inf
        return
    if limit.value == 0.0:  # the damper alone breaks it: elastic screws without friction
        assert (name, friction, held) == ("gantry_elastic", False, {"damping": 50.0})
        limit = here.stability_limit("damping", stiffness=1.0)
        assert limit.value < 50.0
    assert "python-control" in limit.confirmed_by
    assert limit.tolerance < 1e-6 * limit.value
    found = here.confirm(limit, push=PUSH.get(name, 1e-6) if friction else 1e-6)
    assert is_linear(name if friction else "gantry", found)
    assert "speeds up to" in str(found)
    assert regime(name, friction, found)
    for trial, factor in zip(found.trials, (0.97, 1.03), strict=True):
        assert trial.value == factor * limit.value
        assert trial.measured == pytest.approx(trial.predicted, abs=0.01 * abs(trial.predicted) + 1e-3)
        assert (trial.measured > 0.0) is (factor > 1.0)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("eta", POINTS)
@pytest.mark.parametrize("friction", [True, False])
@pytest.mark.parametrize(("vary", "held"), ENVIRONMENTS)
def test_limits_of_the_rigid_gantry_are_those_by_hand(side, delay, eta, friction, vary, held):
    here = contact("gantry", side, eta, delay, friction)
    found = here.stability_limit(vary, **held)
    loop = AdmittanceLoop.of(robot("gantry", eta, 0, friction), side, eta=eta, xi=0.0).replace(delay=delay)
    expected = stability_limit(loop, vary, **held)
    # off the start of the path, the foot point is found by iteration: its rounding stands in both
    assert found.value == pytest.approx(expected.value, rel=1e-9)
    assert found.frequency == pytest.approx(expected.frequency, rel=1e-8)


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize(("vary", "held"), ENVIRONMENTS)
def test_bristles_that_carry_no_force_leave_the_rigid_gantry(side, delay, vary, held):
    found, expected = (
        contact(name, side, 0.0, delay, friction=False).stability_limit(vary, **held).value
        for name in ("gantry_stiction", "gantry")
    )
    assert found == pytest.approx(expected, rel=1e-8)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("friction", [True, False])
def test_springs_break_the_loop_where_the_admittance_is_no_longer_passive(name, side, delay, friction):
    here = contact(name, side, 0.0, delay, friction)
    found = here.stability_limit()
    w = brentq(lambda w: here.admittance([w]).rendered[0].real, 0.95 * found.frequency, 1.05 * found.frequency)
    assert found.value == pytest.approx(w / abs(here.admittance([w]).rendered[0]), rel=7e-4)  # the fundamental
    off, turned = abs(found.second_look / found.value - 1.0), found.frequency * 1e-3  # ω T
    assert off < 7e-4
    assert off < 0.5 * turned**4 + 1e-9  # the aliases that the fundamental lacks


def mass_by_hand(here, side):
    """The mass whose force, measured one sample late, feeds itself: |m (1/m_a − µ)/(1 + m µ)| = 1, at z = −1."""
    d = here.direction
    q = here.scale if side == "par" else 1.0
    mobility = float(d @ here.parts.velocity @ here.parts.force @ d)
    rest = q / IMPEDANCE[side] - 2.0 * mobility
    return 1.0 / rest if rest > 0.0 else math.inf


@pytest.mark.parametrize("name", ["gantry", "scara"])
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.drawn(2)
def test_mass_limits_without_delay_follow_the_impedance_and_the_mobility(name, side):
    here = contact(name, side, 0.5, 0, friction=False)
    expected = mass_by_hand(here, side)
    assert here.stability_limit("mass").value == pytest.approx(expected, rel=0.05)  # T times the loop's own poles


def test_an_arm_that_is_lighter_than_twice_the_impedance_has_no_limit_of_mass():
    here = contact("scara", "perp", 0.0)
    J = np.array(scara.nominal.dh(scara.nominal.joint_angles((0.8, 0.5))))
    M = np.array(scara.nominal.inertia(scara.nominal.joint_angles((0.8, 0.5))))
    apparent = 1.0 / (here.direction @ J @ np.linalg.solve(M, J.T) @ here.direction)
    assert apparent == pytest.approx(3.534, rel=1e-3)
    assert here.stability_limit("mass", stiffness=100.0).value == math.inf
    heavy = gantry.nominal.mass
    assert np.all(np.asarray(heavy) > 2 * IMPEDANCE["perp"])


@pytest.mark.slow
def test_another_tool_of_an_arm_without_friction_has_a_limit():
    """Its acceleration has no slope but that by the forces: what it has by its states is rounding of zero.

    The tool's inertia comes back through one sample, a⁺ = −m (diag(1/m_d) − Λ⁻¹) a, with the limit z = −1. The slower
    modes move it by the sample time over their time constants.
    """
    here = contact("scara", "par", friction=False)
    limit = here.stability_limit("tool_mass")
    arm = scara.nominal
    q = arm.joint_angles((0.8, 0.5))
    J, M = np.array(arm.dh(q), dtype=float), np.array(arm.inertia(q), dtype=float)
    across = np.diag([1 / IMPEDANCE["perp"], 1 / IMPEDANCE["par"]])  # the path goes along y there
    by_hand = 1 / np.linalg.eigvalsh(across - J @ np.linalg.solve(M, J.T)).max()
    assert limit.value == pytest.approx(by_hand, rel=2e-3)
    assert limit.value == pytest.approx(0.5410575772, rel=1e-9)  # by the matrices of the sampled loop, set up apart
    found = here.confirm(limit)
    assert found.below.measured < 0.0 < found.above.measured
