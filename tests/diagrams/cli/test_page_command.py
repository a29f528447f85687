"""The command ``loopwright page``."""

import pytest

from loopwright.diagrams.cli import main

LOOP = """
from loopwright import Diagram, subsystem
from loopwright.blocks import Constant, Gain


@subsystem(sample_time=0.01)
def control(u):
    return Gain(gain=2.0, name="k")(u).named("y")


loop = Diagram("loop", control(Constant(value=0.0, name="u")))
"""


@pytest.fixture
def subject(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(LOOP, encoding="utf-8")
    return "loop.py:loop"


def test_a_page_is_written(subject, tmp_path, capsys):
    assert main(["page", subject, "--input", "u=-1:1", "--slider", "k.gain", "--plot", "y,u", "--speed", "2"]) == 0
    html = (tmp_path / "loop.html").read_text(encoding="utf-8")
    assert '"name":"k.gain","label":"k.gain","unit":"","low":0.0,"high":4.0' in html
    assert '"low":-1.0,"high":1.0' in html
    assert capsys.readouterr().out.startswith("loop.html: ")


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["--input", "u=3"], 2, "expected a range, such as u=0:5"),
        (["--input", "u=1:0"], 2, "expected a range"),
        (["--out", "loop.txt"], 2, "expected a page; name it loop.html"),
        (["--slider", "zz"], 1, "nothing is called 'zz'"),
    ],
)
def test_wrong_usage_is_an_error_and_writes_nothing(subject, tmp_path, capsys, options, status, words):
    assert main(["page", subject, *options]) == status
    assert words in capsys.readouterr().err
    assert not list(tmp_path.glob("*.html"))
