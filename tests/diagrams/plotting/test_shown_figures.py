"""Figures of a person are pyplot's, those of reports and threads nobody's; a notebook shows each of them once."""

import subprocess
import sys
import threading
from importlib.util import find_spec

import matplotlib
import matplotlib.pyplot as plt
import pytest

from loopwright.blocks import Gain, Ramp, UnknownNameError
from loopwright.diagrams import Diagram
from loopwright.diagrams.plotting import new_figure, shown_figure


@pytest.fixture(scope="module")
def run():
    ramp = Gain(gain=2.0, name="kp")(Ramp(slope=1.0, name="ramp")).named("y")
    return Diagram("d", ramp).simulate(1.0, step=0.5, progress=False)


def test_a_plot_is_a_figure_of_pyplot_and_changes_none_of_its_settings(run):
    before, backend = dict(matplotlib.rcParams), matplotlib.get_backend()
    figure = run.plot("y")
    assert plt.gcf() is figure
    assert plt.get_fignums() == [figure.number]
    assert (dict(matplotlib.rcParams), matplotlib.get_backend()) == (before, backend)
    plt.close(figure)
    assert plt.get_fignums() == []


def test_ticks_that_come_with_a_zoom_have_the_style_of_the_others(run):
    ax = run.plot("y").axes[0]
    with matplotlib.rc_context({"xtick.labelsize": 30, "ytick.labelsize": 30, "grid.color": "red"}):
        ax.set_xlim(0.0, 1e-3)
        ticks = [*ax.xaxis.get_major_ticks(40), *ax.yaxis.get_major_ticks(40)]
    assert {tick.label1.get_fontsize() for tick in ticks} == {7.0}
    assert {tick.gridline.get_color() for tick in ticks} == {"#E6E6E6"}


def test_what_fails_leaves_no_figure(run):
    with pytest.raises(UnknownNameError):
        run.plot("z")
    with pytest.raises(ZeroDivisionError), shown_figure(2.0):
        _ = 1 / 0
    assert plt.get_fignums() == []


def test_axes_that_are_given_are_drawn_into(run):
    figure, ax = plt.subplots()
    assert run.plot("y", axes=[ax]) is figure
    assert plt.get_fignums() == [figure.number]


def test_other_threads_and_pages_have_figures_of_their_own(run):
    made = [new_figure(2.0)]
    with shown_figure(2.0, is_shown=False) as figure:
        made.append(figure)
    thread = threading.Thread(target=lambda: made.append(run.plot("y")))
    thread.start()
    thread.join()
    assert len(made) == 3
    assert plt.get_fignums() == []
    assert made[-1].canvas.manager is None


PROGRAM = """
import sys
from loopwright.blocks import Gain, Integrator, Step
from loopwright.diagrams import Diagram
motor = Integrator(name="motor")
d = Diagram("d", motor(Gain(gain=2.0, name="kp")(Step(times=0.0, values=1.0, name="wish") - motor.y).named("u")))
run = d.simulate(1.0, progress=False)
print(any(m.startswith("matplotlib") for m in sys.modules))
d.report("r.html")
d.worst_case({"kp.gain": (1.0, 2.0)}, "u", count=4)
import matplotlib.pyplot as plt  # which python-control imports
print(plt.get_fignums())
figure = run.plot("motor")
print(plt.get_fignums())
plt.show()
"""


@pytest.mark.slow
def test_a_script_shows_its_figures_and_reports_leave_none(tmp_path):
    command = [sys.executable, "-W", "error", "-c", PROGRAM]
    ran = subprocess.run(command, check=True, cwd=tmp_path, env={"MPLBACKEND": "pdf"}, capture_output=True, text=True)
    assert ran.stdout.splitlines()[:1] == ["False"]  # a run imports no matplotlib
    assert ran.stdout.splitlines()[-2:] == ["[]", "[1]"]  # a report leaves no figures in pyplot, and a plot one


CELLS = {
    "inline": {
        "run.plot('y')\nx = 1": ["y"],
        "run.plot('y')": ["y"],
        "run.plot('y')\nfigure = run.plot('kp')\nfigure": ["y", "kp"],
        "figure": ["kp"],
        "figure.show()": ["kp"],
        "figure = run.plot('y'); figure.show()": ["y"],
        "display(figure)": ["y"],
        "plt.ioff(); later = run.plot('kp')": [],
        "plt.show()": ["kp"],
        "plt.ion(); assert plt.get_fignums() == []": [],
        "print(matplotlib.rcParams['font.size'])": [],
    },
    "widget": {
        "%matplotlib widget": [],
        "run.plot('y')\nx = 1": ["live"],
        "run.plot('y')": ["live"],
        "figure = run.plot('y')\nfigure": ["live"],
        "figure": ["live"],
    },
}
FIRST = """
import matplotlib, matplotlib.pyplot as plt
from loopwright.blocks import Gain, Ramp
from loopwright.diagrams import Diagram
ramp = Gain(gain=2.0, name="kp")(Ramp(slope=1.0, name="ramp")).named("y")
run = Diagram("d", ramp).simulate(1.0, step=0.5, progress=False)
"""


@pytest.mark.slow
@pytest.mark.parametrize("backend", CELLS)
def test_a_notebook_shows_each_figure_once(backend):
    import nbclient
    import nbformat

    missing = backend == "widget" and find_spec("ipympl") is None
    assert not missing, "the live view is needed: pip install '.[notebook]', then run this test again"
    cells = CELLS[backend]
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in (FIRST, *cells)])
    nbclient.NotebookClient(book, timeout=120, kernel_name="python3").execute()
    images = {}
    for cell, expected in zip(book.cells[1:], cells.values(), strict=True):
        shown = [output.data for output in cell.outputs if "image/png" in output.get("data", {})]
        assert len(shown) == len(expected), cell.source
        for data, name in zip(shown, expected, strict=True):
            if name == "live":
                assert "application/vnd.jupyter.widget-view+json" in data, cell.source
            else:  # the same picture each time
                assert images.setdefault(name, data["image/png"]) == data["image/png"], cell.source
    assert backend == "widget" or images["y"] != images["kp"]
