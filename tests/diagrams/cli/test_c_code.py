"""The command ``loopwright c``: a sampled diagram or subsystem of a user's file as C for a target."""

import json
from pathlib import Path

import pytest

from loopwright.diagrams.cli import main

LOOP = """
from loopwright import Diagram, subsystem
from loopwright.blocks import PID, Step, TransferFunction


@subsystem(sample_time=0.01)
def controller(reference, level):
    return PID(kp=2.0, ki=3.0, name="pi")(reference, level).named("effort")


plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
loop = Diagram("level", plant(controller(Step(times=0.05, values=1.0, name="wanted"), plant.y)))
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "loop.py"
    path.write_text(LOOP, encoding="utf-8")
    return path


def test_a_subsystem_and_a_part_of_a_diagram_are_written(file, tmp_path, capsys):
    assert main(["c", f"{file}:controller", "--out", str(tmp_path / "one")]) == 0
    assert "Tick 0: every 0.01 s" in capsys.readouterr().out
    more = ["--subsystem", "controller", "--name", "pi", "--number", "float", "--out", str(tmp_path / "two")]
    assert main(["c", f"{file}:loop", *more]) == 0
    assert {f.name for f in (tmp_path / "one").iterdir()} >= {"controller.h", "controller.c"}
    assert "typedef float pi_real;" in (tmp_path / "two" / "pi.h").read_text(encoding="utf-8")


def test_what_cannot_be_written_is_named_with_its_status(file, tmp_path, capsys):
    assert main(["c", f"{file}:loop", "--number", "float", "--out", str(tmp_path / "out")]) == 1
    assert "plant: it is in continuous time" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["c", f"{file}:loop", "--test", "signal.csv"]) == 2
    assert "--measure" in capsys.readouterr().err
    assert main(["c", f"{file}:loop", "--name", "a b"]) == 2
    assert "error: --name: found 'a b'; expected a C identifier, such as 'a_b'." in capsys.readouterr().err


def test_the_files_come_as_json_and_the_users_file_is_executed_once(file, tmp_path, capsys):
    file.write_text(LOOP + "print('executed')\n", encoding="utf-8")
    out = tmp_path / "out"
    assert main(["c", f"{file}:loop", "--subsystem", "controller", "--out", str(out), "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert {Path(name) for name in found["files"]} == set(out.iterdir())
    assert "Tick 0: every 0.01 s" in found["report"]
    assert printed.err == "executed\n"


@pytest.mark.slow
def test_a_test_signal_of_a_file_is_measured(file, tmp_path, capsys):
    signal = tmp_path / "signal.csv"
    signal.write_text("reference,level\n1.0,0.0\n1.0,0.5\n", encoding="utf-8")
    out = ["--out", str(tmp_path), "--number", "float", "--measure", "--test", str(signal)]
    assert main(["c", f"{file}:controller", *out]) == 0
    said = capsys.readouterr().out
    assert "Measured with a test signal of 2 ticks" in said
    assert "largest difference between float and double" in said
