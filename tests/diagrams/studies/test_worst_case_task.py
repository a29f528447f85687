"""Worst cases that a TOML file asks for: in the report, and on the command line."""

import math
import re

import pytest

from loopwright.blocks import Gain, Integrator, OptionError
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.cli.command_line import main
from loopwright.diagrams.report import analyse
from loopwright.diagrams.requirements import Reason, Verdict, read_requirements
from loopwright.diagrams.studies import WorstCaseTask
from loopwright.diagrams.sweeps import Box
from support.tuned_loops import make_pi_loop, pi_phase_margin

TABLE = """
[worst_case]
loop = "u"
quantity = "phase_margin_deg"
samples = "grid"
starts = 0

[worst_case.ranges]
"p.gain" = [0.5, 1.0, 2.0]
"""
LIMITS = """
phase_margin_deg = 100

[worst_case]
loop = "u"
samples = "grid"
starts = 0

[worst_case.ranges]
p.gain = [0.5, 1.0, 2.0]
"""
LOOP = """
from support.tuned_loops import make_pi_loop

loop = make_pi_loop()
"""


def write(folder, text, name="limits.toml"):
    file = folder / name
    file.write_text(text.strip(), encoding="utf-8")
    return file


def test_a_file_asks_as_code_does(tmp_path):
    task = WorstCaseTask.read(write(tmp_path, TABLE))
    found = task.find(make_pi_loop().wired)
    assert found.worst.value == pytest.approx(min(pi_phase_margin(k, 0.5, 2.0) for k in (0.5, 1.0, 2.0)), rel=1e-9)
    assert found.parameters == {"p.gain": 0.5}


def test_ranges_are_pairs_or_tables_and_keys_may_be_dotted(tmp_path):
    text = '[worst_case]\nloop = ["u"]\n[worst_case.ranges]\np.gain = [0.5, 2]\n"ki.gain" = {low = 1, high = 9, scale = "log"}'
    task = WorstCaseTask.read(write(tmp_path, text))
    assert task.ranges == {"p.gain": [0.5, 2], "ki.gain": Box(1, 9, "log")}
    task.check(make_pi_loop().wired)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"p.gain"', '"p.gian"', r"limits.toml, line 8: worst_case.ranges.p.gian: .*gian"),
        ('"u"', '"w"', r"limits.toml, line 2: worst_case.loop: there is no signal 'w'"),
        ('"phase_margin_deg"', '"phase_margin"', r"line 3: worst_case.quantity: a loop has no number 'phase_margin'"),
        ('samples = "grid"', "samples = 20", r"line 4: worst_case.samples: found 20; .* Write count = 20"),
        ('samples = "grid"', 'samples = "gird"', r"line 4: worst_case.samples: found samples='gird'"),
        (
            'samples = "grid"',
            "count = 20",
            r"line 8: worst_case.ranges.p.gain: found \[0.5, 1.0, 2.0\]; .* Write \[low, high\]",
        ),
        ("starts = 0", "start = 0", r"line 5: worst_case.start: \[worst_case\] has no 'start'. Did you mean 'starts'"),
        ("starts = 0", "starts = -1", r"line 5: worst_case.starts: found starts=-1; expected an integer from 0 on"),
        ("starts = 0", "seed = 1.5", r"line 5: worst_case.seed: found seed=1.5"),
        (
            "starts = 0",
            "requirements = {mss = 1.6}",
            r"line 5: worst_case.requirements.mss: there is no requirement 'mss'",
        ),
        (
            "starts = 0",
            "requirements = {ms = 1.6}",
            r"line 1: worst_case: found quantity='phase_margin_deg' and requirem",
        ),
        (
            "[0.5, 1.0, 2.0]",
            "{low = 2.0, high = 1.0}",
            r"line 8: worst_case.ranges.p.gain: found a range from 2.0 to 1.0",
        ),
        (
            "[0.5, 1.0, 2.0]",
            "{low = 1, hihg = 5}",
            r"line 8: worst_case.ranges.p.gain: a range has no 'hihg'. .*'high'",
        ),
        (
            "[0.5, 1.0, 2.0]",
            "{low = 1}",
            r"line 8: worst_case.ranges.p.gain: found a range without 'high'; expected both",
        ),
    ],
)
def test_errors_name_the_line_and_the_entry(old, new, message, tmp_path):
    file = write(tmp_path, TABLE.replace(old, new))
    with pytest.raises(OptionError, match=message):
        WorstCaseTask.read(file).find(make_pi_loop().wired)


def test_a_setting_of_a_subsystem_is_named_once(tmp_path):
    lag = Integrator(name="lag")

    @subsystem(sample_time=0.01)
    def c(y):
        return Gain(gain=-1.0, name="p")(y).named("u")

    task = WorstCaseTask.read(write(tmp_path, TABLE.replace("p.gain", "c.delay")))
    with pytest.raises(OptionError, match=r"line 8: worst_case.ranges.c.delay: found a delay of a subsystem"):
        task.check(Diagram("loop", lag(c(lag.y))).wired)


def test_requirements_of_the_file_are_made_worst_and_judged(tmp_path):
    """110° is met by the diagram as it is, and not with half the proportional gain."""
    file = write(tmp_path, LIMITS)
    assert dict(read_requirements(file).limits) == {"phase_margin_deg": (100.0, math.inf)}
    margins = {k: pi_phase_margin(k, 0.5, 2.0) for k in (0.5, 1.0)}
    assert margins[0.5] < 110 < margins[1.0]
    file = write(tmp_path, LIMITS.replace("100", "110"))
    report = analyse(make_pi_loop(), requirements=file, only=("inner",))
    mine = {(r.variant, r.quantity): r for r in report.review.results}
    searched = mine["worst_case", "phase_margin_deg"]
    assert searched.verdict is Verdict.FAILED
    assert searched.distance == pytest.approx(margins[0.5] - 110, rel=1e-6)
    assert mine["continuous", "phase_margin_deg"].verdict is Verdict.PASSED
    assert report.review.verdict is Verdict.FAILED
    assert report.numbers()["worst_case.worst.phase_margin_deg"].value == pytest.approx(margins[0.5], rel=1e-9)


def test_limits_of_a_loop_hold_by_its_key_in_the_report_too(tmp_path):
    """The wire controller.u has the key u in the report, and the file names the loop by its key."""
    lag = Integrator(name="lag")

    @subsystem(sample_time=0.01)
    def controller(y):
        return Gain(gain=3.0, name="gain")(0.0 - y).named("u")

    text = '[loops.u]\nms = 1.01\n[worst_case]\nloop = "controller.u"\nsamples = "grid"\nstarts = 0\n'
    file = write(tmp_path, f"{text}[worst_case.ranges]\ngain.gain = [1.0, 6.0]")
    report = analyse(Diagram("loop", lag(controller(lag.y))), requirements=file, only=("inner",))
    (searched,) = [r for r in report.review.results if r.variant == "worst_case"]
    assert (searched.quantity, searched.verdict) == ("ms", Verdict.FAILED)
    assert searched.number.value == pytest.approx(2 / (2 - 0.06), rel=1e-6)  # L(z) = 0.06/(z − 1), S at z = −1


def test_limits_that_an_unstable_case_breaks_fail(tmp_path):
    file = write(tmp_path, LIMITS.replace("[0.5, 1.0, 2.0]", "[-2.0, 1.0]"))
    report = analyse(make_pi_loop(), requirements=file, only=("inner",))
    (searched,) = [r for r in report.review.results if r.variant == "worst_case"]
    assert (searched.verdict, searched.reason) == (Verdict.FAILED, Reason.UNSTABLE)


def make_two_rates():
    """A lag under a drive that is renewed three times while an outer loop is renewed once."""
    lag = Integrator(name="lag")

    @subsystem(sample_time=0.01)
    def drive(y, wanted):
        return Gain(gain=3.0, name="gain")(wanted - y).named("u")

    @subsystem(sample_time=0.03)
    def outer(y):
        return Gain(gain=-0.5, name="outer_gain")(y).named("wanted")

    return Diagram("loop", lag(drive(lag.y, outer(lag.y))))


RENEWED = """
ms = 3.0

[worst_case]
count = 4
loop = "u"

[worst_case.ranges]
"drive.gain.gain" = [1.0, 3.0]
"""


def test_a_wire_without_a_loop_is_named_with_its_entry_and_leaves_the_rest_of_the_report(tmp_path):
    file = write(tmp_path, RENEWED)
    words = r"limits.toml, line 5: worst_case.loop: .* 'u' is renewed 3 times in the model's period of 0.03 s"
    with pytest.raises(OptionError, match=words):
        WorstCaseTask.read(file).find(make_two_rates().wired)
    report = analyse(make_two_rates(), requirements=file, only=("poles",))
    plain = analyse(make_two_rates(), requirements=read_requirements(write(tmp_path, "ms = 3.0")), only=("poles",))
    sections = {section.key: section for section in report.sections}
    assert list(sections) == ["summary", "poles", "worst_case"]
    assert report.numbers() == plain.numbers()
    assert re.search(words, str(sections["worst_case"].text[0]))
    (searched,) = [r for r in report.review.results if r.variant == "worst_case"]
    assert (searched.quantity, searched.loop) == ("ms", "u")
    assert (searched.verdict, searched.reason) == (Verdict.UNDECIDED, Reason.NOT_ANALYSED)
    assert len(report.review.results) == len(plain.review.results) + 1


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(LOOP, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    ("files", "arguments", "message"),
    [
        ({"w.toml": TABLE.replace('"u"', '"v"')}, ["--worst-case", "w.toml"], "w.toml, line 2: worst_case.loop: there"),
        ({"w.toml": "ms = 2"}, ["--worst-case", "w.toml"], "w.toml, line 1: ms: found it next to [worst_case]"),
        ({"w.toml": ""}, ["--worst-case", "w.toml"], "w.toml: found no table [worst_case]"),
        ({}, ["--worst-case", "w.toml"], "--worst-case: 'w.toml' can't be read"),
        (
            {"w.toml": TABLE.strip(), "l.toml": LIMITS.strip()},
            ["--worst-case", "w.toml", "--requirements", "l.toml"],
            "w.toml, line 1: worst_case: the file of the requirements has a worst case, too",
        ),
        (
            {"l.toml": LIMITS.replace("p.gain", "q.gain").strip()},
            ["--requirements", "l.toml"],
            "l.toml, line 9: worst_case.ranges.q.gain: ",
        ),
    ],
)
def test_wrong_usage_is_found_before_anything_is_analysed(files, arguments, message, folder, capsys):
    for name, text in files.items():
        write(folder, text, name)
    assert main(["report", "loop.py:loop", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "loop.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "status"), [(100, 0), (110, 3)])
def test_the_command_line_finds_and_checks_a_worst_case(limit, status, folder, capsys):
    write(folder, LIMITS.replace("100", str(limit)), "l.toml")
    assert (
        main(["report", "loop.py:loop", "--requirements", "l.toml", "--check", "--json", "--out", "r.html"]) == status
    )
    told = capsys.readouterr().out
    assert ("failed: worst_case.worst.phase_margin_deg" in told) == (status == 3)
    assert "worst case" in (folder / "r.html").read_text(encoding="utf-8")
