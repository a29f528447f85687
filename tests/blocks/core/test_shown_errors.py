"""Errors as IPython shows them: the user's own lines and the message; all frames on request."""

import re
import sys
import traceback
from types import SimpleNamespace

import pytest
from IPython.core.ultratb import AutoFormattedTB

from loopwright.blocks import Block, Gain, Input, LoopwrightError, Output, Step
from loopwright.diagrams import Diagram

ESCAPES = re.compile(r"\x1b\[[0-9;]*m")


class Inverse(Block):
    """1/(u − 1), written so that it can't be traced."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return 1 / (u.missing - 1)


def shown(monkeypatch, make, mode="Context"):
    """Return the lines that IPython prints for the error of a function."""
    formatter = AutoFormattedTB(mode=mode)
    shell = SimpleNamespace(InteractiveTB=formatter)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    with pytest.raises(LoopwrightError) as found:
        make()
    return ESCAPES.sub("", "\n".join(found.value._render_traceback_())).splitlines(), found.value


def test_the_users_line_and_the_message_are_shown_without_frames_of_the_library(monkeypatch):
    lines, error = shown(monkeypatch, lambda: Diagram("d", Gain(gain=2.0)))
    text = "\n".join(lines)
    assert 'Diagram("d", Gain(gain=2.0))' in text  # this very line
    assert str(error) in text
    assert len(traceback.extract_tb(error.__traceback__)) > 4
    files = [line for line in lines if line.startswith("File")]
    assert all(__file__.rpartition("/")[2] in line for line in files), files  # this file alone
    assert re.search(r"^\d+ frames are hidden; %tb Verbose shows all", lines[-1])


def test_the_users_own_equation_is_shown_below_the_message(monkeypatch):
    lines, error = shown(monkeypatch, lambda: Diagram("d", Inverse(name="inverse")(Step(times=0.5, values=1.0))))
    cause = lines.index("Caused by:")
    assert lines.index(f"TraceError: {error}") < cause
    (line,) = (
        i for i, text in enumerate(lines) if text.startswith("-") and text.endswith("return 1 / (u.missing - 1)")
    )
    assert line > cause
    assert any(text.startswith("AttributeError: ") for text in lines[line:])


def test_all_frames_are_shown_where_they_are_asked_for(monkeypatch):
    lines, error = shown(monkeypatch, lambda: Diagram("d", Gain(gain=2.0)), mode="Verbose")
    shown_frames = [line for line in lines if line.startswith("File")]
    assert len(shown_frames) == len(traceback.extract_tb(error.__traceback__))


def test_without_ipython_it_is_pythons_own_traceback(monkeypatch):
    monkeypatch.delitem(sys.modules, "IPython")
    with pytest.raises(LoopwrightError) as found:
        Diagram("d", Gain(gain=2.0))
    assert found.value._render_traceback_() == traceback.format_exception(found.value)


CELLS = {
    "parameter": "from loopwright.blocks import Gain\nGain(gian=2.0)",
    "unwired": "from loopwright.blocks import Gain\nfrom loopwright.diagrams import Diagram\nDiagram('d', Gain(gain=2.0))",
    "signal": (
        "from loopwright.blocks import Step\nfrom loopwright.diagrams import Diagram\n"
        "run = Diagram('d', Step(times=0.5, values=1.0).named('y')).simulate(1.0, step=0.1, progress=False)\n"
        "run['speeed']"
    ),
    "solver": (
        "from loopwright.blocks import Step\nfrom loopwright.diagrams import Diagram\n"
        "Diagram('d', Step(times=0.5, values=1.0).named('y')).simulate(1.0, step=0.1, solver='RK4x', progress=False)"
    ),
    "file": "from loopwright.fmus import Fmu\nFmu('nowhere.fmu', name='plant')",
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the kernel's transport
def test_in_a_notebook_the_message_is_within_the_first_twelve_lines():
    """Before, 21 to 109 lines stood above it."""
    import nbclient  # which takes longer to import than most files of tests
    import nbformat

    cells = [nbformat.v4.new_code_cell(source) for source in CELLS.values()]
    notebook = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(notebook, timeout=120, allow_errors=True).execute()
    for cell in notebook.cells:
        (output,) = (o for o in cell.outputs if o.output_type == "error")
        lines = ESCAPES.sub("", "\n".join(output.traceback)).splitlines()
        assert len(lines) <= 14, lines
        assert any(line.startswith(output.ename + ":") for line in lines[:12]), lines
        assert f"----> {len(cell.source.splitlines())} {cell.source.splitlines()[-1]}" in "\n".join(lines)
