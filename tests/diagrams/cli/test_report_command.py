"""The command ``loopwright report``."""

import json
import math
import re
import shlex
from pathlib import Path

import pytest

from loopwright.diagrams import ConfirmationError
from loopwright.diagrams.cli.command_line import main, make_parser
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

TANK = """
import numpy as np
from loopwright.blocks import PID, Block, Constant, Input, Integrator, State
from loopwright.diagrams import Diagram


class Tank(Block):
    inflow = Input()
    level = State(start=1.0, output=True)

    def derivative(self, t, x, u):
        return u.inflow - 0.5 * np.sqrt(x.level)


tank, law = Tank(name="tank"), PID(kp=2.0, ki=1.0, name="pid")
filled = Diagram("filled", tank(law(Constant(value=4.0, name="wish"), tank.level).named("inflow")))
never = Diagram("never", Integrator(name="ramp")(Constant(value=1.0, name="one")))
"""
"""A tank with the outflow of Torricelli, which is filled from a level of 1 to 4."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(LOOP, encoding="utf-8")
    return tmp_path


@pytest.fixture
def tank(folder):
    (folder / "tank.py").write_text(TANK, encoding="utf-8")
    return folder


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


def test_the_operating_point_is_at_rest_or_that_of_a_time(tank, asked):
    assert main(["report", "tank.py:filled", "--at", "trim"]) == 0
    assert main(["report", "tank.py:filled", "--at", "400"]) == 0
    assert main(["report", "tank.py:filled"]) == 0
    trimmed, later, first = (options["at"] for _, options in asked)
    assert trimmed.values["tank.level"] == pytest.approx(4.0, abs=1e-8)  # the wish
    assert trimmed.values["pid.u"] == pytest.approx(1.0, abs=1e-8)  # the outflow, 0.5 √4
    assert (later, first) == (400.0, None)


def test_a_diagram_that_is_never_at_rest_writes_nothing(tank, asked, capsys):
    assert main(["report", "tank.py:never", "--at", "trim"]) == 1
    assert "no operating point" in capsys.readouterr().err
    assert asked == []
    assert not (tank / "never.html").exists()


@pytest.mark.slow
def test_a_loop_that_starts_away_from_rest_is_judged_where_it_rests(tank, capsys):
    (tank / "limits.toml").write_text("phase_margin_deg = [60, 90]\n", encoding="utf-8")
    command = ["report", "tank.py:filled", "--requirements", "limits.toml", "--check", "--json", "--summary"]
    assert main(command) == 4
    assert "diagram.trim(…) is --at trim" in capsys.readouterr().out
    assert main([*command, "--at", "trim"]) == 0
    assert "--at" not in capsys.readouterr().out
    made = json.loads((tank / "filled.json").read_text(encoding="utf-8"))
    found = made["inner"]["inflow"]["continuous"]["phase_margin_deg"]["value"]
    # L = (2 s + 1)/(s (s + 1/8)), as d(0.5 √h)/dh = 1/8 at h = 4; |L| = 1 where w⁴ + (1/64 − 4) w² − 1 = 0
    b = 1 / 64 - 4
    w = math.sqrt((-b + math.sqrt(b * b + 4)) / 2)
    assert found == pytest.approx(180 + math.degrees(math.atan(2 * w) - math.pi / 2 - math.atan(8 * w)), abs=1e-6)


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
        (["loop.py:loop", "--at", "rest"], "found 'rest'; expected trim, or a time in s"),
        (["loop.py:loop", "--at", "-1"], "found '-1'; expected trim, or a time in s"),
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
    assert len(commands) == 6
    for command in commands:
        assert make_parser().parse_args(command).command == "report"
