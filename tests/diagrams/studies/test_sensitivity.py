"""Sensitivities of margins to parameters of a diagram."""

from itertools import pairwise

import numpy as np
import pytest
from matplotlib.colors import to_hex

from loopwright.blocks import UnknownNameError
from loopwright.diagrams import experiments
from loopwright.diagrams.plotting import BLUE, VERMILION
from loopwright.diagrams.studies import confirm_parameter, confirm_sensitivity, sensitivities_of
from loopwright.frequency import margins
from support import reviewed
from support.tuned_loops import make_pi_loop, pi_phase_margin

NAMES = ["p.gain", "ki.gain", "rate.gain"]


def test_phase_margins_have_the_slopes_of_their_closed_form():
    values = np.array([1.0, 0.5, 2.0])
    found = make_pi_loop(*values).sensitivities("u", NAMES)
    h = 1e-3
    for i, name in enumerate(NAMES):
        moves = [values + s * h * np.eye(3)[i] for s in (1.0, -1.0, 2.0, -2.0)]
        a, b, c, d = (pi_phase_margin(*move) for move in moves)
        row = found[name, "phase_margin_deg"]
        slope = (8 * (a - b) - (c - d)) / (12 * h)
        assert row.slope.value == pytest.approx(slope, rel=1e-8)
        assert row.is_exact
        assert row.per_percent.value == pytest.approx(slope * values[i] / 100, rel=1e-8)
        assert row.relative == pytest.approx(slope * values[i] / pi_phase_margin(*values), rel=1e-8)
    largest = found.of("phase_margin_deg", 1)[0]
    sizes = [abs(found[name, "phase_margin_deg"].per_percent.value) for name in NAMES]
    assert abs(largest.per_percent.value) == pytest.approx(max(sizes), rel=1e-9)
    assert largest.parameter == "ki.gain"  # as large as that of p.gain, and before it by its name


def test_without_names_all_numbers_are_taken_and_zeros_are_told():
    found = make_pi_loop().sensitivities("u")
    assert {row.parameter for row in found} == set(NAMES)
    assert "r.value" in found.left_out
    assert "phase_margin_deg" in str(found)
    assert len(found.table()) == len(found)
    assert [t.get_text() for t in found.plot("ms").axes[0].get_yticklabels()]


def test_a_plot_has_our_colours_and_labels_that_stand_apart():
    figure = make_pi_loop().sensitivities("u", NAMES).plot("ms")
    axes = figure.axes[0]
    colours = {to_hex(bar.get_facecolor()).upper() for bar in axes.patches}
    assert colours <= {BLUE, VERMILION}
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in axes.get_xticklabels() if label.get_text()]
    inside = sorted((box.x0, box.x1) for box in boxes if axes.bbox.x0 - 1 <= (box.x0 + box.x1) / 2 <= axes.bbox.x1 + 1)
    assert len(inside) > 2
    assert all(before[1] + 3 < after[0] for before, after in pairwise(inside))


def test_parameters_that_change_nothing_are_named():
    found = make_pi_loop().replace({"r.value": 1.0}).sensitivities("u", ["r.value", "p.gain"])
    assert found.without_effect == ("r.value",)
    assert {row.parameter for row in found} == {"p.gain"}


def test_a_slope_is_confirmed_by_differences_of_the_margin():
    found = make_pi_loop().sensitivities("u", "p.gain")
    row = confirm_sensitivity(found, found["p.gain", "ms"])
    assert "differences of the margin" in row.slope.confirmed_by


def test_an_unstable_loop_has_no_sensitivities():
    found = make_pi_loop(kp=-2.0).sensitivities("u", "p.gain")
    assert not found.stable
    assert np.isnan(found["p.gain", "phase_margin_deg"].slope.value)
    assert found.of("phase_margin_deg") == []
    assert "unstable" in str(found)


def test_names_that_are_not_there_are_told_with_near_ones():
    diagram = make_pi_loop()
    with pytest.raises(UnknownNameError, match="Did you mean 'gain'"):
        diagram.sensitivities("u", "p.gian")
    found = diagram.sensitivities("u", "p.gain")
    with pytest.raises(UnknownNameError, match="phase_margin_deg"):
        found["p.gain", "phase_margin"]
    with pytest.raises(UnknownNameError, match="ms"):
        found.of("mss")


@pytest.mark.slow
def test_the_weakest_margin_of_fig3_leans_on_the_friction_that_is_compensated():
    """α at the motor forces, by an FMU's start value (differences) and by the model's (exact); each confirmed."""
    found = experiments.compliance().diagram.sensitivities(
        "motor_force", ["plant.coulomb_scale", "feedback_linearization.model.coulomb_scale", "pid_par.a2"]
    )
    for row in found:
        assert row.quantity == "disk_margin"
        assert row.number.value == pytest.approx(0.317, abs=1e-3)
        confirmed = confirm_sensitivity(found, row)
        assert confirmed.slope.tolerance < 1e-4 * abs(row.slope.value)
    assert found["plant.start.coulomb_scale", "disk_margin"].slope.value > 0.5
    assert found["model.coulomb_scale", "disk_margin"].slope.value < -1.0
    assert not found["plant.start.coulomb_scale", "disk_margin"].is_exact


@pytest.mark.slow
def test_a_margin_that_bends_over_the_step_of_the_differences_is_confirmed_by_their_limit():
    """An observer of a swinging load: plain differences over 1e-3 of an entry are off by 1.5e-3, and are no kink."""
    model = reviewed.crane().linearize(reviewed.CRANE_T)
    found = sensitivities_of(model, ("controller.force",))
    (row,) = confirm_parameter(found, "controller.observer.A[2,1]", ("disk_margin",))
    entry = model.diagram.blocks["controller.observer"].A[1][0]

    def margin(change):
        changed = np.array(model.diagram.blocks["controller.observer"].A, dtype=float)
        changed[1, 0] = entry + change
        loop = model.diagram.replace({"controller.observer.A": changed}).linearize(reviewed.CRANE_T).loop("force")
        return margins(loop).disk_margin.value

    h = 1e-5 * abs(entry)
    assert row.slope.value == pytest.approx((margin(h) - margin(-h)) / (2 * h), rel=1e-5)
    assert not row.kink
    assert "differences of the margin" in row.slope.confirmed_by
