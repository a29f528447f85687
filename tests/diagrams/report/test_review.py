"""Verdicts on requirements: the page, the JSON and the exit status agree, and seeded failures flip them."""

import json
import math
import pickle
from dataclasses import replace
from functools import cache

import control
import html5lib
import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, Quantizer, Saturation, Sum, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram, Requirements, analyse, experiments, subsystem
from loopwright.diagrams.cli.command_line import main
from loopwright.diagrams.cli.report import verdict_text
from loopwright.diagrams.report.case import Case
from loopwright.diagrams.report.case_verdicts import review
from loopwright.diagrams.report.content_hash import content_hash
from loopwright.diagrams.report.pages.definitions import definition
from loopwright.diagrams.report.pages.html import to_html
from loopwright.diagrams.report.pages.json import to_json
from loopwright.diagrams.requirements import Limit, Reason, RequirementResult, Review
from loopwright.frequency import Number
from loopwright.types import Verdict
from support import reviewed

pytestmark = pytest.mark.usefixtures("without_drawings")

PARTS = ("poles", "inner")
ASKED = {
    "drive": {
        "phase_margin_deg": 55,
        "delay_margin_samples": 3,
        "ms": 1.3,
        "loops": {"voltage": {"disk_margin": 1.5}, "controller.current_wanted": {"bandwidth": (40, 90)}},
    },
    "crane": {"phase_margin_deg": 50, "ms": 1.5, "disk_margin": 1.0, "delay_margin_samples": 10},
    "tank": {"phase_margin_deg": 80, "ms": 1.4, "disk_margin": 1.1, "bandwidth": (0.5, 0.7)},
}
FAULTS = {
    "drive": [{"gain": 2.0}, {"delay": 2}, {"inertia": 0.5}],
    "crane": [{"gain": 2.0}, {"delay": 8}, {"rope": 0.5}],
    "tank": [{"gain": 2.0}, {"delay": 1}, {"area": 0.5}],
}
"""A gain doubled, a delay added, a plant softened."""


def verdicts(report):
    """Return the verdict on the first page, and that of the JSON, with the verdicts of all rows."""
    page, tree = to_html(report), json.loads(to_json(report))
    words = {verdict.value: page.count(f"Verdict: {verdict.value}.") for verdict in Verdict}
    (shown,) = (word for word, count in words.items() if count == 1)
    assert sum(words.values()) == 1
    first = next(s for s in html5lib.parse(page, namespaceHTMLElements=False).iter("section"))
    assert (first.get("id"), first.get("class")) == ("s-summary", "level2")
    assert any("verdict" in (p.get("class") or "") and shown in "".join(p.itertext()) for p in first.iter("p"))
    table = next(first.iter("tbody"))
    rows = sorted(next(iter(row)).text.partition(":")[0] for row in table)
    assert rows == sorted(r["verdict"] for r in tree["requirements"]["results"])
    return shown, tree["requirements"]["verdict"]


@cache
def sound_report(name):
    return reviewed_report(name, {})


def reviewed_report(name, fault):
    return analyse(getattr(reviewed, name)(**fault), only=PARTS, requirements=Requirements(**ASKED[name]))


QUICK = ("tank",)
LOOPS = [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in ASKED]
SEEDED = [
    pytest.param(
        name, fault, marks=[] if name in QUICK and i == 0 else [pytest.mark.slow], id=f"{name}-{next(iter(fault))}"
    )
    for name, faults in FAULTS.items()
    for i, fault in enumerate(faults)
]


@pytest.mark.parametrize("name", LOOPS)
def test_a_sound_design_passes_on_the_page_and_in_the_json(name):
    report = sound_report(name)
    assert verdicts(report) == ("passed", "passed")
    assert all(r.verdict is Verdict.PASSED and r.distance > 0 for r in report.review.results)


@pytest.mark.parametrize(("name", "fault"), SEEDED)
def test_a_seeded_failure_flips_both(name, fault):
    report = reviewed_report(name, fault)
    assert verdicts(report) == ("failed", "failed")
    assert any(r.distance < 0 for r in report.review.of(Verdict.FAILED) if r.reason is Reason.COMPARED) or any(
        r.reason is Reason.UNSTABLE for r in report.review.results
    )


def test_the_tanks_numbers_are_those_of_its_loop_by_hand():
    """1/(A s + c/(2 √h)) behind a hold, under the PI controller's held integral, by python-control."""
    report = sound_report("tank")
    slope = reviewed.OUTLET / (2 * np.sqrt(reviewed.LEVEL))
    kp, ki = reviewed.TANK
    T = reviewed.TANK_T
    plant = control.c2d(control.ss([[-slope / reviewed.AREA]], [[1 / reviewed.AREA]], [[1.0]], 0), T)
    found = {r.quantity: r for r in report.review.results}
    forward = kp + ki * T / (control.tf([1, 0], [1], T) - 1)  # the integral of what came before
    L = forward * control.tf(plant)
    _, pm, _, _ = control.margin(L)
    gm = -1 / L(-1).real  # python-control has no crossing at z = −1
    assert found["phase_margin_deg"].number.value == pytest.approx(pm, abs=1e-6)
    assert report.numbers()["inner.q.sampled_d0.gain_margin_high"].value == pytest.approx(gm, rel=1e-6)
    assert found["phase_margin_deg"].distance == pytest.approx(pm - 80, abs=1e-6)


@pytest.mark.slow
def test_delays_that_are_neither_none_nor_one_sample_are_judged_as_they_are():
    report = reviewed_report("tank", {"delay": 3})
    assert {r.variant for r in report.review.results} == {"sampled_own"}
    margin = report.numbers()["inner.q.sampled_own.delay_margin_samples"].value
    without = report.numbers()["inner.q.sampled_d0.delay_margin_samples"].value
    assert margin == pytest.approx(without - 3, abs=1e-6)


# --- not decided, never passed -----------------------------------------------------------------------------------------


def loop(limit=None, encoder=None, start=0.0):
    """Return an integrator behind a sampled gain of 3, with a limit or an encoder."""
    lag = Integrator(initial_value=start, name="lag")

    @subsystem(sample_time=0.01)
    def controller(y):
        seen = Quantizer(quantum=encoder, name="encoder")(y) if encoder else y
        command = Gain(gain=3.0, name="gain")(0.0 - seen)
        return (Saturation(lower=-5.0, upper=limit, name="limit")(command) if limit is not None else command).named("u")

    return Diagram("loop", lag(controller(lag.y)))


def by_quantity(report):
    return {r.quantity: r for r in report.review.results}


def test_a_margin_on_a_kink_is_not_decided():
    found = by_quantity(analyse(loop(limit=0.0), only=PARTS, requirements=Requirements(phase_margin_deg=45)))
    assert found["phase_margin_deg"].verdict is Verdict.UNDECIDED
    assert found["phase_margin_deg"].reason is Reason.FINDINGS


@pytest.mark.slow
def test_a_loop_without_a_slope_has_no_margin_and_is_not_decided():
    report = analyse(
        loop(encoder=0.01), only=PARTS, requirements=Requirements(phase_margin_deg=45, stable=False), stairs="zero"
    )
    found = by_quantity(report)["phase_margin_deg"]
    assert (found.verdict, found.reason) == (Verdict.UNDECIDED, Reason.NO_NUMBER)
    assert verdicts(report) == ("not decided", "not decided")
    assert any("The loop at controller.u" in text for text in report.sections[0].text)


@pytest.mark.slow
def test_a_moving_operating_point_is_not_decided():
    found = by_quantity(analyse(loop(start=0.5), only=PARTS, requirements=Requirements(phase_margin_deg=45)))
    assert (found["phase_margin_deg"].verdict, found["phase_margin_deg"].reason) == (Verdict.UNDECIDED, Reason.MOVING)
    assert found["phase_margin_deg"].distance > 0


def test_a_step_that_was_not_made_is_not_decided():
    found = by_quantity(analyse(loop(), only=PARTS, requirements=Requirements(step={"overshoot": 0.1})))
    assert (found["step.overshoot"].verdict, found["step.overshoot"].reason) == (
        Verdict.UNDECIDED,
        Reason.NOT_MEASURED,
    )


def test_a_step_is_judged_by_the_running_diagram():
    asked = Requirements(step={"overshoot": 0.01, "settling": 1.0, "peak": 1.2, "size": 1.0})
    found = by_quantity(analyse(loop(), only=("poles", "inner", "steps"), requirements=asked))
    settled = math.ceil(math.log(0.02) / math.log(1 - 0.03)) * 0.01  # y[k + 1] = 0.97 y[k] + …
    assert found["step.settling"].verdict is Verdict.FAILED
    assert found["step.settling"].number.value == pytest.approx(settled, abs=0.0201)
    assert found["step.overshoot"].verdict is Verdict.PASSED
    assert found["step.peak"].number.value == pytest.approx(1.0, abs=1e-3)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("peak", "verdict"), [(0.9, Verdict.UNDECIDED), (0.4, Verdict.FAILED)])
def test_a_record_that_ends_early_decides_only_what_has_been_exceeded(peak, verdict):
    """After 0.2 s the response 1 − 0.97^k has come to 0.456; in the end it comes to 1."""
    asked = Requirements(step={"peak": peak, "overshoot": 0.1, "settling": 10.0, "size": 1.0, "length": 0.2})
    report = analyse(loop(), only=("poles", "inner", "steps"), requirements=asked)
    found = by_quantity(report)
    assert found["step.peak"].verdict is verdict
    assert report.numbers()["steps.u.sampled_d0.peak"].value == pytest.approx(1 - 0.97**20, abs=1e-3)
    for name in ("step.overshoot", "step.settling"):
        assert (found[name].verdict, found[name].reason) == (Verdict.UNDECIDED, Reason.NOT_SETTLED)
    assert report.numbers()["steps.u.sampled_d0.settled"].value == 0.0
    (steps,) = (s for s in report.sections if s.key == "steps")
    assert any("has not settled in its record of 0.2 s" in text for text in steps.text)


@pytest.mark.slow
def test_a_slow_part_that_the_record_does_not_see_leaves_a_step_undecided():
    """Half of the response comes within 0.05 s, the other half with a time constant of 10 s."""
    wish = Constant(value=0.0, name="wish").named("w")
    fast = TransferFunction(numerator=[0.5], denominator=[0.01, 1.0], name="fast")
    slow = TransferFunction(numerator=[0.5], denominator=[10.0, 1.0], name="slow")
    diagram = Diagram("two", Sum(signs="++", name="sum")(fast(wish), slow(wish)).named("y"))
    for length, verdict in ((0.2, Verdict.UNDECIDED), (100.0, Verdict.FAILED)):
        step = {"input": "w", "output": "y", "settling": 0.1, "overshoot": 0.1, "length": length}
        report = analyse(diagram, only=("poles", "steps"), requirements=Requirements(step=step))
        assert by_quantity(report)["step.settling"].verdict is verdict
        assert report.numbers()["steps.w_to_y.continuous.settled"].value == float(verdict is Verdict.FAILED)
    assert report.numbers()["steps.w_to_y.continuous.settling"].value == pytest.approx(10 * math.log(25), abs=0.2)


def test_a_limit_that_acts_fails_a_step_that_the_linear_model_passes():
    asked = Requirements(step={"settling": 1.5, "size": -1.0})
    report = analyse(loop(limit=0.5), only=("poles", "inner", "steps"), requirements=asked)
    linear = report.numbers()["steps.u.sampled_d0.linear.settling"].value
    assert linear < 1.5
    found = by_quantity(report)["step.settling"]
    assert found.verdict is Verdict.FAILED
    assert found.number.value == math.inf  # the command stays at its limit
    (steps,) = (s for s in report.sections if s.key == "steps")
    assert any("limits act, of controller.limit" in text for text in steps.text)


def test_the_command_line_rounds_as_the_page_does():
    small = RequirementResult(
        "stable",
        "",
        "continuous",
        Limit(-math.inf, -1.0),
        Verdict.FAILED,
        Reason.UNSTABLE,
        number=Number(-1.38778e-16, "1/s", 1e-12, "eigenvalues"),
    )
    rough = replace(small, number=Number(12.3456789, "1/s", 0.02, "a run"))
    told = verdict_text(Review((small, rough)))
    assert "found 0 1/s," in told
    assert "found 12.35 1/s," in told


def test_a_single_number_is_judged_by_its_path_and_a_missing_one_is_not_decided():
    ranges = {f"inner.u.sampled_d0.{name}": (0.0, 1.1) for name in ("mt", "nothing", "m_s")}
    report = analyse(loop(), only=PARTS, requirements=Requirements(numbers=ranges))
    found = by_quantity(report)
    assert found["inner.u.sampled_d0.mt"].verdict is Verdict.PASSED
    assert found["inner.u.sampled_d0.nothing"].verdict is Verdict.UNDECIDED
    assert "'inner.u.sampled_d0.ms'" in found["inner.u.sampled_d0.m_s"].detail
    assert "The report has no such number. Did you mean" in to_html(report)


def test_an_unstable_diagram_fails_in_everything():
    unstable = analyse(loop().replace({"controller.gain.gain": 400.0}), only=PARTS, requirements=Requirements(ms=9.0))
    assert {r.verdict for r in unstable.review.results} == {Verdict.FAILED}
    assert {r.reason for r in unstable.review.results} == {Reason.UNSTABLE}


@pytest.mark.drawn(2)
@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"loops": {"w": {"ms": 1.6}}}, "found requirements on a loop 'w'; expected a loop of the report"),
        ({"variants": ["sampled_d2"]}, "found requirements on a variant 'sampled_d2'.*Did you mean 'sampled_d"),
        ({"step": {"input": "w", "overshoot": 0.1}}, "there is no signal 'w'"),
    ],
)
def test_names_that_the_diagram_does_not_have_are_refused_before_anything_is_computed(asked, said):
    with pytest.raises(UnknownNameError, match=said):
        analyse(loop(), only=PARTS, requirements=Requirements(**asked))


@pytest.mark.drawn(3)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ms = 2.0\n[loops.w]\nms = 1.6\n", "line 2: loops.w: found requirements on a loop 'w'"),
        ('ms = 2.0\nvariants = ["sampled_d2"]\n', "line 2: variants: found requirements on a variant 'sampled_d2'"),
        ('[loops.u]\nvariants = ["sampled_d2"]\n', "line 2: loops.u.variants: found requirements on a variant"),
        ('[step]\nrise = 0.1\ninput = "w"\n', "line 3: step.input: there is no signal 'w'"),
        ('[[step]]\nrise = 1\n[[step]]\nrise = 1\ninput = "w"\n', "asked.toml: step, input: there is no signal 'w'"),
    ],
)
def test_names_of_a_file_that_the_diagram_does_not_have_are_refused_with_their_line(text, said, tmp_path):
    file = tmp_path / "asked.toml"
    file.write_bytes(b"\xef\xbb\xbf" + text.encode())  # as some editors write it
    with pytest.raises(UnknownNameError, match=said):
        analyse(loop(), only=PARTS, requirements=file)


# --- the command line ---------------------------------------------------------------------------------------------------

FILE = """
from loopwright.blocks import Gain, Integrator
from loopwright.diagrams import Diagram, subsystem

lag = Integrator(name="lag")


@subsystem(sample_time=0.01)
def controller(y):
    return Gain(gain=3.0, name="gain")(0.0 - y).named("u")


loop = Diagram("loop", lag(controller(lag.y)))
"""


def quick(monkeypatch):
    """Let the command make the parts that these requirements are about: the injection check takes a minute."""
    monkeypatch.setattr(
        "loopwright.diagrams.report.analyse", lambda *of, **options: analyse(*of, only=PARTS, **options)
    )


@pytest.mark.parametrize(
    ("text", "status", "verdict"),
    [
        pytest.param("phase_margin_deg = 45", 0, "passed", marks=pytest.mark.slow),
        ("phase_margin_deg = 89.9", 3, "failed"),
        pytest.param("[numbers]\n'inner.u.sampled_d0.no' = [0, 1]", 4, "not decided", marks=pytest.mark.slow),
    ],
)
def test_the_exit_status_says_the_verdict(tmp_path, monkeypatch, capsys, text, status, verdict):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(FILE, encoding="utf-8")
    (tmp_path / "limits.toml").write_text(text, encoding="utf-8")
    quick(monkeypatch)
    line = ["report", "loop.py:loop", "--requirements", "limits.toml", "--json"]
    assert main([*line, "--check"]) == status
    assert json.loads((tmp_path / "loop.json").read_text(encoding="utf-8"))["requirements"]["verdict"] == verdict
    assert f"Requirements: {verdict}." in capsys.readouterr().out


def test_check_without_requirements_and_names_that_are_not_there_are_wrong_usage(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(FILE, encoding="utf-8")
    assert main(["report", "loop.py:loop", "--check"]) == 2
    assert "there is nothing to check" in capsys.readouterr().err
    (tmp_path / "limits.toml").write_text("[loops.w]\nms = 1.6", encoding="utf-8")
    assert main(["report", "loop.py:loop", "--requirements", "limits.toml"]) == 2
    assert "a loop 'w'" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.html"))


# --- the document -------------------------------------------------------------------------------------------------------


def test_the_revision_changes_with_what_the_diagram_does_and_with_nothing_else():
    same = {
        content_hash(loop().wired),
        content_hash(loop().wired),
        content_hash(pickle.loads(pickle.dumps(loop())).wired),
    }
    assert len(same) == 1
    others = [loop().replace({"controller.gain.gain": 3.0 + 1e-15}), loop(limit=1.0), loop(start=0.5), reviewed.tank()]
    others += [loop().replace({"controller.delay": 1}), loop().replace({"controller.sample_time": 0.02})]
    assert len({*same, *(content_hash(other.wired) for other in others)}) == 7


@pytest.mark.slow
def test_the_heading_has_its_lines_and_the_page_no_path_of_this_machine():
    about = {"title": "The tank", "author": "M. Muster", "project": "Plant 7", "date": "2026-11-22"}
    report = analyse(loop(), only=("subject",), about=about)
    page = to_html(report)
    assert report.title == "The tank"
    for text in (*about.values(), f"{content_hash(loop().wired)[:12]}… (digest of the diagram"):
        assert text in page
    plant = experiments.path_following().diagram
    assert str(plant["plant"].file.parent) not in to_html(analyse(plant, only=("subject",)))


@pytest.mark.slow
def test_an_fmu_is_named_by_model_tool_and_digest():
    plant = experiments.path_following().diagram
    (section,) = analyse(plant, only=("subject",)).sections
    (table,) = [t for t in section.tables if t.title == "FMUs"]
    row = dict(zip(table.columns, table.rows[0], strict=True))
    assert row["model"] == "gantry"
    assert row["made by"].startswith("Loopwright")
    assert len(row["SHA-256"]) == 64
    (parameters,) = section.sections[0].tables
    assert ("plant", "Fmu", "gravity", "9.81", "m/s²") in parameters.rows


def test_the_weakest_margin_is_named_with_the_place_where_it_is_lost():
    report = sound_report("tank")
    text = next(t for t in report.sections[0].text if t.startswith("Weakest"))
    alpha = report.numbers()["inner.q.sampled_d0.disk_margin"].value
    assert f"at controller.q, with the disk margin α = {alpha:.3g}" in text
    assert f"{(2 - alpha) / (2 + alpha):.3g} to {(2 + alpha) / (2 - alpha):.3g}" in text
    assert any("“without sampling”" in t for t in report.sections[0].text)


@pytest.mark.slow
def test_the_diagram_as_it_is_comes_first():
    for delay, key in ((0, "sampled_d0"), (1, "sampled_d1"), (2, "sampled_own")):
        variants = list(Case(reviewed.tank(delay=delay).wired).variants.values())
        assert (variants[0].key, variants[0].title) == (key, "as it is")
        assert sum(v.is_actual for v in variants) == 1
        assert len({v.title for v in variants}) == len(variants)


@pytest.mark.slow
def test_every_number_of_a_step_is_defined_and_has_the_units_of_its_signals():
    numbers = analyse(experiments.path_following().diagram, only=("steps",)).numbers()
    start = "steps.par.sampled_d0_friction"
    assert numbers[f"{start}.peak"].unit == "m/s2"
    assert numbers[f"{start}.settling"].unit == "s"
    assert numbers[f"{start}.effort.controller_motor_force[1]"].unit == "N"
    assert numbers[f"{start}.difference"].value < 1e-3
    for path in numbers:
        term, _ = definition(path)
        assert term in (
            "overshoot",
            "settling",
            "rise",
            "peak",
            "final",
            "difference",
            "effort",
            "length",
            "settled",
        ), path


def test_a_function_is_shown_by_its_name_and_not_by_its_place_in_memory():
    (section,) = analyse(reviewed.tank(), only=("subject",)).sections
    (parameters,) = section.sections[0].tables
    assert ("outlet", "Function", "function", "<lambda>", "") in parameters.rows
    assert not any(" at 0x" in str(cell) for row in parameters.rows for cell in row)


@cache
def loop_numbers():
    return analyse(loop(), only=PARTS).numbers()


def judged_with(asked, changes, drop=()):
    """Return the verdicts on the loop's numbers, some of them changed or left out, by quantity."""
    case = Case(loop().wired)
    case.requirements = asked
    numbers = {path: number for path, number in loop_numbers().items() if path.rpartition(".")[2] not in drop}
    return {r.quantity: r for r in review(case, asked, {**numbers, **changes}).results}


def made(value, confirmed_by="a run"):
    return Number(value, "1", 1e-9, confirmed_by)


@pytest.mark.slow
def test_a_measurement_that_contradicts_the_linear_model_leaves_its_margins_undecided():
    start = "injection.u.sampled_d0"
    for deviation, uncertainty, reason in ((0.2, 1e-3, Reason.REFUTED), (0.2, 0.1, Reason.COMPARED)):
        changes = {f"{start}.deviation": made(deviation), f"{start}.uncertainty": made(uncertainty)}
        found = judged_with(Requirements(phase_margin_deg=45), changes)["phase_margin_deg"]
        assert found.reason is reason
        assert (found.verdict is Verdict.PASSED) is (reason is Reason.COMPARED)


def test_margins_with_slow_loops_open_do_not_count_and_those_with_all_loops_closed_do():
    drop = ("delay_margin_samples", "phase_margin_deg")
    asked = Requirements(phase_margin_deg=45, delay_margin_samples=2)
    start = "inner.u.sampled_d0"
    changes = {
        f"{start}.slow_open.phase_margin_deg": made(80.0),
        f"{start}.slow_open.delay_margin_samples": made(9.0),
        f"{start}.periodic.delay_margin_samples": made(1.0),
    }
    found = judged_with(asked, changes, drop)
    assert found["delay_margin_samples"].verdict is Verdict.FAILED
    assert found["delay_margin_samples"].number.value == 1.0
    assert (found["phase_margin_deg"].verdict, found["phase_margin_deg"].reason) == (
        Verdict.UNDECIDED,
        Reason.NO_NUMBER,
    )


def test_a_fast_wire_has_no_number_at_one_rate_and_its_verdict_says_so():
    start = "inner.u.sampled_d0.periodic"
    changes = {f"{start}.stable": made(1.0), f"{start}.disk_margin": made(1.0)}
    found = judged_with(Requirements(disk_margin=0.6, bandwidth=1.0), changes, ("disk_margin", "bandwidth"))
    assert found["disk_margin"].verdict is Verdict.PASSED
    assert (found["bandwidth"].verdict, found["bandwidth"].reason) == (Verdict.UNDECIDED, Reason.PERIODIC)


def test_the_worst_of_several_places_is_judged_and_a_missing_one_decides_nothing():
    start = "inner.u.sampled_d0"
    places = {f"{start}.here.disk_margin": made(1.2), f"{start}.there.disk_margin": made(0.3)}
    asked = Requirements(disk_margin=0.6)
    assert judged_with(asked, places, ("disk_margin",))["disk_margin"].path == f"{start}.there.disk_margin"
    unknown = {f"{start}.there.disk_margin": made(math.nan)}
    assert judged_with(asked, {**places, **unknown}, ("disk_margin",))["disk_margin"].verdict is Verdict.UNDECIDED


def test_general_limits_of_single_loops_do_not_apply_to_a_loop_with_channels_unless_it_is_named():
    margins = ("phase_margin_deg", "disk_margin")
    changes = {"inner.u.sampled_d0.disk_margin": made(1.0)}
    found = judged_with(Requirements(phase_margin_deg=45, disk_margin=0.6), changes, margins)
    nowhere = found["phase_margin_deg"]  # no other loop has it either: what is required and found nowhere is open
    assert (nowhere.loop, nowhere.verdict) == ("", Verdict.UNDECIDED)
    assert found["disk_margin"].verdict is Verdict.PASSED
    named = judged_with(Requirements(disk_margin=0.6, loops={"u": {"phase_margin_deg": 45}}), changes, margins)
    assert named["phase_margin_deg"].verdict is Verdict.UNDECIDED
