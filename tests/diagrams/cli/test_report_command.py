"""The command ``loopwright report``."""

import json
import re
import shlex
from pathlib import Path

import pytest

from loopwright.diagrams import ConfirmationError
from loopwright.diagrams.cli.command_line import _make_parser, main
from loopwright.diagrams.frequency.number import Number
from loopwright.diagrams.report.pages.document import Section
from loopwright.diagrams.report.pages.report import Report

LOOP = """
from loopwright.blocks import Gain, Integrator, Sine, Sum
from loopwright.diagrams import Diagram, experiments

lag = Integrator(name="lag")
error = Sum(signs="+-", name="error")(Sine(frequency=1.0, name="wish"), lag.y)
loop = Diagram("loop", lag(Gain(gain=2.0, name="law")(error).named("u")).named("y"))
number = 3.0


def make():
    return loop


def broken():
    raise RuntimeError("no such thing")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(LOOP, encoding="utf-8")
    return tmp_path


@pytest.fixture
def asked(monkeypatch):
    """Replace the analysis by one that takes no time; return what it was asked."""
    calls = []

    def analyse(diagram, **options):
        calls.append((diagram, options))
        numbers = {"u.continuous.phase_margin_deg": Number(90.0, "deg", 1e-9, "eigenvalues")}
        return Report(
            f"Report of {diagram.name}", (Section("inner", "Loops", numbers=numbers),), {"diagram": diagram.name}
        )

    monkeypatch.setattr("loopwright.diagrams.report.analyse", analyse)
    return calls


def test_fig_3_is_analysed_without_an_argument(folder, asked, capsys):
    assert main(["report", "--json"]) == 0
    ((diagram, options),) = asked
    assert "controller.admittance_par" in diagram.blocks
    assert options["experiment"].letter == "B"
    assert sorted(p.name for p in folder.iterdir()) == ["fig3.html", "fig3.json", "loop.py"]
    told = capsys.readouterr()
    assert told.out == "Written: fig3.html  fig3.json\n"
    assert "compliance: 1 numbers in" in told.err
    leaf = json.loads((folder / "fig3.json").read_text(encoding="utf-8"))["inner"]["u"]["continuous"][
        "phase_margin_deg"
    ]
    assert leaf == {"value": 90.0, "unit": "deg", "tolerance": 1e-9, "confirmed_by": "eigenvalues"}
    assert "plant" in (folder / "fig3.html").read_text(encoding="utf-8")  # the drawing


@pytest.mark.parametrize(
    ("flags", "summary", "appendix"),
    [([], False, True), (["--summary"], True, True), (["--no-appendix"], False, False)],
)
def test_flags_choose_the_pages(folder, asked, flags, summary, appendix):
    assert main(["report", "loop.py:loop", *flags]) == 0
    ((_, options),) = asked
    assert (options["summary"], options["appendix"]) == (summary, appendix)


def test_options_reach_the_experiment(folder, asked):
    assert main(["report", "c", "--option", "delay=1", "--out", "c.html"]) == 0
    ((_, options),) = asked
    assert options["experiment"].letter == "C"
    assert options["experiment"].options["delay"] == 1
    assert (folder / "c.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("what", ["loop.py:loop", "loop.py:make", "loop.py"])
def test_a_diagram_of_a_users_file(what, folder, asked):
    assert main(["report", what, "--pdf"]) == 0
    ((diagram, options),) = asked
    assert list(diagram.blocks) == ["lag", "law", "error", "wish"]
    assert options["experiment"] is None
    assert (folder / "loop.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["E"], "expected one of A, B, C, D, or FILE.py:NAME"),
        (["loop.py:lop"], "Did you mean 'loop'"),
        (["loop.py:number"], "found float for 'number'; expected a Diagram. Its diagrams: loop"),
        (["loop.py:broken"], "RuntimeError: no such thing"),
        (["nowhere.py:loop"], "there is no file"),
        (["loop.py:loop", "--option", "delay=1"], "it is for experiments"),
        (["--option", "dealy=1"], "no experiment has such an option"),
        (["--out", "fig3.pdf"], "ask for the PDF next to it"),
        (["--out", "nowhere/fig3.html"], "there is no folder"),
        (["--plant", "nowhere.fmu"], "nowhere.fmu"),
    ],
)
def test_wrong_usage_is_found_before_anything_is_analysed(arguments, message, folder, asked, capsys):
    assert main(["report", *arguments]) == 2
    told = capsys.readouterr()
    assert message in told.err
    assert told.out == ""
    assert asked == []
    assert [p.name for p in folder.iterdir()] == ["loop.py"]


def test_an_analysis_that_is_not_confirmed_writes_nothing(folder, monkeypatch, capsys):
    def analyse(diagram, **options):
        raise ConfirmationError("the margin is not confirmed.", block="loop")

    monkeypatch.setattr("loopwright.diagrams.report.analyse", analyse)
    assert main(["report", "loop.py:loop"]) == 1
    assert "not confirmed" in capsys.readouterr().err
    assert not (folder / "loop.html").exists()


def test_an_interrupted_analysis_writes_nothing(folder, monkeypatch, capsys):
    def analyse(diagram, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("loopwright.diagrams.report.analyse", analyse)
    assert main(["report", "loop.py:loop"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (folder / "loop.html").exists()


def test_help_names_what_can_be_analysed(capsys):
    assert main(["report", "--help"]) == 0
    told = capsys.readouterr().out
    assert "FILE.py:NAME" in told
    assert "exit status" in told


@pytest.mark.slow
def test_the_real_report_of_a_users_loop(folder):
    assert main(["report", "loop.py:loop", "--json"]) == 0
    made = json.loads((folder / "loop.json").read_text(encoding="utf-8"))
    margin = made["inner"]["u"]["continuous"]["phase_margin_deg"]
    assert margin["value"] == pytest.approx(90.0, abs=1e-9)  # L = 2/s
    assert set(margin) == {"value", "unit", "tolerance", "confirmed_by"}


def test_the_method_of_a_diagram_writes_the_same(folder, asked):
    from loopwright.diagrams import experiments

    made = experiments.compliance().diagram.report("fig3.html", json=True)
    assert set(made.numbers()) == {"inner.u.continuous.phase_margin_deg"}
    assert (folder / "fig3.json").is_file()


def test_the_commands_of_the_page_on_reports_are_understood():
    text = (Path(__file__).parents[3] / "docs" / "howto" / "reports.md").read_text(encoding="utf-8")
    lines = [line for part in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in part.splitlines()]
    commands = [shlex.split(line, comments=True)[1:] for line in lines]
    assert len(commands) == 5
    for command in commands:
        assert _make_parser().parse_args(command).command == "report"
