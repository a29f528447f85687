"""Open verdicts on the first page: the place that was named, the reason, and what would decide it."""

import re

import control
import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    Encoder,
    Gain,
    Input,
    Integrator,
    Output,
    Saturation,
    State,
    StateSpace,
    UnitConversion,
)
from loopwright.diagrams import Diagram, Requirements, subsystem
from loopwright.diagrams.cli.report import verdict_text
from loopwright.diagrams.report.pages.page_tables import Numbered
from loopwright.diagrams.requirements import Limit, Reason, RequirementResult, Verdict, by_loop

pytestmark = pytest.mark.usefixtures("without_drawings")


def spring(start=0.0):
    """s² + 3 s + 40: L = (3 s + 40)/s² at the command of a double integrator."""
    place, speed = Integrator(initial_value=start, name="place"), Integrator(name="speed")
    law = (Constant(value=0.0, name="wish") - (3.0 * speed.y + 40.0 * place.y)).named("u")
    return Diagram("spring", place(speed(law)))


def row_of(report, quantity):
    for section in report.sections:
        for table in section.tables:
            if table.title == "Requirements" or "required" in table.columns:
                for row in table.rows:
                    if quantity in str(row[1]):
                        return [str(cell) for cell in row[:3]]
    raise AssertionError(quantity)


def test_the_place_of_a_step_stays_where_its_response_has_not_settled():
    step = {"input": "u", "output": "place.y", "length": 0.3, "settling": 5.0}
    report = spring().report(only=("steps",), requirements=Requirements(stable=False, step=step))
    verdict, _, at = row_of(report, "settling")
    assert re.fullmatch(r"u → place\.y: a step of 0\.0\d+, chosen small", at)
    assert verdict == "not decided: the response has not settled in its record of 0.3 s; give a longer length"
    (result,) = report.review.results
    assert (result.reason, result.place, result.detail) == (Reason.NOT_SETTLED, "u → place.y", "0.3 s")
    assert "has not settled in its record of 0.3 s; give a longer length" in verdict_text(report.review)


def test_the_place_of_a_step_stays_where_the_operating_point_moves():
    step = {"input": "u", "output": "place.y", "settling": 5.0}
    report = spring(start=0.1).report(only=("steps",), requirements=Requirements(stable=False, step=step))
    verdict, _, at = row_of(report, "settling")
    assert re.fullmatch(r"u → place\.y: a step of 0\.0\d+, chosen small", at)
    assert verdict == "not decided: the operating point moves (speed); give one at rest, such as at=diagram.trim(…)"


def test_a_response_that_was_not_measured_says_why():
    step = {"input": "y", "output": "plant.y", "settling": 5.0}
    plant = StateSpace(
        A=[[-1.0, 0.0], [0.0, -2.0]], B=[[1.0, 0.0], [0.0, 1.0]], C=[[1.0, 0.0], [0.0, 1.0]], name="plant"
    )
    diagram = Diagram("two", plant(Gain(gain=-1.0, name="minus")(plant.y.named("y"))))
    report = diagram.report(only=("steps",), requirements=Requirements(stable=False, step=step))
    verdict, _, at = row_of(report, "settling")
    assert at == "y → plant.y"
    assert verdict.startswith("not decided: no response was measured: ")
    assert "Found 2 entries. To change it: Name one of them" in verdict


def limited(limit):
    """The spring, whose command is limited: a step of 1 % of 1 + its size, which is taken where none is given, isn't small."""
    place, speed = Integrator(name="place"), Integrator(name="speed")
    law = (Constant(value=0.0, name="wish") - (3.0 * speed.y + 40.0 * place.y)).named("u")
    return Diagram("limited", place(speed(Saturation(lower=-limit, upper=limit, name="drive")(law))))


@pytest.mark.slow
def test_a_step_of_no_given_size_is_small_enough_for_the_linear_model():
    """T = (3 s + 40)/(s² + 3 s + 40)."""
    asked = Requirements(loops={"u": {"step": {"overshoot": 1.0}}})
    report = limited(1e-3).report(only=("steps",), requirements=asked)
    t = np.linspace(0.0, 2.0, 20001)
    expected = control.step_response(control.tf([3.0, 40.0], [1.0, 3.0, 40.0]), t).y.max() - 1.0
    number = report.numbers()["steps.u.continuous.overshoot"]
    assert number.value == pytest.approx(expected, abs=max(number.tolerance, 1e-4))
    assert report.numbers()["steps.u.continuous.difference"].value < 0.01
    assert [result.verdict for result in report.review.results if result.loop == "u"] == [Verdict.PASSED]


@pytest.mark.slow
def test_a_step_that_is_never_small_is_open_where_run_and_linear_model_differ_about_the_limit():
    asked = Requirements(loops={"u": {"step": {"overshoot": 1.0, "settling": 3.0}}})
    review = limited(1e-9).report(only=("steps",), requirements=asked).review
    (settling,) = (result for result in review.results if result.quantity == "step.settling")
    assert (settling.verdict, settling.reason) == (Verdict.UNDECIDED, Reason.SIZE_NOT_GIVEN), settling
    assert "give the size for which the limit holds, size=…" in verdict_text(review)


@pytest.mark.slow
def test_reasons_of_open_verdicts_stand_below_the_table_each_once():
    step = {"input": "u", "output": "place.y", "length": 0.3, "settling": 5.0, "rise": 2.0}
    report = spring().report(only=("steps",), requirements=Requirements(stable=False, step=step, delay_margin_s=0.1))
    (table,) = (table for table in report.sections[0].tables if table.title == "Requirements")
    shown = Numbered(report.numbers()).view(table)
    rows = {row[1].text: row for row in shown.rows}
    assert {row[0].text for row in rows.values()} == {"not decided"}
    assert rows["settling time, 2 %"][0].letter == rows["rise time, 10 to 90 %"][0].letter
    reasons = {note.letter: note.text for note in shown.reasons}
    assert reasons[rows["settling time, 2 %"][0].letter] == (
        "The response has not settled in its record of 0.3 s; give a longer length."
    )
    assert reasons[rows["delay margin"][0].letter].startswith("The report has no such number")
    assert len(reasons) == 2
    assert rows["delay margin"][4].text == "≥ 0.1 s"


@pytest.mark.parametrize(
    ("quantity", "required"),
    [
        ("phase_margin_deg", "≥ 45°"),
        ("delay_margin_s", "≥ 45 s"),
        ("delay_margin_samples", "≥ 45 samples"),
        ("bandwidth", "≥ 45 rad/s"),
        ("ms", "≥ 45"),
        ("inner.u.sampled_d0.phase_margin_deg", "≥ 45°"),
        ("step.rise", "≥ 45 s"),
        ("stable", "≥ 45 1/s"),
    ],
)
def test_a_limit_has_the_unit_of_its_quantity_without_a_number(quantity, required):
    limit = Limit(45.0, np.inf)
    assert RequirementResult(quantity, "u", "", limit, Verdict.UNDECIDED, Reason.NO_NUMBER).required == required


def test_the_limit_of_a_largest_change_that_was_not_measured_has_the_unit_of_its_wire():
    plant = StateSpace(
        A=[[-1.0, 0.0], [0.0, -2.0]], B=[[1.0, 0.0], [0.0, 1.0]], C=[[1.0, 0.0], [0.0, 1.0]], name="plant"
    )
    back = Gain(gain=-1.0, name="minus")(plant.y.named("y"))
    way = UnitConversion(from_unit="mm", to_unit="m", name="way")(Constant(value=1.0, unit="mm", name="one"))
    diagram = Diagram("two", plant(back), way)
    step = {"input": "y", "output": "way.y", "peak": 5.0}
    report = diagram.report(only=("steps",), requirements=Requirements(stable=False, step=step))
    assert [(r.verdict, r.required) for r in report.review.results] == [(Verdict.UNDECIDED, "≤ 5 m")]


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("size", "holds"), [(1e-4, True), (1.0, False)])
def test_a_required_response_that_the_linear_model_does_not_have_is_named_on_the_first_page(size, holds):
    """The drive reaches its limit of 0.4 at a step of 0.01 and more: its acceleration is 40 of the step, at first."""
    step = {"input": "wish.y", "output": "place.y", "size": size, "overshoot": 1.0}
    report = limited(0.4).report(only=("steps",), requirements=Requirements(stable=False, step=step))
    difference = report.numbers()["steps.wish_y_to_place_y.continuous.difference"].value
    lines = [text for text in report.sections[0].text if "does not hold at this step" in text]
    assert (difference < 0.01) == holds
    said = (
        "- wish.y → place.y: the linear model does not hold at this step; the signal that differs most from the run, "
    )
    said += f"the response or a command on the way to it, differs by {difference:.2g} of its largest change."
    assert lines == ([] if holds else [said])


def test_requirements_of_a_loop_stand_together_behind_those_that_fail():
    def result(loop, distance, verdict=Verdict.PASSED):
        return RequirementResult("ms", loop, "", Limit(-np.inf, 1.0), verdict, Reason.COMPARED, distance)

    failed = [result("b", -0.3, Verdict.FAILED), result("a", -0.2, Verdict.FAILED), result("b", -0.1, Verdict.FAILED)]
    passed = [result("a", 0.1), result("b", 0.2), result("a", 0.3), result("c", 0.4), result("b", 0.5)]
    found = by_loop([*failed, *passed])
    assert found[:3] == failed
    assert [(r.loop, r.distance) for r in found[3:]] == [("a", 0.1), ("a", 0.3), ("b", 0.2), ("b", 0.5), ("c", 0.4)]


def test_a_required_margin_that_no_loop_has_is_open_where_a_feedback_wire_is_missing():
    plant = StateSpace(A=[[-1.0]], B=[[1.0]], C=[[1.0]], name="plant")
    diagram = Diagram("open", plant(Gain(gain=2.0, name="kp")(Constant(value=(0.0,), name="wish")).named("u")))
    review = diagram.report(only=("inner", "poles"), requirements=Requirements(phase_margin_deg=45)).review
    (margin,) = (result for result in review.results if result.quantity == "phase_margin_deg")
    assert (margin.verdict, margin.reason) == (Verdict.UNDECIDED, Reason.NO_NUMBER)
    assert "is a feedback wire missing?" in verdict_text(review)


@pytest.mark.slow
def test_a_required_margin_that_a_loop_of_several_entries_has_not_is_open():
    """Two axes, L = 2/(s (s + 0.2)) each: 8 degrees of phase margin by hand, which nobody would see."""
    speed = StateSpace(A=np.zeros((2, 2)), B=np.eye(2), C=np.eye(2), name="speed")
    place = StateSpace(A=np.zeros((2, 2)), B=np.eye(2), C=np.eye(2), name="place")
    diagram = Diagram("axes", speed((-2.0 * place.y).named("force") - 0.2 * speed.y), place(speed.y))
    review = diagram.report(only=("inner", "poles"), requirements=Requirements(phase_margin_deg=45, ms=2.0)).review
    found = {result.quantity: (result.verdict, result.reason) for result in review.results}
    assert found["phase_margin_deg"] == (Verdict.UNDECIDED, Reason.NO_NUMBER)
    assert review.verdict is not Verdict.PASSED
    asked = Requirements(disk_margin=0.05)
    assert diagram.report(only=("inner", "poles"), requirements=asked).review.verdict is Verdict.PASSED


class Drive(Block):
    """ẍ = 50 (u − ẋ)."""

    u = Input()
    angle = State(output=True)
    speed = State(output=True)
    power = Output()

    def derivative(self, t, x, u):
        return x.speed, 50.0 * (u.u - x.speed)

    def output(self, t, x, u):
        return x.speed * u.u


@pytest.mark.slow
def test_a_wire_that_counts_at_the_start_alone_lies_on_no_loop():
    """Speed and power of a drive, named for a plot: limits on them stayed open, as the drive itself is in a loop.

    An encoder takes the speed, at its first tick.
    """
    drive = Drive(name="drive")

    @subsystem(sample_time=0.1, name="controller")
    def controller(position, velocity):
        measured, rate = Encoder(quantum=1e-6, name="encoder")(position, velocity)
        return (-2.0 * measured - 0.1 * rate).named("u")

    driven = drive(controller(drive.angle, drive.speed.named("omega")))
    diagram = Diagram("loop", driven.power.named("power"))
    review = diagram.report(only=("inner", "poles"), requirements=Requirements(phase_margin_deg=45)).review
    margins = [result for result in review.results if result.quantity == "phase_margin_deg"]
    assert [(result.verdict, result.loop.rpartition(".")[2]) for result in margins] == [(Verdict.PASSED, "u")]


def test_stability_without_the_chapter_on_poles_says_that_it_was_left_out():
    plant = StateSpace(A=[[-1.0]], B=[1.0], C=[1.0], D=0.0, name="plant")
    diagram = Diagram("one", plant(Gain(gain=-1.0, name="minus")(plant.y.named("y"))))
    report = diagram.report(only=("inner",), requirements=Requirements(phase_margin_deg=30.0))
    assert "Its chapter was left out: add 'poles' to only=" in str(report.review)
