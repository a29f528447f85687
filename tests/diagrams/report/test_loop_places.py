"""The place at which a report cuts a loop: at the plant's input, where the wire also feeds a model of the controller."""

import numpy as np
import pytest

from loopwright.blocks import OptionError, UnknownNameError, WiringError
from loopwright.diagrams import Requirements
from loopwright.diagrams.requirements import Verdict
from support.predictors import T, observed, observed_by_hand, smith, smith_by_hand

pytestmark = pytest.mark.usefixtures("without_drawings")

INNER = ("inner",)
Z = np.exp(1j * T * np.linspace(1e-3, np.pi / T, 20001))


def peak(values):
    """Return M_s of the values of a loop."""
    return float(np.max(1.0 / np.abs(1.0 + values)))


def said(report):
    parts = [report.sections[-1], *report.sections[-1].sections]
    return " ".join(text for part in parts for text in part.text)


def verdicts(report, quantity="ms"):
    return [r.verdict for r in report.review.results if r.quantity == quantity]


def test_a_report_has_the_loop_at_the_plants_input_and_says_what_the_wire_has():
    at_plant, everywhere = (peak(system(Z)) for system in smith_by_hand())
    assert everywhere < 1.2 < 1.7 < at_plant  # the cut for all consumers would pass
    report = smith().report(only=INNER, requirements=Requirements(ms=1.7))
    number = report.numbers()["inner.u.sampled_d0.ms"]
    assert number.value == pytest.approx(at_plant, rel=1e-3)
    assert number.findings == ()
    assert verdicts(report) == [Verdict.FAILED]
    assert (
        "This loop is cut at plant.u alone. controller.u also feeds controller.model.u, by which the controller"
        in said(report)
    )
    assert f"Cut for all consumers of controller.u it has: phase margin 77.96°, M_s {everywhere:.4g}." in said(report)
    assert report.sections[-1].sections[0].title == "Loop at controller.u → plant.u"


@pytest.mark.parametrize("to", ["plant.u", ["plant.u"], []])
@pytest.mark.drawn(2)
def test_requirements_name_the_place(to):
    w = np.geomspace(0.01, 100.0, 40001)
    by_hand = peak(observed_by_hand(1j * w))
    asked = Requirements(loops={"u": {"ms": 1.2, "to": to}})
    report = observed(boxed=False).report(only=INNER, requirements=asked)
    number = report.numbers()["inner.u.continuous.ms"]
    assert number.value == pytest.approx(by_hand if to else 1.0, rel=1e-4)
    assert verdicts(report) == [Verdict.FAILED if to else Verdict.PASSED]


def test_of_equal_blocks_a_report_has_the_loops_at_each():
    text = said(observed(boxed=False).report(only=INNER))
    assert "u is cut for all its consumers. The loops at one of them alone have: at plant.u phase margin 50.82°" in text
    assert "requirements can name it as `to`" in text


def test_the_step_of_a_predictor_is_added_at_the_plants_input():
    """The response of T = L/(1 + L) at the plant's input; at all consumers it would be that without dead time."""
    at_plant, _ = smith_by_hand()
    numbers = smith().report(only=("steps",)).numbers()
    linear, measured = (numbers[f"steps.u.sampled_d0.{name}overshoot"] for name in ("linear.", ""))
    import control

    _, y = control.step_response(control.minreal(at_plant / (1 + at_plant), 1e-4, verbose=False), np.arange(0, 60, T))
    assert linear.value == pytest.approx(float(np.max(y)) - 1.0, abs=2e-3)
    assert measured.value == pytest.approx(linear.value, abs=1e-6)


@pytest.mark.slow
def test_a_worst_case_is_looked_for_at_the_place_that_is_required():
    by_hand = peak(smith_by_hand(gain=1.5)[0](Z))
    asked = Requirements(loops={"u": {"ms": 1.7, "to": "plant.u"}})
    ranges = {"plant.numerator[1]": [1.1, 1.3, 1.5]}
    found = smith().worst_case(ranges, "u", requirements=asked, samples="grid", starts=0)
    assert found.worst.value == pytest.approx(by_hand, rel=1e-3)
    assert found.confirm().agrees


@pytest.mark.slow
def test_a_files_worst_case_is_looked_for_where_the_report_cuts_the_loop(tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text(
        'ms = 1.7\n[worst_case]\nloop = "u"\nsamples = "grid"\nstarts = 0\n'
        '[worst_case.ranges]\n"plant.numerator[1]" = [1.1, 1.3, 1.5]\n'
    )
    report = smith().report(only=INNER, requirements=file)
    assert report.numbers()["worst_case.worst.ms"].value == pytest.approx(peak(smith_by_hand(gain=1.5)[0](Z)), rel=1e-3)


def test_mistakes_name_the_entry(tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text('[loops.u]\nms = 1.5\nto = "plant.force"\n')
    with pytest.raises(UnknownNameError, match=r"limits\.toml, line 3: loops\.u\.to.*there is no input 'plant\.force'"):
        smith().report(only=INNER, requirements=file)
    with pytest.raises(WiringError, match=r"controller\.late\.u: found .* wired to it; expected 'controller\.u'"):
        smith().report(only=INNER, requirements=Requirements(loops={"u": {"ms": 1.5, "to": ["controller.late.u"]}}))
    with pytest.raises(OptionError, match=r"to: found it for all loops; expected it for one"):
        Requirements(ms=1.5, to="plant.u")
    with pytest.raises(OptionError, match=r"variants\.sampled_d1\.to: found it for a variant"):
        Requirements(loops={"u": {"variants": {"sampled_d1": {"ms": 1.5, "to": "plant.u"}}}})
    with pytest.raises(OptionError, match=r"loops\.u\.to: found 3; expected inputs of blocks"):
        Requirements(loops={"u": {"ms": 1.5, "to": 3}})
