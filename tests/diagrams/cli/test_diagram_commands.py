"""``loopwright run FILE.py:NAME``, ``draw`` and ``sweep``: files, tables, exit statuses, and one clear line of an error."""

import csv
import json
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from loopwright.diagrams.cli.command_line import main

FILE = """
    from loopwright import Diagram
    from loopwright.blocks import Gain, PythonFunction, StateSpace, Step
    import time

    lag = StateSpace(A=[[-2.0]], B=[2.0], C=[1.0], name="lag")
    loop = Diagram("loop", lag(Gain(gain=3.0, name="kp")(Step(times=0.0, values=1.0, unit="V")).named("u")).named("y"))

    def made():
        return loop

    def unwired():
        return Diagram("unwired", lag)

    def divided():
        return 1 / 0

    def waited(u):
        time.sleep(0.005)
        with open("running", "a") as file:
            file.write(".")
        return u

    def slow():
        return Diagram("slow", PythonFunction(waited, name="wait")(Step(times=1.0, values=1.0)).named("y"))

    number = 3
"""


@pytest.fixture
def loop(tmp_path, monkeypatch):
    (tmp_path / "loop.py").write_text(textwrap.dedent(FILE), encoding="utf-8")
    (tmp_path / "bad.py").write_text("import math\nmath.nothing\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_a_run_writes_samples_numbers_and_a_figure_and_prints_its_wires(loop, capsys):
    assert main(["run", "loop.py:loop", "--duration", "1", "--step", "0.1", "--out", "there"]) == 0
    assert sorted(f.name for f in (loop / "there").iterdir()) == ["loop.csv", "loop.json", "loop.png", "loop.svg"]
    with open(loop / "there" / "loop.csv", newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    table = dict(zip(header, np.array(rows, dtype=float).T, strict=True))
    expected = 3.0 * (1.0 - np.exp(-2.0 * table["t"]))  # of a lag of 0.5 s behind a gain of 3
    assert table["y"] == pytest.approx(expected, rel=1e-4, abs=1e-9)
    printed = capsys.readouterr().out
    assert "signal" in printed
    assert f"{3.0 * (1.0 - np.exp(-2.0)):.3g}" in printed


def test_a_parameter_is_set_and_the_numbers_come_as_json(loop, capsys):
    assert main(["run", "loop.py:made", "--duration", "1", "--step", "0.1", "--set", "kp.gain=2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["signals"]["u"] == {"unit": None, "minimum": 2.0, "maximum": 2.0, "end": 2.0}
    assert found["signals"]["y"]["end"] == pytest.approx(2.0 * (1.0 - np.exp(-2.0)), rel=1e-4)
    assert (found["diagram"], found["samples"], found["error"]) == ("loop", 11, None)


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["loop.py:lop"], 2, "there is no 'lop' in it. Did you mean 'loop'?"),
        (["loop.py:number"], 2, "found int for 'number'; expected a Diagram. Its diagrams: loop."),
        (["nowhere.py:loop"], 2, "there is no file 'nowhere.py'. Check the path."),
        (["loop.py:unwired"], 1, "unwired() fails in line 13: lag.u: an output of this block is used"),
        (["loop.py:divided"], 1, "divided() fails in line 16: ZeroDivisionError: division by zero."),
        (["bad.py:loop"], 1, "importing it fails in line 2: AttributeError: module 'math' has no attribute 'nothing'."),
        (["loop.py:loop", "--set", "kp.gian=2"], 2, "--set: kp: it has no parameter 'gian'. Did you mean 'gain'?"),
        (["loop.py:loop", "--option", "delay=1"], 2, "--option: it is for experiments; write --set PATH=VALUE"),
        (["loop.py:loop", "A"], 2, "found loop.py:loop A; expected one diagram."),
        (["A"], 2, "--duration: it is for diagrams, FILE.py:NAME"),
    ],
)
def test_a_mistake_is_one_clear_line(loop, capsys, arguments, status, said):
    assert main(["run", *arguments, "--duration", "1"]) == status
    shown = capsys.readouterr()
    assert said in shown.err
    assert len(shown.err.splitlines()) == 1
    assert "Traceback" not in shown.err


def test_a_duration_is_asked_for(loop, capsys):
    assert main(["run", "loop.py:loop"]) == 2
    assert "--duration: a diagram has none of its own. Give it in s, such as --duration 2." in capsys.readouterr().err


def test_a_diagram_is_drawn_to_a_file(loop, capsys):
    assert main(["draw", "loop.py:loop"]) == 0
    assert capsys.readouterr().out == "Written: loop.svg\n"
    assert "<svg" in (loop / "loop.svg").read_text(encoding="utf-8")
    assert main(["draw", "loop.py:loop", "--subsystem", "nowhere"]) == 2


def test_the_drawn_diagram_comes_as_json(loop, capsys):
    assert main(["draw", "loop.py:loop", "--json", "--out", "l.html"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == {
        "file": "l.html",
        "diagram": "loop",
        "blocks": {"lag": "StateSpace", "kp": "Gain", "step": "Step"},
        "wires": [{"from": "kp.y", "to": "lag.u"}, {"from": "step.y", "to": "kp.u"}],
        "names": {"u": "kp.y", "y": "lag.y"},
    }
    assert "<svg" in (loop / "l.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", ["draw", "page", "ssp", "sweep", "c"])
def test_an_interrupt_of_any_command_is_one_line(loop, capsys, command):
    (loop / "late.py").write_text("def loop():\n    raise KeyboardInterrupt\n", encoding="utf-8")
    options = ["--duration", "1", "--vary", "k=1"] if command == "sweep" else []
    assert main([command, "late.py:loop", *options]) == 130
    said = "interrupted." if command == "c" else "interrupted; nothing is written."
    assert capsys.readouterr() == ("", f"loopwright: {said}\n")
    assert sorted(file.name for file in loop.iterdir()) == ["bad.py", "late.py", "loop.py"]


def test_a_sweep_has_a_row_for_each_sample(loop, capsys):
    asked = ["--vary", "kp.gain=1,2,4", "--reduce", "maximum:y", "--duration", "1", "--step", "0.1"]
    assert main(["sweep", "loop.py:loop", *asked, "--out", "table.csv", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    expected = [{"sample": k, "kp.gain": g} for k, g in enumerate((1, 2, 4))]
    assert [{key: row[key] for key in ("sample", "kp.gain")} for row in rows] == expected
    end = 1.0 - np.exp(-2.0)
    assert [row["maximum y"] for row in rows] == pytest.approx([end, 2 * end, 4 * end], rel=1e-4)
    with open(loop / "table.csv", newline="", encoding="utf-8") as file:
        assert next(csv.reader(file)) == ["sample", "kp.gain", "maximum y"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--vary", "kp.gain=1:4"], "--count: ranges need the number of samples. Give it, such as --count 20."),
        (["--vary", "kp.gain=1,2", "--count", "3"], "--count: it is for ranges"),
        (["--vary", "kp.gain"], "found 'kp.gain'; expected PATH=VALUE"),
        (["--vary", "kp.gain=1,2", "--reduce", "maximal:y"], "expected KIND:SIGNAL, such as maximum:y. Did you mean"),
    ],
)
def test_a_sweep_that_is_asked_for_wrongly_is_refused(loop, capsys, arguments, said):
    assert main(["sweep", "loop.py:loop", "--duration", "1", *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_an_interrupt_ends_a_run_with_its_record_and_no_traceback(loop):
    command = [sys.executable, "-m", "loopwright", "run", "loop.py:slow", "--duration", "100", "--step", "0.001"]
    started = subprocess.Popen(command, cwd=loop, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for _ in range(600):
        if (loop / "running").exists() and len((loop / "running").read_text()) > 50:  # it is called at the start, too
            break
        time.sleep(0.1)
    os.kill(started.pid, signal.SIGINT)
    out, err = started.communicate(timeout=60)
    assert started.returncode == 130, err
    assert "Traceback" not in out + err
    assert "interrupted; the record until then is written." in err


@pytest.mark.slow
@pytest.mark.parametrize("after", [1.0, 1.5, 2.0, 3.0])
def test_an_interrupt_at_the_start_of_the_command_has_no_traceback(loop, after):
    command = [sys.executable, "-m", "loopwright", "run", "loop.py:slow", "--duration", "100", "--step", "0.001"]
    started = subprocess.Popen(command, cwd=loop, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(after)
    os.kill(started.pid, signal.SIGINT)
    _, err = started.communicate(timeout=60)
    assert started.returncode == 130, err
    assert "Traceback" not in err
