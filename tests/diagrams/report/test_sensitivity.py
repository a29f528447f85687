"""The section on sensitivity to parameters, of a loop with a closed form."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from loopwright.blocks import OptionError
from loopwright.diagrams import Requirements, analyse
from loopwright.diagrams.report.pages.definitions import definition
from loopwright.diagrams.requirements import Reason
from loopwright.diagrams.studies import CaseState, ConfirmationKind, RunConfirmation
from loopwright.types import Verdict
from support.tuned_loops import make_pi_loop, pi_phase_margin

pytestmark = pytest.mark.usefixtures("without_drawings")

NOTHING = Requirements(stable=False, phase_margin_deg=1.0)


@cache
def worst_phase_margin():
    """Return a loop, and its worst case over a range of one gain; its confirmation by injection takes seconds."""
    diagram = make_pi_loop()
    return diagram, diagram.worst_case(
        {"p.gain": (0.5, 2.0)}, "u", quantity="phase_margin_deg", count=2, starts=1, steps=1
    )


def test_the_section_tells_the_change_of_a_margin_per_percent_and_how_it_was_confirmed():
    report = analyse(make_pi_loop(1.0, 0.5, 2.0), only=("sensitivity",))
    (section,) = (s for s in report.sections if s.key == "sensitivity")
    (part,) = section.sections
    numbers = report.numbers()
    for i, name in enumerate(("p_gain", "ki_gain", "rate_gain")):
        number = numbers[f"sensitivity.u.{name}.phase_margin_deg_per_percent"]
        values, h = np.array([1.0, 0.5, 2.0]), 1e-4
        up, down = values.copy(), values.copy()
        up[i], down[i] = values[i] * (1 + h), values[i] * (1 - h)
        expected = (pi_phase_margin(*up) - pi_phase_margin(*down)) / (200 * h)
        assert number.value == pytest.approx(expected, rel=1e-6)
        assert "differences of the margin" in number.confirmed_by
        assert number.unit == "deg"
    assert len(part.tables[0].rows) == 3
    assert len(part.plots) == 1
    assert all(definition(path) is not None for path in numbers if path.startswith("sensitivity."))


def test_a_diagram_with_an_unstable_loop_has_no_such_section():
    report = analyse(make_pi_loop(kp=-2.0), only=("sensitivity",))
    assert [s.key for s in report.sections if s.key == "sensitivity"] == []


def test_a_worst_case_gets_a_section_with_the_run_that_confirms_it():
    diagram, found = worst_phase_margin()
    report = analyse(diagram, only=("subject",), worst_case=found)
    (section,) = (s for s in report.sections if s.key == "worst_case")
    number = report.numbers()["worst_case.worst.phase_margin_deg"]
    assert number.value == pytest.approx(pi_phase_margin(0.5, 0.5, 2.0), rel=1e-9)
    assert "injection" in number.confirmed_by
    assert ("p.gain", "0.5") in section.tables[1].rows
    assert definition("worst_case.worst.worst_growth") is not None


def test_a_stable_and_a_failed_worst_case_stand_on_the_first_page():
    diagram, found = worst_phase_margin()
    text = "\n".join(
        map(str, analyse(diagram, only=("subject",), worst_case=found, requirements=NOTHING).sections[0].text)
    )
    assert f"phase margin {pi_phase_margin(0.5, 0.5, 2.0):.4g}° at u" in text
    failed = replace(
        found, worst=replace(found.worst, state=CaseState.FAILED, reason="No point of rest.", loop=(), quantity="")
    )
    limits = Requirements(stable=False, numbers={"worst_case.worst.phase_margin_deg": (45.0, np.inf)})
    report = analyse(diagram, only=("subject",), worst_case=failed, requirements=limits)
    assert "not analysed. No point of rest." in "\n".join(map(str, report.sections[0].text))
    (result,) = report.review.results
    assert (result.verdict, result.reason, result.detail) == (
        Verdict.UNDECIDED,
        Reason.NOT_ANALYSED,
        "No point of rest.",
    )


def test_a_worst_case_that_no_run_confirms_is_told_on_the_first_page(monkeypatch):
    diagram, found = worst_phase_margin()
    page = partial(analyse, diagram, only=("subject",), worst_case=found, requirements=NOTHING)
    refuted = RunConfirmation(ConfirmationKind.INJECTION, "u", 3.0, found.worst.value, 47.65, agrees=False)
    monkeypatch.setattr(type(found), "confirm", lambda _: refuted)
    text = "\n".join(map(str, page().sections[0].text))
    assert "Not analysed, or less certain" in text
    assert f"The worst case over the parameters: the run does not confirm it ({refuted.trial})." in text
    monkeypatch.setattr(type(found), "confirm", lambda _: replace(refuted, agrees=True))
    assert "confirm" not in "\n".join(map(str, page().sections[0].text))

    def refuse(_):
        raise OptionError("found a loop cut at 2 wires. Simulate found.diagram.")

    monkeypatch.setattr(type(found), "confirm", refuse)
    text = "\n".join(map(str, page().sections[0].text))
    assert "The worst case over the parameters: no run confirms it: Found a loop cut at 2 wires." in text


def test_a_worst_case_of_another_diagram_is_refused():
    other = make_pi_loop(1.0, 0.5, 2.0).worst_case({"p.gain": (0.5, 2.0)}, "u", count=2, starts=0)
    with pytest.raises(OptionError, match="worst_case: found a worst case of another diagram"):
        analyse(make_pi_loop(2.0, 0.5, 2.0), only=("subject",), worst_case=other)


@pytest.mark.slow
def test_an_unstable_worst_case_stands_on_the_first_page_and_fails_its_requirements():
    # s(s + 2) + 2 (kp s + 0.5) has poles with the real part 0.5 at the corner kp = -1.5
    diagram = make_pi_loop()
    found = diagram.worst_case({"p.gain": (-1.5, 1.0)}, "u", quantity="ms", count=2, starts=1, steps=1)
    limits = Requirements(
        stable=False,
        numbers={"worst_case.worst.ms": (-np.inf, 2.0), "worst_case.worst.nonsense": (0.0, 1.0)},
    )
    report = analyse(diagram, only=("subject",), worst_case=found, requirements=limits)
    first = "\n".join(map(str, report.sections[0].text))
    assert "unstable at u" in first
    assert "it grows by 0.5 1/s" in first
    (section,) = (s for s in report.sections if s.key == "worst_case")
    assert ("p.gain", "-1.5", "1", "range, linear") in section.tables[-1].rows
    by_path = {result.quantity: result for result in report.review.results}
    failed = by_path["worst_case.worst.ms"]
    assert (failed.verdict, failed.reason) == (Verdict.FAILED, Reason.UNSTABLE)
    unknown = by_path["worst_case.worst.nonsense"]
    assert (unknown.verdict, unknown.reason) == (Verdict.UNDECIDED, Reason.NO_NUMBER)
