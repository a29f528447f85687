"""The report in the order in which it is read: a summary that can stand alone, chapters, an appendix to leave out."""

import json
import math
import re
from dataclasses import replace
from functools import cache

import html5lib
import numpy as np
import pypdfium2
import pytest
from matplotlib.figure import Figure

from loopwright.blocks import Constant, Gain, Integrator, TransferFunction
from loopwright.diagrams import Diagram, Plot, Requirements, Section, Table, analyse
from loopwright.diagrams.report.pages.html import to_html
from loopwright.diagrams.report.pages.json import to_json
from loopwright.diagrams.report.pages.report import write_report
from loopwright.diagrams.report.sections.summary import MOST_REQUIREMENTS
from loopwright.diagrams.report.wires_on_loops import find_same
from loopwright.frequency import Number
from loopwright.types import Report, Verdict

pytestmark = pytest.mark.usefixtures("drawn_once")

PARTS = ("poles", "inner", "steps")
GAIN, LAG = 3.0, 0.1


def loop():
    """Return L = 3/(s (0.1 s + 1)), cut at three names of one loop."""
    place, lag = Integrator(name="place"), TransferFunction(numerator=[1.0], denominator=[LAG, 1.0], name="lag")
    error = (Constant(value=0.0, name="r") - place.y).named("e")
    u = Gain(gain=GAIN, name="gain")(error).named("u")
    return Diagram("loop", place(lag(u).named("v")))


@cache
def made():
    return analyse(loop(), only=PARTS, requirements=Requirements(phase_margin_deg=45, ms=1.8))


@cache
def page_of_made():
    return to_html(made())


def tree_of(report):
    return html5lib.parse(to_html(report), namespaceHTMLElements=False)


def sheets(report, folder):
    """Return the text of each sheet of a report's PDF."""
    (file,) = write_report(report, folder / "r.html", pdf=True)[1:]
    document = pypdfium2.PdfDocument(file)
    found = [page.get_textpage().get_text_range() for page in document]
    document.close()
    return found


def test_verdicts_come_first_then_the_contents_the_chapters_and_the_appendix():
    page = page_of_made()
    places = ["Verdict: passed.", 'id="f-overview_e_bode"', "<nav", 'id="s-poles"', 'id="s-steps"', 'id="numbers"']
    found = [page.index(place) for place in places]
    assert found == sorted(found)


def test_a_loop_has_one_bode_diagram_and_one_step_side_by_side_of_the_diagram_as_it_is():
    (summary,) = (s for s in made().sections if s.key == "summary")
    bode, step = summary.plots
    assert (bode.group, step.group) == ("e", "e")  # one for the three names of the loop
    w, size = bode.figure.axes[0].get_lines()[0].get_data()
    s = 1j * w
    L = GAIN / (s * (LAG * s + 1))
    np.testing.assert_allclose(size, np.abs(L), rtol=1e-9)
    np.testing.assert_allclose(bode.figure.axes[1].get_lines()[0].get_ydata(), np.degrees(np.angle(L)), atol=1e-6)
    t, y = step.figure.axes[0].get_lines()[0].get_data()
    w0, d = math.sqrt(GAIN / LAG), 1 / (2 * math.sqrt(GAIN * LAG))  # T = w0²/(s² + 2 d w0 s + w0²)
    wd = w0 * math.sqrt(1 - d**2)
    exact = 1 - np.exp(-d * w0 * t) * (np.cos(wd * t) + d * w0 / wd * np.sin(wd * t))
    np.testing.assert_allclose(y[t >= 0], exact[t >= 0], atol=1e-5)
    (group,) = (div for div in tree_of(made()).iter("div") if div.get("class") == "group")
    assert [figure.get("id") for figure in group.iter("figure")] == ["f-overview_e_bode", "f-overview_e_step"]


def test_the_summary_alone_has_no_chapters_and_the_same_numbers(tmp_path):
    whole, alone = made(), replace(made(), summary=True)
    assert to_json(alone) == to_json(whole)
    page = to_html(alone)
    assert re.findall(r'<section id="([^"]+)"', page) == ["s-summary"]
    assert "<nav" not in page
    assert "appendix" not in page
    ids, links = set(re.findall(r'\bid="([^"]+)"', page)), set(re.findall(r'href="#([^"]+)"', page))
    assert links <= ids
    assert len(sheets(alone, tmp_path)) <= 2


def test_without_the_appendix_the_report_ends_with_its_chapters():
    report = replace(made(), appendix=False)
    page = to_html(report)
    assert re.findall(r'<section id="([^"]+)" class="level2"', page) == ["s-summary", "s-poles", "s-inner", "s-steps"]
    assert "appendix" not in page
    ids, links = set(re.findall(r'\bid="([^"]+)"', page)), set(re.findall(r'(?:href="|url\()#([^")]+)', page))
    assert links <= ids
    whole = page_of_made()
    assert page.count("<table") < whole.count("<table")
    assert page.count("<figure") == whole.count("<figure")
    assert to_json(report) == to_json(made())


def test_arguments_reach_the_page():
    report = analyse(loop(), only=("poles",), summary=True, appendix=False)
    assert (report.summary, report.appendix) == (True, False)
    assert [s.key for s in report.sections] == ["summary", "poles"]
    assert "Closed-loop poles" not in to_html(report)
    assert "poles" in json.loads(to_json(report))


def test_a_loop_with_several_names_has_its_figures_once_and_the_numbers_of_each():
    (inner,) = (s for s in made().sections if s.key == "inner")
    by_key = {part.key: part for part in inner.sections}
    assert list(by_key) == ["e", "u", "v"]
    assert [bool(part.plots) for part in by_key.values()] == [True, False, False]
    assert "This is the loop at e" in by_key["u"].text[0]
    wanted = math.degrees(math.pi / 2 - math.atan(LAG * (w := crossover())))
    assert crossover() == w
    for key in by_key:
        found = made().numbers()[f"inner.{key}.continuous.phase_margin_deg"].value
        assert found == pytest.approx(wanted, abs=1e-8)


def crossover():
    """|L| = 1: ω² (0.01 ω² + 1) = 9."""
    return math.sqrt((-1 + math.sqrt(1 + 4 * LAG**2 * GAIN**2)) / (2 * LAG**2))


def numbers(**values):
    return {path: Number(value, "1", 0.0, "x") for path, value in values.items()}


def test_loops_are_one_only_where_all_their_numbers_agree():
    one = numbers(ms=1.5, pm=60.0, gm=math.inf, dm=math.nan)
    near = numbers(ms=1.5 * (1 + 1e-9), pm=60.0, gm=math.inf, dm=math.nan)
    assert find_same({"a": one, "b": near}) == {"b": "a"}
    for other in ({"ms": 1.5 * (1 + 1e-5)}, {"gm": 1e9}, {"dm": 0.0}, {"pm": -60.0}):
        assert find_same({"a": one, "b": {**one, **numbers(**other)}}) == {}
    assert find_same({"a": {}, "b": {}}) == {}


def test_a_loop_is_shown_by_one_that_has_more_variants_wherever_it_stands():
    few, more = numbers(ms=1.5), numbers(ms=1.5, delayed=1.7)
    assert find_same({"y": few, "u": more, "w": more}) == {"y": "u", "w": "u"}
    assert find_same({"y": numbers(ms=1.6), "u": more}) == {}


def many(count):
    """Return a diagram of some loops, L = (i + 1)/(s (0.05 (i + 1) s + 1))."""
    outputs = []
    for i in range(count):
        place = Integrator(name=f"place{i}")
        lag = TransferFunction(numerator=[1.0], denominator=[0.05 * (i + 1), 1.0], name=f"lag{i}")
        error = Constant(value=0.0, name=f"r{i}") - lag(place.y)
        outputs.append(place(Gain(gain=1.0 + i, name=f"gain{i}")(error).named(f"u{i}")))
    return Diagram("many", *outputs)


@pytest.mark.slow
def test_with_many_loops_the_weakest_are_shown_and_the_others_named():
    report = analyse(many(8), only=("inner",), requirements=Requirements(phase_margin_deg=30, ms=2.5, disk_margin=0.3))
    (summary,) = (s for s in report.sections if s.key == "summary")
    assert [plot.group for plot in summary.plots] == [f"u{i}" for i in range(2, 8)]  # the margin falls with i
    (said,) = (text for text in summary.text if "smallest disk margins" in text)
    assert "u0, u1" in said
    heights = {plot.figure.get_figheight() for plot in summary.plots}
    assert max(heights) < 1.3
    assert len(summary.tables[0].rows) == MOST_REQUIREMENTS
    assert f"{MOST_REQUIREMENTS} of 25 requirements" in summary.tables[0].note
    (chapter,) = (s for s in report.sections if s.key == "requirements")
    assert len(chapter.tables[0].rows) == len(report.review.results) == 25
    shown, every = ([row[0].verdict for row in of.tables[0].rows] for of in (summary, chapter))
    assert every[:MOST_REQUIREMENTS] == shown
    assert shown[0] is Verdict.FAILED or Verdict.FAILED not in every


def test_a_brief_table_has_only_the_confirmations_that_say_less():
    found = Number(1.0, "1", 0.0, "eigenvalues"), Number(math.nan, "1", math.nan, "it is not sampled")
    doubtful = Number(2.0, "1", 0.0, "")
    table = Table("T", ("a", "b", "c"), ((*found, doubtful),), "A note.", brief=True)
    page = to_html(Report("R", (Section("s", "S", ("Text.",), (table,)),), appendix=False))
    (note,) = re.findall(r'<p class="note">(.*?)</p>', page)
    assert "eigenvalues" not in note
    assert "No value: it is not sampled." in note
    assert "Not confirmed." in note


def small(height):
    figure = Figure(figsize=(3.3, height))
    figure.subplots().plot([0, 1], [1, 0])
    return figure


@pytest.mark.slow
@pytest.mark.parametrize("rows", [pytest.param(30, marks=pytest.mark.slow), 48])
def test_a_summary_has_two_sheets_where_smaller_figures_suffice_and_is_whole(rows, tmp_path):
    plots = tuple(Plot(f"p{i}{k}", f"Caption {i}{k}.", small(1.4), group=str(i)) for i in range(6) for k in "ab")
    table = Table("T", ("name", "value"), tuple((f"row{i}", float(i)) for i in range(rows)))
    summary = Section("summary", "Summary", ("Text.",) * 3, (table,), plots)
    report = Report("R", (summary, Section("b", "CHAPTER", ("Filling.",) * 20)))
    found = sheets(replace(report, summary=True), tmp_path)
    assert len(found) == 2
    for i in range(6):  # a pair is on one sheet
        assert any(f"Caption {i}a." in sheet and f"Caption {i}b." in sheet for sheet in found)
    text = "".join(found)
    assert all(f"row{i}" in text for i in range(rows))
    whole = sheets(report, tmp_path)
    assert all("Caption" not in sheet for sheet in whole[2:])
    assert "CHAPTER" not in whole[0].partition("Contents")[0]


@pytest.mark.slow
def test_progress_says_what_is_computed_and_confirmed():
    told = []
    analyse(loop(), only=("inner", "steps", "sensitivity"), progress=told.append)
    for said in (
        "margins at u, as it is",
        "confirming the margins at u, as it is",
        "step at u, as it is",
        "sensitivity at u",
    ):
        assert said in told
    confirmed = [said for said in told if said.startswith("confirming the sensitivity at ")]
    assert sum(said.endswith(" to gain.gain") for said in confirmed) == 1  # once for all wires of the loop


def test_the_heading_of_the_contents_is_on_the_sheet_of_its_lines(tmp_path):
    for lines in range(36, 56):
        summary = Section("summary", "Summary", ("Filling.",) * lines)
        parts = tuple(Section(f"c{i}", f"Chapter number {i} with a long title") for i in range(8))
        found = sheets(Report("R", (summary, *parts)), tmp_path)
        (at,) = [sheet for sheet in found if "CONTENTS" in sheet.upper()]
        listed = at.upper().partition("CONTENTS")[2].replace("\r\n", " ").replace("\n", " ")
        assert listed.strip().startswith(": ")  # on the line of the first chapter
        assert all(f"CHAPTER NUMBER {i} WITH" in listed for i in range(8))
