"""Figures and tables of a report: one color for a variant, resonances in full, ticks apart, no empty columns."""

import re
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, StateSpace, TransferFunction
from loopwright.diagrams import Diagram, Section, Table, analyse
from loopwright.diagrams.plotting import BLUE, set_degrees, set_magnitudes
from loopwright.diagrams.report.case import Case
from loopwright.diagrams.report.figures import AxisUnits, MeasuredCurve, contact_admittance, contact_map, measured
from loopwright.diagrams.report.figures.loop_figures import DrawnLoops, bode, nyquist
from loopwright.diagrams.report.figures.step_figures import draw_answer
from loopwright.diagrams.report.pages import Judged
from loopwright.diagrams.report.pages.definitions import definition
from loopwright.diagrams.report.pages.html import to_html
from loopwright.diagrams.report.pages.svg import embedded
from loopwright.diagrams.report.sections.loops import gang_of_four
from loopwright.frequency import Number
from loopwright.types import Report, Verdict
from support import reviewed


def resonant(damping=1e-3):
    """L = 0.2/(s² + 2 ζ s + 1) + 1/s, by its closed form."""
    body = StateSpace(A=[[0.0, 1.0], [-1.0, -2 * damping]], B=[0.0, 1.0], C=[0.2, 0.0], name="body")
    sway, drift = Integrator(name="drift"), body
    error = (Constant(value=0.0, name="r") - (sway.y + drift.y)).named("e")
    return Diagram("resonant", sway(error), drift(error))


def drawn(diagram, wire, kind=bode):
    """Return the lines of a loop's figure."""
    case = Case(diagram.wired)
    (v,) = case.usable()
    L = v.loop(wire)
    from loopwright.frequency import margins

    of = DrawnLoops(wire, {v.key: L}, {v.key: margins(L)}, {v.key: v.title}, case.looks, AxisUnits())
    return kind("k", of).figure


def test_a_resonance_is_drawn_to_its_peak():
    lines = drawn(resonant(), "e").axes[0].get_lines()
    w, size = lines[0].get_data()
    peak = np.abs(0.2 / (2j * 1e-3 + 0.0) + 1 / 1j)  # at ω = 1
    assert np.max(size) == pytest.approx(peak, rel=1e-2)
    exact = np.abs(0.2 / (1 - w**2 + 2e-3j * w) + 1 / (1j * w))
    np.testing.assert_allclose(size, exact, rtol=1e-9)
    near = w[(w > 0.99) & (w < 1.01)]
    assert len(near) > 40


def test_a_nyquist_curve_has_no_chord_across_an_undamped_resonance():
    lines = drawn(resonant(0.0), "e", nyquist).axes[-1].get_lines()
    curve = max(lines, key=lambda line: len(line.get_xdata()))
    x, y = curve.get_data()
    assert np.any(np.isnan(x))
    jumps = np.abs(np.diff(x + 1j * y))
    size = np.maximum(np.abs(x[:-1]), np.abs(x[1:])) + np.abs(y[:-1])
    assert np.nanmax(jumps / np.maximum(size, 1.0)) < 1.0  # a chord across would be twice the size


def test_a_variant_has_one_color_in_all_figures():
    for name in ("tank", "crane"):
        case = Case(getattr(reviewed, name)().wired)
        looks = case.looks
        assert looks[case.actual.key]["color"] == BLUE
        assert len({str(look["color"]) + str(look["linestyle"]) for look in looks.values()}) == len(looks)
    delayed = Case(reviewed.tank(delay=1).wired)
    assert delayed.looks["sampled_d1"]["color"] == BLUE  # the diagram as it is
    assert delayed.looks["sampled_d0"]["color"] != BLUE


@pytest.mark.slow
def test_the_gang_of_four_is_drawn_where_the_whole_loop_goes_through_the_other_wire():
    assert (
        gang_of_four(Case(reviewed.drive().wired), "voltage", "controller.voltage") == ()
    )  # the speed loop bypasses it
    lag, place = TransferFunction(numerator=[2.0], denominator=[0.1, 1.0], name="lag"), Integrator(name="place")
    u = Gain(gain=3.0, name="gain")(Constant(value=0.0, name="r") - place.y).named("u")
    (plot,) = gang_of_four(Case(Diagram("single", place(lag(u).named("v"))).wired), "u", "u")
    left, right = plot.figure.axes
    w, there = left.get_lines()[0].get_data()
    s = 1j * w
    L = 6.0 / (s * (0.1 * s + 1))
    np.testing.assert_allclose(there, np.abs(2.0 / (0.1 * s + 1) / (1 + L)), rtol=1e-9)
    np.testing.assert_allclose(right.get_lines()[0].get_ydata(), np.abs(3.0 / s / (1 + L)), rtol=1e-9)


def boxes(texts, renderer, side):
    shown = [t for t in texts if t.get_text() and t.get_visible()]
    return sorted((getattr(t.get_window_extent(renderer), f"interval{side}") for t in shown), key=lambda b: b[0])


def check_layout(figure):
    """Check that no ticks overlap, that every axis with numbers says its unit or name, and that no legend hides data."""
    renderer = figure.canvas.get_renderer()
    figure.draw(renderer)
    for ax in (ax for ax in figure.axes if ax.get_visible()):
        for axis, side in ((ax.xaxis, "x"), (ax.yaxis, "y")):
            low, high = sorted(getattr(ax, f"get_{side}lim")())
            texts = [t for t in axis.get_ticklabels() if low <= t.get_position()[side == "y"] <= high]
            found = boxes(texts, renderer, side)
            assert all(one[1] < two[0] for one, two in pairwise(found)), (ax.get_title(), side)
            assert not any("-" in t.get_text() for t in texts if t.get_text()[1:2].isdigit())  # a minus is one
        assert ax.get_legend() is None
        top = ax.get_window_extent(renderer).y1
        assert all(legend.get_window_extent(renderer).y0 >= top - 1 for legend in figure.legends)
    extent = figure.bbox
    for legend in figure.legends:
        box = legend.get_window_extent(renderer)
        assert extent.x0 - 1 <= box.x0
        assert box.x1 <= extent.x1 + 1


@pytest.mark.drawn(1)
@pytest.mark.parametrize("span", [(30.0, 450.0), (1.0, 1.9)])
def test_ticks_of_frequencies_do_not_overlap(span):
    w = np.geomspace(*span, 50)
    figure = measured("m", "u", MeasuredCurve("model", w, 1 / (1j * w), w, 1 / (1j * w)), AxisUnits()).figure
    check_layout(figure)
    assert all(len(ax.get_xticks()) >= 2 for ax in figure.axes)


def plots_of(sections):
    for section in sections:
        yield from section.plots
        yield from plots_of(section.sections)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("tank", ("inner",)),
        pytest.param("tank", ("inner", "steps", "sensitivity", "injection"), marks=pytest.mark.slow),
        pytest.param("drive", ("inner", "steps", "sensitivity", "injection"), marks=pytest.mark.slow),
        pytest.param("crane", ("inner", "steps", "sensitivity", "injection"), marks=pytest.mark.slow),
    ],
)
def test_no_figure_of_a_report_has_overlapping_ticks_or_a_legend_over_its_curves(name, parts):
    for decibels in (False, True) if len(parts) > 1 else (False,):
        report = analyse(getattr(reviewed, name)(), only=parts, decibels=decibels, hertz=decibels)
        plots = list(plots_of(report.sections))
        assert len(plots) >= 3
        for plot in plots:
            check_layout(plot.figure)


def test_measured_points_and_the_model_have_two_colors_and_bars_of_their_uncertainty():
    w = np.geomspace(0.1, 10.0, 20)
    data = MeasuredCurve("model", w, 1 / (1j * w), w, 1.1 / (1j * w), np.full(20, 0.2))
    left, right = measured("m", "u", data, AxisUnits()).figure.axes
    model, points = left.get_lines()
    assert model.get_color() != points.get_color()
    assert {text.get_text() for text in left.figure.legends[0].get_texts()} == {"model", "measured"}
    (bars,) = right.collections
    ends = np.array([segment[:, 1] for segment in bars.get_segments()])
    np.testing.assert_allclose(ends - -90.0, np.degrees(np.arcsin(0.2)) * np.array([[-1, 1]] * 20), atol=1e-9)


def test_a_column_without_entries_is_not_shown():
    table = Table("t", ("name", "empty", "of"), (("a", "", 1.0), ("b", None, 2.0)))
    page = to_html(Report("r", (Section("s", "S", (), (table,)),)))
    assert "empty" not in page
    assert ">of<" in page.replace("</th>", "<")


def test_a_number_has_the_digits_of_its_table():
    number = Number(84.62914, "deg", 1e-9, "x")
    for digits, text in ((6, "84.6291°"), (4, "84.63°")):
        page = to_html(Report("r", (Section("s", "S", (), (Table("t", ("", "v"), (("a", number),), digits=digits),)),)))
        assert f">{text.rstrip('°')}<" in page


def test_verdicts_are_marked_in_the_text_and_in_each_row():
    row = (Judged("failed", Verdict.FAILED), "x")
    other = (Judged("failed", Verdict.FAILED), "y")
    section = Section(
        "s", "S", (Judged("Verdict: failed.", Verdict.FAILED),), (Table("t", ("verdict", "of"), (row, other)),)
    )
    page = to_html(Report("r", (section,)))
    assert '<p class="verdict failed">Verdict: failed.</p>' in page
    assert page.count('class="failed"') == 2


def test_a_block_that_is_defined_at_samples_has_no_continuous_variant_and_the_report_says_so():
    case = Case(reviewed.crane().wired)
    assert case.variants["continuous"].problem.startswith("controller.observer is defined at samples only")
    assert "sample_time=" not in case.variants["continuous"].problem


@pytest.mark.drawn(1)
@pytest.mark.parametrize("in_a_grid", [True, False])
def test_a_figure_is_laid_out_once_and_drawn_once(in_a_grid, monkeypatch):
    w = np.geomspace(1.0, 100.0, 9)
    figure = measured("m", "u", MeasuredCurve("model", w, 1 / (1j * w), w, 1 / (1j * w)), AxisUnits()).figure
    if not in_a_grid:
        figure = contact_map("m", "hand", w, w, np.ones((9, 9))).figure
    engine, draws, layouts = figure.get_layout_engine(), [], []
    whole, execute = type(figure).draw, type(engine).execute
    monkeypatch.setattr(type(figure), "draw", lambda self, renderer: draws.append(1) or whole(self, renderer))
    monkeypatch.setattr(type(engine), "execute", lambda self, fig: layouts.append(1) or execute(self, fig))
    assert "<svg" in embedded(figure, "k").screen
    assert (len(draws), len(layouts)) == (1, 0 if in_a_grid else 1)
    assert figure.get_layout_engine() is engine


def test_a_crossings_margin_is_defined_as_that_crossings_own():
    term, text = definition("inner.u.sampled_d0.gain_crossover_2.phase_margin_deg")
    assert term == "gain_crossover.phase_margin_deg"
    assert "this crossing" in text
    assert definition("inner.u.sampled_d0.phase_margin_deg")[0] == "phase_margin_deg"
    assert definition("measured.u.interval.ms.low")[0] == "low"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["drive", "crane", "tank"])
def test_every_number_has_a_definition_and_a_confirmation(name):
    report = analyse(getattr(reviewed, name)(), only=("subject", "operating_points", "poles", "inner", "steps"))
    for path, number in report.numbers().items():
        assert definition(path) is not None, path
        assert number.given or number.confirmed_by.strip(), path


@pytest.mark.slow
def test_maps_and_admittances_have_no_transparent_faces_whose_edges_a_pdf_shows():
    k, b = np.geomspace(10.0, 1e5, 30), np.geomspace(0.1, 7.0, 20)
    stable = np.log10(k)[None, :] - 3.0 - np.log10(b)[:, None]
    w = np.geomspace(0.1, 1e3, 50)
    for plot in (contact_map("m", "hand", k, b, 50.0 * stable), contact_admittance("a", "hand", w, 1 / (1j * w + 1))):
        check_layout(plot.figure)
        svg = str(embedded(plot.figure, "k").screen)
        assert not re.search(r"(?<!stroke-)opacity: 0", svg)
    (ax, bar) = contact_map("m", "hand", k, b, 50.0 * stable).figure.axes
    assert ax.get_ylabel() == "damping bₑ [N·s/m]"
    assert "−100" in [text.get_text() for text in bar.get_yticklabels()]


@pytest.mark.parametrize(("record", "shown"), [(100.0, 4.0 * np.log(50.0)), (6.0, 6.0)])
def test_a_step_that_has_settled_is_not_drawn_to_the_end_of_a_long_record(record, shown):
    """1 − exp(−t/τ) is within 2 % from t = τ log 50 on; the record has so many time constants τ = 3 s."""
    t = np.linspace(0.0, 3.0 * record, 20001)
    y = 1.0 - np.exp(-t / 3.0)
    got = SimpleNamespace(t=t, d=np.ones_like(t), held=False, prediction=y, answer=lambda to_output, linear=False: y)
    figure = draw_answer({"it": got}, {"it": {"color": BLUE}}, 2.0, 3.0, to_output=True)
    for line in figure.axes[0].lines[:2]:
        assert max(line.get_xdata()) == pytest.approx(3.0 * shown, rel=1e-3)


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("ends", [(-183.0, -96.0), (-172.0, -100.0), (-100.0, -60.0), (-200.0, 20.0), (-95.0, -84.0)])
def test_a_phase_has_two_labels_at_least(ends, few):
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    ax.set_ylim(*ends)
    set_degrees(ax, few=few)
    ticks = [tick for tick in ax.get_yticks() if ends[0] <= tick <= ends[1]]
    assert 2 <= len(ticks) <= 8


@pytest.mark.parametrize("decibels", [False, True])
def test_a_curve_that_is_0_at_all_frequencies_is_named_in_words(decibels):
    """Its logarithm has no place on the axis; matplotlib warned, and warnings are errors here."""
    from matplotlib.figure import Figure

    units, w = AxisUnits(decibels=decibels), np.geomspace(0.1, 10.0, 20)
    alone, beside = Figure().subplots(1, 2)
    alone.semilogx(w, units.magnitude(0.0 * w), label="as it is")
    beside.semilogx(w, units.magnitude(0.0 * w), label="as it is")
    beside.semilogx(w, units.magnitude(1.0 / w), label="other")
    for ax in (alone, beside):
        set_magnitudes(ax, units)
        ax.figure.canvas.draw()
    assert [text.get_text() for text in alone.texts] == ["0 at all frequencies"]
    assert [text.get_text() for text in beside.texts] == ["as it is: 0 at all frequencies"]
    assert np.allclose(beside.lines[1].get_ydata(), units.magnitude(1.0 / w))
