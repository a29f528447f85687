"""Figures that another process has drawn: the drawing is used once, and a figure that travels is the same figure."""

import pickle

import pytest

from loopwright.blocks import Integrator
from loopwright.diagrams import Diagram, analyse
from loopwright.diagrams.drawing import Drawing
from loopwright.diagrams.plotting import new_figure
from loopwright.diagrams.report.pages import Plot, Section, draw_section, keep_drawings
from loopwright.diagrams.report.pages.svg import embedded


def make_section():
    figure = new_figure(2.0)
    figure.add_subplot().plot([0.0, 1.0], [1.0, 3.0])
    inner = Section("b", "B", plots=(Plot("second", "", Drawing("<svg></svg>")),))
    return Section("a", "A", plots=(Plot("first", "", figure),), sections=(inner,)), figure


def test_a_figure_from_another_process_is_drawn_the_same():
    section, figure = make_section()
    sent = pickle.dumps(section)
    here = draw_section(section)
    assert here[1] == ""  # it is drawn where it is made
    assert draw_section(pickle.loads(sent)) == here
    assert type(pickle.loads(pickle.dumps(figure))) is type(figure)


def test_a_drawing_is_used_once():
    section, figure = make_section()
    plain = embedded(figure, "f").screen
    keep_drawings(section, ("<svg><g></g></svg>", ""))
    assert "<g></g>" in embedded(figure, "f").screen
    figure.axes[0].set_title("changed")  # a figure that is changed later is drawn anew
    assert embedded(figure, "f").screen not in (plain, "<svg><g></g></svg>")


def test_no_figure_is_drawn_before_it_is_looked_at(monkeypatch):
    plant = Integrator(name="plant")
    report = analyse(Diagram("loop", plant((0.0 - plant.y).named("u"))), only=("inner",))
    monkeypatch.setattr("matplotlib.figure.Figure.subplots", lambda *_, **__: 1 / 0)
    (section,) = report.sections
    (bode, *_), overview = section.sections[0].plots, section.sections[0].overview
    plots = (bode, *overview)
    for plot in plots:
        with pytest.raises(ZeroDivisionError):
            plot.figure  # noqa: B018  # it is drawn here
    monkeypatch.undo()
    assert bode.figure is bode.figure
    assert type(pickle.loads(pickle.dumps(bode)).figure) is type(bode.figure)
