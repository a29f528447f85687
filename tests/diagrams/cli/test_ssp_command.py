"""``loopwright ssp`` writes an SSP; run, draw and inspect take one."""

import json

import pytest

from loopwright.diagrams.cli import main
from support.ssp_files import adder

LOOP = """
from loopwright import Diagram, Fmu
from loopwright.blocks import Constant, PythonFunction

def part(name, k):
    return Fmu({file!r}, name=name, start={{"k": k, "mode": 1, "number": 0, "flag": 0, "s": [0.0, 0.0]}})

a, b = part("a", 1.0), part("b", 1.0)
loop = Diagram("loop", a(u=b.y * 1.0), b(u=Constant(value=0.5, name="push", unit="m/s")).y.named("out"))
other = part("a", 1.0)
own = Diagram("own", other(u=PythonFunction(lambda u: u, name="own")(other.y)))
"""


@pytest.fixture
def loop(tmp_path, monkeypatch, cache):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(LOOP.format(file=str(adder(tmp_path))))
    return tmp_path


def test_a_diagram_is_written_looked_at_and_run(loop, capsys):
    assert main(["ssp", "loop.py:loop", "--stop", "0.5", "--step", "0.125", "--set", "push.value=0.25"]) == 0
    assert "loop.ssp" in capsys.readouterr().out
    assert main(["inspect", "loop.ssp", "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert (about["stop"], about["step"], about["inputs"], about["outputs"]) == (
        0.5,
        0.125,
        {"push": "m/s"},
        {"out": "m"},
    )
    assert main(["run", "loop.ssp", "--json"]) == 0  # for the time, and by the step, that the file proposes
    found = json.loads(capsys.readouterr().out)
    assert found["signals"]["out"]["end"] == pytest.approx(0.5 * 1.25)
    assert main(["draw", "loop.ssp:SystemStructure.ssd"]) == 0
    assert (loop / "loop.svg").is_file()


def test_what_does_not_fit_is_named(loop, capsys):
    assert main(["ssp", "loop.py:own"]) == 1
    assert "own" in capsys.readouterr().err
    assert main(["ssp", "loop.py:loop", "--out", "loop.zip"]) == 2
    assert main(["inspect", "none.ssp"]) == 1
    assert "expected an SSP" in capsys.readouterr().err
    assert main(["run", "none.ssp", "--duration", "1"]) == 1
