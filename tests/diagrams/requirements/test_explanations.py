"""Every open verdict says why, and what would decide it."""

import math

import pytest

from loopwright.diagrams.frequency import Number
from loopwright.diagrams.linearization import SharedCut
from loopwright.diagrams.requirements import Limit, Reason, RequirementResult, Verdict, explain

LEAST = Limit(40.0, math.inf)


def result(reason, quantity="phase_margin_deg", variant="sampled_d0", verdict=Verdict.UNDECIDED, **more):
    return RequirementResult(quantity, "u", variant, LEAST, verdict, reason, **more)


@pytest.mark.parametrize("reason", [r for r in Reason if r not in (Reason.COMPARED, Reason.UNSTABLE)])
@pytest.mark.parametrize("quantity", ["phase_margin_deg", "step.overshoot"])
def test_an_open_verdict_has_a_reason_and_a_next_step(reason, quantity):
    why, _, step = explain(result(reason, quantity)).partition("; ")
    assert why
    assert step
    assert not step.endswith(".")


def test_the_limit_within_a_tolerance_is_shown_with_it():
    number = Number(40.1, "deg", 0.25, "eigenvalues; tolerance: from the error of its FMUs' linear models")
    said = explain(result(Reason.WITHIN_TOLERANCE, number=number))
    assert "the limit is within the number's tolerance, 39.85 … 40.35; " in said
    assert "an FMU with derivatives of its own" in said
    step = explain(result(Reason.WITHIN_TOLERANCE, "step.settling", number=Number(40.1, "s", 0.25, "a run")))
    assert step.endswith("give a longer length or a larger size, or a limit farther away")


def test_a_finding_is_named_where_80_degrees_are_not_enough_for_40():
    finding = SharedCut("u", ("plant.u",), ("model.u",))
    number = Number(80.0, "deg", 1e-6, "eigenvalues", findings=(finding,))
    said = explain(result(Reason.FINDINGS, number=number))
    assert said.startswith(f"the linear model leaves something out (†): {finding}; limit a step response")


def test_a_number_that_does_not_exist_says_why():
    number = Number(math.nan, "deg", math.nan, "the loop crosses no circle")
    assert explain(result(Reason.NO_VALUE, number=number)) == (
        "the number does not exist here: the loop crosses no circle; limit another margin, such as disk_margin"
    )


def test_decided_verdicts_need_no_step():
    assert explain(result(Reason.COMPARED, verdict=Verdict.PASSED)) == ""
    assert explain(result(Reason.UNSTABLE, verdict=Verdict.FAILED)) == "unstable"


def test_the_environment_of_a_contact_is_no_interval():
    number = Number(5.1e4, "N/m", 2e3, "poles")
    said = explain(result(Reason.WITHIN_TOLERANCE, "contact.stiffness", "contact", number=number, detail="damping 10"))
    assert said == "the limit is within the number's tolerance, 49000 … 53000; give a limit farther away"


def test_a_worst_case_names_its_own_run_and_point():
    assert explain(result(Reason.REFUTED, variant="worst_case")) == (
        "the nonlinear run contradicts the linear model; the run counts: look at it"
    )
    assert explain(result(Reason.MOVING, variant="worst_case")).endswith("such as at=lambda d: d.trim(…)")
    assert explain(result(Reason.NO_VALUE, variant="worst_case", number=Number(80.0, "deg", 1e-6, "eigenvalues"))) == (
        "one of the cases has no such number; limit another margin, such as disk_margin"
    )
