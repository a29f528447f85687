"""General limits where a wire of a sampled loop lies between two blocks in continuous time: it has no loop at ticks."""

import cmath
import math
from functools import cache

import pytest
from scipy.optimize import brentq

from loopwright.blocks import PID, Gain, Step, TransferFunction, TransportDelay
from loopwright.diagrams import BetweenTicksError, Diagram, Requirements, subsystem
from loopwright.diagrams.requirements import Reason, Verdict
from support.reviewed import judge_again

T, LAG, GAIN, DEAD_TIME, KP, KI = 1.0, 60.0, 1.5, 7.3, 2.0, 0.03


def process(named=("power", "temperature"), local=0.0):
    """A sampled PI, an oven, and the dead time of the duct to the sensor; ``local`` feeds the oven back in itself."""
    oven = TransferFunction(numerator=[GAIN], denominator=[LAG, 1.0], name="oven")
    duct = TransportDelay(delay=DEAD_TIME, name="duct")

    @subsystem(sample_time=T)
    def heat(wish, measured):
        power = PID(kp=KP, ki=KI, name="pid")(r=wish, y=measured)
        return power.named("power") if "power" in named else power

    power = heat(Step(times=5.0, values=10.0, name="wish"), duct(oven.y))
    heated = oven(power - Gain(gain=local, name="loss")(oven.y) if local else power)
    return Diagram("process", heated.named("temperature") if "temperature" in named else heated)


def response(w):
    """L at the controller's output: modified z-transform of a lag behind 7 samples and 0.3 of one of dead time."""
    z, samples = cmath.exp(1j * w * T), math.floor(DEAD_TIME / T)
    whole, part = math.exp(-T / LAG), math.exp(-((samples + 1) * T - DEAD_TIME) / LAG)
    plant = GAIN * z ** -(samples + 1) * ((1 - part) * z + (part - whole)) / (z - whole)
    return (KP + KI * T / (z - 1)) * plant


@cache
def analysed():
    return results_of(process(), phase_margin_deg=45, ms=1.9)


def judged(**limits):
    found = judge_again(process(), analysed()[0], **limits)
    return found, {(r.loop, r.quantity): r for r in found.results}


def results_of(diagram, **limits):
    report = diagram.report(only=("poles", "inner"), requirements=Requirements(**limits))
    return report, {(r.loop, r.quantity): r for r in report.review.results}


def line_about(report, wire):
    (line,) = (text for text in report.sections[0].text if text.startswith(f"- The loop at {wire}:"))
    return line


@pytest.mark.slow
def test_a_general_limit_does_not_apply_between_ticks_where_the_loop_is_judged_at_another_wire():
    report, results = analysed()
    assert report.review.verdict is Verdict.PASSED, report.review.results
    assert sorted(key for key in results if key[0]) == [("power", "ms"), ("power", "phase_margin_deg")]
    crossover = brentq(lambda w: abs(response(w)) - 1.0, 1e-2, 1.0, xtol=1e-14)
    margin = 180.0 + math.degrees(cmath.phase(response(crossover)))
    assert results["power", "phase_margin_deg"].number.value == pytest.approx(margin, abs=1e-8)
    assert line_about(report, "temperature").endswith("; the same loop is judged at heat.power.")


def test_the_limit_at_the_other_wire_fails_where_the_margin_is_smaller():
    found, results = judged(phase_margin_deg=75)
    assert found.verdict is Verdict.FAILED
    assert [key[0] for key, result in results.items() if result.verdict is Verdict.FAILED] == ["power"]


def test_a_limit_of_the_very_wire_stays_open():
    found, results = judged(phase_margin_deg=45, loops={"temperature": {"phase_margin_deg": 45}})
    assert found.verdict is Verdict.UNDECIDED
    result = results["temperature", "phase_margin_deg"]
    assert (result.verdict, result.reason) == (Verdict.UNDECIDED, Reason.NO_NUMBER)
    assert "'temperature' changes between ticks" in result.detail
    assert results["power", "phase_margin_deg"].verdict is Verdict.PASSED


def test_a_loop_that_no_other_wire_judges_stays_open():
    report, results = results_of(process(named=("temperature",)), phase_margin_deg=45)
    assert report.review.verdict is Verdict.UNDECIDED
    assert results["temperature", "phase_margin_deg"].verdict is Verdict.UNDECIDED
    assert line_about(report, "temperature") == "- The loop at temperature: it has no margins here."


@pytest.mark.slow
def test_an_inner_loop_in_continuous_time_that_the_other_wire_does_not_cut_stays_open():
    report, results = results_of(process(local=0.2), phase_margin_deg=45)
    assert results["power", "phase_margin_deg"].verdict is Verdict.PASSED
    assert results["temperature", "phase_margin_deg"].verdict is Verdict.UNDECIDED
    assert report.review.verdict is Verdict.UNDECIDED


def test_general_limits_of_steps_are_judged_at_the_other_wire():
    asked = {"step": {"overshoot": 0.5}}
    report = process().report(only=("steps",), requirements=Requirements(**asked))
    assert [r.loop for r in report.review.results if r.quantity == "step.overshoot"] == ["power"]
    named = Requirements(**asked, loops={"temperature": asked})
    results = process().report(only=("steps",), requirements=named).review.results
    verdicts = {r.loop: r.verdict for r in results if r.quantity == "step.overshoot"}
    assert verdicts == {"power": Verdict.PASSED, "temperature": Verdict.UNDECIDED}


def test_a_loop_between_ticks_is_refused_by_an_error_of_its_own():
    with pytest.raises(BetweenTicksError, match="'temperature' changes between ticks"):
        process().linearize().loop("temperature")
