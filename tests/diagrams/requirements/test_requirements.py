"""Requirements: limits by loop and variant, verdicts on numbers, TOML files, and errors that say what to write."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.blocks import OptionError
from loopwright.diagrams import Requirements
from loopwright.diagrams.requirements import (
    Limit,
    Reason,
    RequirementResult,
    Review,
    StepLimits,
    judge,
    read_requirements,
)
from loopwright.diagrams.requirements.verdict_table import row_of
from loopwright.frequency import Number
from loopwright.types import Kink, Verdict

OPEN = math.inf
KINK = Kink("valve", "y", "u", 0.0, 1.0)


def number(value, tolerance=1e-9, confirmed_by="closed-loop eigenvalues", **more):
    return Number(value, "1", tolerance, confirmed_by, **more)


@pytest.mark.parametrize(
    ("value", "tolerance", "limit", "verdict", "distance"),
    [
        (50.0, 1e-9, Limit(45.0, OPEN), Verdict.PASSED, 5.0),
        (40.0, 1e-9, Limit(45.0, OPEN), Verdict.FAILED, -5.0),
        (1.75, 1e-9, Limit(-OPEN, 1.6), Verdict.FAILED, -0.15),
        (120.0, 1e-6, Limit(50.0, 200.0), Verdict.PASSED, 70.0),
        (190.0, 1e-6, Limit(50.0, 200.0), Verdict.PASSED, 10.0),
        (210.0, 1e-6, Limit(50.0, 200.0), Verdict.FAILED, -10.0),
        (45.5, 1.0, Limit(45.0, OPEN), Verdict.UNDECIDED, 0.5),
        (44.5, 1.0, Limit(45.0, OPEN), Verdict.UNDECIDED, -0.5),
        (math.inf, 0.0, Limit(2.0, OPEN), Verdict.PASSED, math.inf),
        (math.inf, 0.0, Limit(50.0, 200.0), Verdict.FAILED, -math.inf),
        (45.0, 0.0, Limit(45.0, OPEN), Verdict.PASSED, 0.0),
    ],
)
def test_a_number_passes_or_fails_with_its_tolerance(value, tolerance, limit, verdict, distance):
    found, reason, off = judge(number(value, tolerance), limit)
    assert found is verdict
    assert off == pytest.approx(distance)
    assert reason is (Reason.WITHIN_TOLERANCE if verdict is Verdict.UNDECIDED else Reason.COMPARED)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (number(math.nan), Reason.NO_VALUE),
        (number(50.0, math.nan), Reason.NO_VALUE),
        (number(50.0, math.inf), Reason.NO_VALUE),
        (number(50.0, 0.0, ""), Reason.NOT_CONFIRMED),
        (number(50.0, findings=(KINK,)), Reason.FINDINGS),
    ],
)
def test_a_number_that_is_not_known_is_never_passed(bad, reason):
    verdict, why, _ = judge(bad, Limit(45.0, OPEN))
    assert verdict is Verdict.UNDECIDED
    assert why is reason


def test_a_number_that_leaves_something_out_can_still_fail():
    assert judge(number(40.0, findings=(KINK,)), Limit(45.0, OPEN))[0] is Verdict.FAILED


@settings(deadline=None)  # a busy machine is no failure
@given(
    st.floats(),
    st.floats(min_value=0.0),
    st.floats(-1e6, 1e6),
    st.floats(0.0, 1e6),
    st.sampled_from(["", "eigenvalues"]),
)
def test_whatever_passes_is_within_the_limits_by_its_tolerance_and_confirmed(value, tolerance, low, width, how):
    limit = Limit(low, low + width)
    verdict, _, _ = judge(number(value, tolerance, how), limit)
    rounding = 4 * math.ulp(max(abs(value), tolerance, abs(limit.low), abs(limit.high)))  # of sums
    if verdict is Verdict.PASSED:
        assert how
        assert limit.low <= value - tolerance + rounding
        assert value + tolerance <= limit.high + rounding
    if verdict is Verdict.FAILED:
        assert value + tolerance < limit.low + rounding or value - tolerance > limit.high - rounding


def test_limits_of_a_loop_and_a_variant_replace_the_general_ones():
    asked = Requirements(
        phase_margin_deg=45,
        ms=1.6,
        loops={"u": {"ms": 2.0, "variants": {"sampled_d1": {"ms": 3.0}}}},
        variants={"sampled_d1": {"phase_margin_deg": 30}},
    )
    assert asked.limits_of(["v"], "sampled_d0") == {"phase_margin_deg": Limit(45, OPEN), "ms": Limit(-OPEN, 1.6)}
    assert asked.limits_of(["u"], "sampled_d0") == {"phase_margin_deg": Limit(45, OPEN), "ms": Limit(-OPEN, 2.0)}
    assert asked.limits_of(["v"], "sampled_d1") == {"phase_margin_deg": Limit(30, OPEN), "ms": Limit(-OPEN, 1.6)}
    assert asked.limits_of(["u"], "sampled_d1") == {"phase_margin_deg": Limit(30, OPEN), "ms": Limit(-OPEN, 3.0)}
    assert asked.further_variants == ("sampled_d1",)
    assert asked.limits_named(["u"], "sampled_d1") == {"ms": Limit(-OPEN, 3.0)}


def test_the_step_of_a_loop_replaces_the_general_one_and_steps_between_wires_stand_beside():
    between = {"input": "r", "output": "y", "settling": 0.5}
    asked = Requirements(step=[{"overshoot": 0.3}, between], loops={"u": {"step": {"overshoot": 0.1, "size": 2.0}}})
    assert asked.step_of(["v"], "sampled_d0").limits == {"overshoot": Limit(-OPEN, 0.3)}
    assert asked.step_of(["u"], "sampled_d0").limits == {"overshoot": Limit(-OPEN, 0.1)}
    assert asked.step_of(["u"], "sampled_d0").size == 2.0
    (other,) = asked.steps
    assert (other.input, other.output, other.limits) == ("r", "y", {"settling": Limit(-OPEN, 0.5)})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"phase_margin": 45}, "there is no requirement 'phase_margin'. Did you mean 'phase_margin_deg'"),
        ({"gain_margin_db": 6.0}, "Gain margins are factors: write gain_margin_high=1.995, which is 6 dB"),
        ({"gain_margin": 2.0}, "write gain_margin_high=2.0, which is 6 dB, and gain_margin_low=0.5"),
        ({"overshoot": 0.1}, "It is one of a step response: step={'overshoot': 0.1}"),
        ({"step": {"overshoot": 10}}, "step.overshoot: found 10, which is 1000 % of the final change"),
        ({"step": {"overshoot": 10}}, "Give overshoot = 0.1 for 10 %, or the range (0, 10) for 1000 %."),
        (
            {"gain_margin_high": 0.5},
            "gain_margin_high: found 0.5, which every stable loop meets; expected a factor above 1",
        ),
        (
            {"gain_margin_low": 1.0},
            "gain_margin_low: found 1, which every stable loop meets; expected a factor below 1",
        ),
        ({"settling_time": 0.5}, "It is one of a step response: step={'settling': 0.5}"),
        ({"ms": "1.6"}, "ms: found '1.6'; expected a number (at most), or two: low and high"),
        ({"ms": True}, "ms: found True; expected a number"),
        ({"ms": math.nan}, "ms: found nan; expected a number"),
        ({"ms": math.inf}, "ms: found inf, which limits nothing"),
        ({"bandwidth": (200, 50)}, "found (200, 50); expected a range with low ≤ high"),
        ({"bandwidth": (1, 2, 3)}, "expected a number (at least), or two"),
        ({"step": {}}, "step: found no limit; expected some of overshoot, settling, rise, peak"),
        ({"step": {"overshot": 0.1}}, "a step response has no 'overshot'. Did you mean 'overshoot'"),
        ({"step": {"overshoot": 0.1, "size": 0}}, "step.size: found 0; expected a number that is not 0"),
        (
            {"step": {"overshoot": 0.1, "output": "z"}},
            "step.output: found the output 'z' without an input; expected neither",
        ),
        (
            {"loops": {"u": {"step": {"rise": 0.1, "input": "z"}}}},
            "loops.u.step.input: found an input; expected neither",
        ),
        (
            {"variants": {"sampled_d1": {"step": {"rise": 0.1, "output": "z"}}}},
            "variants.sampled_d1.step.output: found",
        ),
        ({"loops": {"u": 3}}, "loops.u: found 3; expected limits by name"),
        ({"loops": {"u": {"mss": 3}}}, "loops.u.mss: there is no requirement 'mss'. Did you mean 'ms'"),
        ({"numbers": {"poles.sampled_d0.slowest": -1.0}}, "found -1.0; expected two numbers, low and high"),
        ({"stable": 1}, "stable: found 1; expected true, false or 'every state'"),
        ({"stable": "always"}, "stable: found 'always'; expected true, false or 'every state'"),
    ],
)
def test_wrong_requirements_are_refused_with_the_next_step(wrong, said):
    with pytest.raises(OptionError) as caught:
        Requirements(**wrong)
    assert said in str(caught.value)


TOML = """
phase_margin_deg = 45
bandwidth = [50, 200]
variants = ["sampled_d1"]
stable = true

[step]
overshoot = 0.3

[loops.u]
ms = 1.6
[loops.u.step]
settling = 0.5
"""


def test_a_toml_file_says_the_same_as_code(tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text(TOML, encoding="utf-8")
    found = read_requirements(file)
    said = Requirements(
        phase_margin_deg=45,
        bandwidth=(50, 200),
        variants=["sampled_d1"],
        step={"overshoot": 0.3},
        loops={"u": {"ms": 1.6, "step": {"settling": 0.5}}},
    )
    for names, variant in ((["u"], "sampled_d0"), (["v"], "sampled_d1")):
        assert found.limits_of(names, variant) == said.limits_of(names, variant)
        assert found.step_of(names, variant).limits == said.step_of(names, variant).limits
    assert found.further_variants == said.further_variants


def test_a_file_may_ask_for_stability_alone(tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text("stable = true", encoding="utf-8")
    assert read_requirements(file).stable
    file.write_text("stable = false", encoding="utf-8")
    with pytest.raises(OptionError, match="requires nothing"):
        read_requirements(file)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ms = ", "is not TOML"),
        ("", "requires nothing"),
        ("variants = ['sampled_d1']", "requires nothing"),
        ("mss = 1.6", "limits.toml, line 1: mss: there is no requirement 'mss'. Did you mean 'ms'"),
    ],
)
def test_a_file_that_requires_nothing_or_something_unknown_is_refused(tmp_path, text, said):
    file = tmp_path / "limits.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(OptionError) as caught:
        read_requirements(file)
    assert said in str(caught.value)


def test_a_file_that_is_not_there_is_named():
    with pytest.raises(OptionError, match=r"'nowhere.toml' can't be read: there is no 'nowhere.toml'; "):
        read_requirements("nowhere.toml")


def result(verdict):
    return RequirementResult("ms", "u", "sampled_d0", Limit(-OPEN, 1.6), verdict, Reason.COMPARED, 0.1)


@pytest.mark.parametrize(
    ("verdicts", "whole"),
    [
        ("PP", "passed"),
        ("PF", "failed"),
        ("UF", "failed"),
        ("PU", "not decided"),
        ("", "not decided"),
    ],
)
def test_the_whole_passes_only_if_all_do(verdicts, whole):
    by_letter = {"P": Verdict.PASSED, "F": Verdict.FAILED, "U": Verdict.UNDECIDED}
    found = Review(tuple(result(by_letter[letter]) for letter in verdicts))
    assert found.verdict == whole
    said = found.as_dict()
    assert said["verdict"] == whole
    assert (said["passed"], said["failed"], said["undecided"]) == tuple(verdicts.count(letter) for letter in "PFU")


def test_step_limits_come_from_a_mapping_or_are_taken_as_they_are():
    limits = StepLimits.of({"rise": (0.1, 0.2)})
    assert limits.limits == {"rise": Limit(0.1, 0.2)}
    assert StepLimits.of(limits) is limits
    with pytest.raises(OptionError, match="expected a mapping"):
        StepLimits.of(0.3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "ms = 1.6\nphase_margin = 45",
            r"limits.toml, line 2: phase_margin: there is no .* Did you mean 'phase_margin_deg'",
        ),
        (
            "# limits\n\nms = '1.6'",
            r"line 3: ms: found '1.6'; expected a number \(at most\).* Give ms = \[low, high\], or one",
        ),
        (
            "ms = 1.6\n[step]\nsize = 1\novershot = 0.1",
            r"line 4: step.overshot: a step response has no 'overshot'. Did you",
        ),
        (
            "[loops.u]\nms = 1.6\n[loops.'c.v']\nMs = 1",
            r"line 4: loops.c.v.Ms: there is no requirement 'Ms'. Did you mean 'ms'",
        ),
        ("[loop.u]\nms = 1", r"line 1: loop: there is no requirement 'loop'. Did you mean 'loops'"),
        ("loops.u = 3", r"line 1: loops.u: found 3; expected limits by name. Write \[loops.u\]"),
        (
            "[numbers]\n'a.b' = 3",
            r"line 2: numbers.a.b: found 3; expected two numbers, low and high. Give 'a.b' = \[low, high\]",
        ),
        ("variants = [1]", r"line 1: variants: found \[1\]; expected keys of variants. Give a list of them"),
        ("bandwidth = [50]", r"line 1: bandwidth: found \[50\]; expected a number"),
        (
            "[variants.sampled_d1]\nms = [2, 1]",
            r"line 2: variants.sampled_d1.ms: found \[2, 1\]; expected a range with low",
        ),
        ("loops = {u = {ms = 'x'}}", r"line 1: loops.u.ms: found 'x'"),
    ],
)
def test_an_error_in_the_file_names_line_and_key(tmp_path, text, said):
    file = tmp_path / "limits.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(OptionError, match=said):
        read_requirements(file)


def test_the_distance_of_a_gain_margin_is_no_gain():
    """A factor of 8.7 is 18.8 dB; its distance from 2 is 6.7, which has no decibels."""
    kept = RequirementResult(
        "gain_margin_high",
        "u",
        "sampled_d0",
        Limit(2.0, OPEN),
        Verdict.PASSED,
        Reason.COMPARED,
        distance=6.7,
        number=number(8.7, is_gain=True),
    )
    *_, found, distance = row_of(kept)
    assert (str(found), str(distance)) == ("8.7 (18.8 dB)", "6.7")


def test_requirements_show_those_of_steps_and_of_single_loops():
    asked = Requirements(
        ms=1.6, step={"input": "r", "output": "y", "settling": 0.8, "size": 2.0}, loops={"u": {"phase_margin_deg": 40}}
    )
    assert repr(asked).startswith(
        "<requirements: ms ≤ 1.6, step of 2 r → y: settling ≤ 0.8, u: <limits of a loop: phase"
    )
    assert "step: overshoot ≤ 0.3" in repr(Requirements(step={"overshoot": 0.3}))
