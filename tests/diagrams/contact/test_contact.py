"""The contact of a diagram's own linear model, against the reduced loop by hand, closed forms and other plants."""

import math
import re
from functools import cache

import numpy as np
import pytest

from loopwright.blocks import (
    OptionError,
    ParameterError,
    Reference,
)
from loopwright.blocks.core.errors import ShapeError, UnknownNameError
from loopwright.diagrams import AdmittanceLoop, experiments, passivity, target_admittance
from loopwright.diagrams.paper.fig3_case import NO_FRICTION
from loopwright.fmus import gantry, gantry_elastic
from loopwright.types import MeanSlope, StepsOnly
from support.contact import FORCE_TRACKING
from support.plants import hidden, undirected
from support.reduced_loop import growth_rate, negative_intervals, rendered_admittance, stability_limit

SIDE = pytest.mark.parametrize("side", ["par", "perp"])
IMPLEMENTATIONS = {"continuous": ("continuous", 0), "sampled_d0": ("sampled", 0), "sampled_d1": ("sampled", 1)}


@cache
def diagram(name="sampled_d0", plant=None):
    options = {} if plant is None else {"plant": plant.build()}
    made = experiments.compliance(delay=IMPLEMENTATIONS[name][1], **options).diagram
    return made.continuous() if name == "continuous" else made


@cache
def contact(name="sampled_d0", side="perp", plant=None):
    return diagram(name, plant).contact(direction=side)


def by_hand(name="sampled_d0", side="perp", **changes):
    implementation, delay = IMPLEMENTATIONS[name]
    return AdmittanceLoop.of(diagram(), side, **changes).replace(implementation=implementation, delay=delay)


def agree(found, expected, tolerance=1e-9):
    assert found.value == pytest.approx(expected.value, rel=tolerance)
    assert found.restabilizes == pytest.approx(expected.restabilizes, rel=tolerance)
    if math.isfinite(expected.value):
        assert found.frequency == pytest.approx(expected.frequency, rel=10 * tolerance)
        assert abs(found.value - expected.value) <= found.tolerance + 1e-11 * expected.value


# --- the rigid gantry, beside the reduction by hand ------------------------------------------------------------------


@pytest.mark.drawn(1)
@SIDE
@pytest.mark.parametrize("name", IMPLEMENTATIONS)
@pytest.mark.parametrize("damping", [0.0, 10.0, 100.0])
def test_stiffness_limits_of_the_rigid_gantry_are_those_by_hand(side, name, damping):
    found = contact(name, side).stability_limit(damping=damping)
    agree(found, stability_limit(by_hand(name, side), damping=damping))
    assert found.environment == {"damping": damping}


@pytest.mark.slow
@SIDE
def test_mass_limits_of_the_rigid_gantry_are_those_by_hand(side):
    agree(contact(side=side).stability_limit("mass"), stability_limit(by_hand(side=side), "mass"))
    # a tool acts in both directions: the lighter impedance, that along the path, breaks first
    found = contact(side=side).stability_limit("tool_mass")
    agree(found, stability_limit(by_hand(side="par"), "tool_mass"))
    np.testing.assert_allclose(np.abs(found.direction), [0.0, 1.0], atol=1e-6)


@SIDE
@pytest.mark.parametrize("name", IMPLEMENTATIONS)
@pytest.mark.drawn(1)
def test_admittance_and_passivity_of_the_rigid_gantry_are_those_by_hand(side, name):
    here, loop = contact(name, side), by_hand(name, side)
    omega = np.geomspace(0.1, 3000.0, 41)
    found = here.admittance(omega)
    expected = rendered_admittance(loop, omega)
    np.testing.assert_allclose(found.rendered, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(found.target, target_admittance(loop, omega), rtol=1e-14)
    p = here.passivity()
    intervals = negative_intervals(loop, *p.scanned)
    assert p.frequency == pytest.approx(intervals[0][0] if intervals else math.inf, rel=1e-9)
    np.testing.assert_allclose(np.reshape(p.intervals, (-1, 2)), np.reshape(intervals, (-1, 2)), rtol=1e-9)
    assert p.stable
    sign = passivity(loop)
    assert (sign.scanned, sign.caveat, sign.port) == (p.scanned, p.caveat, None)


def placed(eta, xi, **changes):
    """Fig. 3 at rest at a point of its path."""
    path = diagram()["controller.feedback_linearization"].path
    changes |= {"plant.start.position": path.to_plane(eta, xi)}
    changes |= {name: Reference(value, unit="m", name=name) for name, value in (("eta_d", eta), ("xi_d", xi))}
    return diagram().replace(changes)


@pytest.mark.drawn(1)
@SIDE
@pytest.mark.parametrize(("eta", "xi"), [(0.2, 0.0), (0.2, -0.02), (0.5, 0.02)])
@pytest.mark.parametrize("friction", [True, False])
@pytest.mark.parametrize("tool_mass", [0.0, 0.2])
def test_limits_beside_the_path_are_those_by_hand(side, eta, xi, friction, tool_mass):
    changes = {"sensors.force_sensor.tool_mass": tool_mass}
    if not friction:
        changes |= {f"plant.start.{name}": 0.0 for name in NO_FRICTION}
        changes["controller.feedback_linearization.model"] = gantry.nominal.replace(**NO_FRICTION)
    made = placed(eta, xi, **changes)
    here, loop = made.contact(direction=side), AdmittanceLoop.of(made, side, eta=eta, xi=xi)
    assert here.parts.tool_mass == tool_mass
    for vary, held in (("stiffness", {"damping": 10.0}), ("mass", {})):
        found, expected = here.stability_limit(vary, **held), stability_limit(loop, vary, **held)
        agree(found, expected, 1e-8)
    omega = np.geomspace(1.0, 3000.0, 11)
    np.testing.assert_allclose(here.admittance(omega).rendered, rendered_admittance(loop, omega), rtol=1e-7)
    np.testing.assert_allclose(here.admittance(omega).target, target_admittance(loop, omega), rtol=1e-9)


def test_the_delay_of_a_subsystem_counts():
    made = diagram().replace({"controller.delay": 1, "sensors.force_sensor.tool_mass": 0.1})
    loop = by_hand(tool_mass=0.1).replace(delay=1)
    for held in ({"damping": 10.0}, {"tool_mass": 0.2}):
        agree(made.contact().stability_limit(**held), stability_limit(loop, **held))


def test_a_block_as_plant_has_the_limits_of_its_fmu():
    block = gantry.nominal.replace(name="plant", start_position=(0.8, 0.5))
    found = diagram().replace({"plant": block}).contact().stability_limit(damping=10.0)
    agree(found, contact().stability_limit(damping=10.0))


@pytest.mark.slow
def test_differences_show_their_error(tmp_path):
    made = experiments.compliance(plant=undirected(gantry_elastic.build(), tmp_path)).diagram
    found = made.contact()
    exact = contact(plant=gantry_elastic).stability_limit()
    limit = found.stability_limit()
    assert str(found.derivation).startswith("differences")
    assert abs(limit.value - exact.value) <= limit.tolerance + exact.tolerance
    assert 1e-9 * limit.value < limit.tolerance < 0.01 * limit.value


@pytest.mark.slow
def test_the_first_sample_of_a_force_sensor_is_no_model_of_it():
    made = diagram().replace({"sensors.force_sensor.tool_mass": 0.2})  # at t = 0 it takes the acceleration as zero
    expected = stability_limit(AdmittanceLoop.of(made, "perp"), "mass")
    for at in (None, 0.0, made.operating_point(0.0), made.trim(), 5e-3):
        agree(made.contact(at=at).stability_limit("mass"), expected)


def test_stairs_are_taken_as_asked():
    made = experiments.compliance(encoder=1e-6).diagram
    blind, mean = made.contact(at=0.01, stairs="zero"), made.contact(at=0.01)
    assert any(isinstance(finding, StepsOnly) for finding in blind.findings)
    assert any(isinstance(finding, MeanSlope) for finding in mean.stability_limit(damping=10.0).findings)
    # velocities from differences come half a sample late, which costs some of the limit
    ratio = mean.stability_limit(damping=10.0).value / contact().stability_limit(damping=10.0).value
    assert 0.5 < ratio < 1.0


def test_a_vector_is_a_direction():
    found = diagram().contact(direction=(0.0, -3.0))
    agree(found.stability_limit(damping=10.0), contact(side="par").stability_limit(damping=10.0))
    assert found.admittance(1.0).target is None


def test_a_tool_breaks_the_other_direction_whatever_touches_the_robot():
    found = contact(side="perp").stability_limit(tool_mass=0.65)
    limit = contact(side="par").stability_limit("tool_mass")
    assert limit.value < 0.65
    assert (found.value, found.restabilizes) == (0.0, ())
    assert found.frequency == pytest.approx(limit.frequency, rel=1e-9)  # the Nyquist frequency
    np.testing.assert_allclose(np.abs(found.direction), [0.0, 1.0], atol=1e-6)  # along the path, beside the contact
    expected = growth_rate(by_hand(side="par"), tool_mass=0.65)
    assert found.growth_above == pytest.approx(expected, rel=1e-9)
    assert contact(side="par").stability_limit(tool_mass=0.65).value == 0.0


@pytest.mark.slow
@SIDE
def test_force_tracking_drifts_in_the_other_direction_and_has_its_limit(side):
    free = {name: FORCE_TRACKING[name].replace(name=f"admittance_{name}") for name in ("par", "perp")}
    made = diagram().replace({f"controller.admittance_{name}": block for name, block in free.items()})
    found = made.contact(direction=side)
    agree(found.stability_limit(damping=10.0), stability_limit(AdmittanceLoop.of(made, side), damping=10.0))
    slow = [p for p in found.loop("stiffness").modes.fixed if abs(p - 1.0) < 1e-7]
    assert len(slow) >= 1  # the drift of the other direction, which no growth rate counts


def test_the_wire_of_the_force_on_the_plant_is_a_measured_force():
    here = diagram().contact(force="free_space.y")
    assert (here.entry, here.parts.tool.sensor) == ("free_space.y", "sensors.force_sensor")
    for vary, held in (("stiffness", {"damping": 10.0}), ("tool_mass", {})):
        expected = contact().stability_limit(vary, **held).value
        assert here.stability_limit(vary, **held).value == pytest.approx(expected, rel=1e-9)


# --- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"port": "plant.external"}, UnknownNameError, "has no input 'external'. Did you mean 'external_force'"),
        ({"port": "robot.external_force"}, UnknownNameError, "found no block with the input 'robot.external_force'"),
        ({"position": "eta"}, OptionError, "expected the position of the contact, an output of 'plant'"),
        ({"position": "plant.velocity"}, ParameterError, "which is not the rate of 'velocity'"),
        ({"force": "v_par"}, ShapeError, "1 of the measured force 'v_par'; expected equal numbers"),
        ({"force": "position"}, OptionError, "found 'position' in m; expected the measured force in N"),
        ({"direction": "across"}, OptionError, "found 'across'; expected 'par', 'perp' or a vector"),
        ({"direction": (0.0, 0.0)}, OptionError, "expected a vector of 2 finite entries that is not zero"),
        ({"at": 1.2}, ParameterError, "found a point at which states change"),
        ({"when": 1.2}, UnknownNameError, "contact: it has no argument 'when'"),
    ],
)
def test_ports_that_make_no_contact_are_refused(arguments, error, words):
    with pytest.raises(error, match=re.escape(words)):
        diagram().contact(**arguments)


@pytest.mark.slow
def test_a_plant_without_a_model_of_its_equations_is_refused(tmp_path):
    made = experiments.compliance(plant=hidden(gantry.build(), tmp_path)).diagram
    with pytest.raises(ParameterError, match="An identified model does not do: it holds the force over a sample"):
        made.contact()


def test_a_map_has_the_growth_rates_and_limits_by_hand():
    stiffness, damping = np.geomspace(1e3, 1e5, 9), np.array([0.0, 10.0, 50.0])
    found = contact().stability_map(stiffness, damping)
    expected = growth_rate(by_hand(), stiffness=stiffness[None, :], damping=damping[:, None])
    fast = expected > -2.6  # there the modes of the other direction are slower
    assert np.count_nonzero(fast) > 5
    np.testing.assert_allclose(found.growth[fast], expected[fast], atol=1e-8)
    assert np.all((found.growth > 0.0) == (expected > 0.0))
    for limit, b in zip(found.limits, damping, strict=True):
        agree(limit, stability_limit(by_hand(), damping=b)._replace(restabilizes=()))
    broken = contact().stability_map(stiffness, [0.0], tool_mass=0.65)
    assert np.all(broken.growth > 0.0)  # of the other direction
    with pytest.raises(OptionError, match="expected positive ones that rise, two at least"):
        contact().stability_map([2.0, 1.0], damping)
    with pytest.raises(OptionError, match="among the held properties"):
        contact().stability_map(stiffness, damping, x="damping")


def test_properties_of_environments_are_checked():
    with pytest.raises(OptionError, match="an environment has no 'spring'"):
        contact().stability_limit("spring")
    with pytest.raises(OptionError, match="an environment has no 'stifness'. Did you mean 'stiffness'"):
        contact().stability_limit("mass", stifness=3.0)
    with pytest.raises(OptionError, match="among the held properties"):
        contact().stability_limit(stiffness=3.0)
    with pytest.raises(ParameterError, match="expected one finite number in N.s/m that is not negative"):
        contact().stability_limit(damping=-1.0)
    with pytest.raises(OptionError, match="expected at least 30"):
        contact().stability_limit(per_decade=10)
    with pytest.raises(OptionError, match="below the Nyquist frequency"):
        contact().admittance(4000.0)
