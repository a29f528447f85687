"""Reports as HTML, PDF and JSON: whole, without network or script, every number followed to its definition."""

import json
import math
import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path

import html5lib
import pypdfium2
import pytest
from matplotlib.figure import Figure

from loopwright.blocks import DefinitionError, Gain, OptionError, Sine
from loopwright.blocks.core import print_unit, with_unit
from loopwright.diagrams import Diagram, experiments
from loopwright.diagrams.frequency.number import Confirmation, Number, method_of
from loopwright.diagrams.report.figures.drawings import with_drawing
from loopwright.diagrams.report.pages.definitions import definition
from loopwright.diagrams.report.pages.document import Plot, Section, Table
from loopwright.diagrams.report.pages.html import marked, to_html
from loopwright.diagrams.report.pages.json import to_json
from loopwright.diagrams.report.pages.printed_values import (
    cell,
    is_numeric,
    plain,
    quantity,
    tolerance_text,
    value_text,
)
from loopwright.diagrams.report.pages.report import Report, check_files, write_report

pytestmark = pytest.mark.usefixtures("drawn_once")

BY_EIGENVALUES, BY_GRID = "closed-loop eigenvalues <both> sides", "a grid ten times as fine"


def curve():
    figure = Figure(figsize=(4, 2))
    figure.subplots().plot([0, 1], [1, 0])
    return figure


def report(rows=3):
    numbers = {
        "par.sampled_d0.phase_margin_deg": Number(66.06123456789, "deg", 1e-9, BY_EIGENVALUES),
        "par.sampled_d0.gain_margin_high": Number(math.inf, "1", 0.0, BY_EIGENVALUES),
        "par.sampled_d0.delay_margin_s": Number(math.nan, "s", math.nan, "the closed loop is not stable"),
        "par.sampled_d0.ms": Number(1.25, "1", 1e-8, BY_GRID),
    }
    table = Table(
        "Margins & more", ("loop", "phase margin", "gain margin", "delay", "M_s"), (("par", *numbers.values()),)
    )
    long = Table(
        "Parameters", ("block", "value"), tuple((f"b{i // 2}", float(i)) for i in range(rows)), "A note with `code`."
    )
    inner = Section(
        "inner",
        "Inner loops",
        ("First.", "- one", "- two", "Last."),
        (table, long),
        (Plot("bode", "Bode.", curve()), Plot("bode", "Again.", curve())),
        numbers,
    )
    subject = Section("subject", "What was analysed", sections=(Section("part", "A part"),))
    return Report("Report of a < b", (subject, inner), {"diagram": "fig3", "versions": {"NumPy": "2.1"}, "empty": ""})


def parsed(html):
    parser = html5lib.HTMLParser(namespaceHTMLElements=False, strict=False)
    tree = parser.parse(html)
    assert parser.errors == []
    return tree


def text_of(element):
    return re.sub(r"\s+", " ", "".join(element.itertext())).strip()


def test_the_page_is_valid_and_needs_no_network_and_no_script_but_that_of_drawings():
    html = to_html(with_drawing(report(), experiments.compliance().diagram.wired))
    tree = parsed(html)
    drawings = [div for div in tree.iter("div") if div.get("class") == "lw-live"]
    assert len(list(tree.iter("script"))) == 2 * len(drawings) == sum(len(list(d.iter("script"))) for d in drawings)
    assert not list(parsed(to_html(report())).iter("script"))
    assert not list(tree.iter("link"))
    assert not re.search(r"""(src|href)=["']?(?!#|["']?#)""", re.sub(r"xmlns:xlink=\S+", "", html))
    assert "@import" not in html
    assert not re.search(r"url\((?!#)", html)


def test_ids_are_unique_and_every_link_leads_somewhere():
    html = to_html(with_drawing(report(), experiments.compliance().diagram.wired))
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(set(ids)) == len(ids)
    links = set(re.findall(r'(?:href="|url\()#([^")]+)', html))
    assert links
    assert links <= set(ids)


def test_a_number_leads_to_its_path_tolerance_confirmation_and_definition():
    tree = parsed(to_html(report()))
    rows = {row.get("id"): row for row in tree.iter("tr") if row.get("id")}
    (link,) = [a for a in tree.iter("a") if text_of(a) == "66.0612"]
    path = "inner.par.sampled_d0.phase_margin_deg"
    assert link.get("href") == f"#n-{path}"
    assert "±1×10⁻⁹" in link.get("title")
    assert BY_EIGENVALUES in link.get("title")
    line = rows[f"n-{path}"]
    assert [text_of(td) for td in line.iter("td")] == [path, "66.06123457", "°", "±1×10⁻⁹", "[1]"]
    assert next(a for a in line.iter("a")).get("href") == "#d-phase_margin_deg"
    assert "ends stability" in text_of(rows["d-phase_margin_deg"])
    reasons = {li.get("id"): text_of(li) for li in tree.iter("li") if li.get("id")}
    assert reasons["why1"] == BY_EIGENVALUES


def test_a_number_without_a_path_leads_to_the_definition_of_its_column():
    left, named = Number(0.5, "1", 0.0, "", given=True), Number(0.25, "1", 0.0, "", given=True)
    table = Table("T", ("name", "distance", "value"), (("a", left, named),), terms={"distance": "distance_to_limit"})
    tree = parsed(to_html(Report("R", (Section("s", "S", ("Text.",), (table,), (), {"ms": named}),))))
    (link,) = [a for a in tree.iter("a") if text_of(a) == "0.5"]
    assert link.get("href") == "#d-distance_to_limit"
    rows = {row.get("id"): row for row in tree.iter("tr") if row.get("id")}
    assert "negative beyond the limit" in text_of(rows["d-distance_to_limit"])


def test_keys_of_definitions_have_room_on_paper(tmp_path):
    """The longest key and its definition don't overlap: all of the key stands left of the definition's text."""
    keys = ("phase_margin_deg", "delay_margin_s", "disk_margin", "gain_crossover_1.phase_margin_deg", "residual")
    numbers = {
        f"inner.u.{key}": Number(45.0 + i, "deg", 0.0, "", given=True) for i, key in enumerate((*keys, "affine"))
    }
    report = Report("R", (Section("s", "S", ("Text.",), (), (), numbers),))
    (file,) = write_report(report, tmp_path / "r.html", pdf=True)[1:]
    document = pypdfium2.PdfDocument(file)
    pages = [page.get_textpage() for page in document]
    (page,) = [page for page in pages if "The rotation of L" in page.get_text_range()]
    text = page.get_text_range()
    begin = page.get_charbox(text.index("The rotation of L"))[0]
    key = text.rindex("gain_crossover", 0, text.index("The rotation of L"))
    right = max(page.get_charbox(i)[2] for i in range(key, text.index("The rotation of L")) if text[i].strip())
    document.close()
    assert right < begin


def test_the_heading_of_the_details_does_not_stand_alone_at_the_end_of_a_page(tmp_path):
    rows = tuple((f"package{i}", "1.0") for i in range(9))
    for lines in (45, 58, 59):
        table = Table("T", ("package", "version"), rows, details=True)
        parts = Section("a", "First", ("Filling.",) * lines, (table,))
        (file,) = write_report(Report("R", (parts,)), tmp_path / "r.html", pdf=True)[1:]
        document = pypdfium2.PdfDocument(file)
        pages = [page.get_textpage().get_text_range() for page in document]
        document.close()
        (last,) = [page for page in pages if "package0" in page]
        assert "C Details" in re.sub(r"\s+", " ", last)


def test_confirmations_stand_below_the_table_by_letters():
    html = to_html(report())
    assert re.search(r"66\.0612</a><sup>a</sup>", html)
    assert "<sup>a</sup> Confirmed by closed-loop eigenvalues &lt;both&gt; sides." in html
    assert "A note with <code>code</code>." in html


def test_methods_of_confirmation_stand_once_and_why_there_is_no_value():
    ways = [Confirmation(f"eigenvalues: stable at {x}", "eigenvalues on both sides") for x in (0.5, 1.5)]
    numbers = [Number(1.0, "1", 0.0, way) for way in ways]
    numbers += [Number(1.0, "1", 0.0, Confirmation(f"a run of {5} s", "a run"))]
    numbers += [Number(math.nan, "1", math.nan, "the loop is not sampled"), Number(2.0, "1", 0.0, "", given=True)]
    numbers += [Number(3.0, "1", 0.0, "")]
    html = to_html(Report("R", (Section("s", "S", tables=(Table("T", ("x",), tuple((n,) for n in numbers)),)),)))
    notes = re.search(r'<p class="note">(.*?)</p>', html)[1].split("<br>")
    assert [re.sub("<.*?>", "", note).rstrip() for note in notes] == [
        "a Confirmed by eigenvalues on both sides.",
        "b Confirmed by a run of 5 s.",
        "c No value: the loop is not sampled.",
        "d Given.",
        "e Not confirmed.",
    ]
    assert re.findall(r"<sup>(.)</sup>", html.partition("</table>")[0]) == ["a", "a", "b", "c", "d", "e"]


def test_confirmations_keep_their_methods_when_they_are_joined_and_pickled():
    one = Confirmation("eigenvalues at 0.5", "eigenvalues").and_by("a run of 3 s", "a run").and_by("gains 1 to 2", "")
    for each in (one, pickle.loads(pickle.dumps(one)), Confirmation(one)):
        assert each == "eigenvalues at 0.5; a run of 3 s; gains 1 to 2"
        assert each.method == "eigenvalues; a run"
    assert method_of("plain") == "plain"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("up to 1e8 N/m, below 1e-09, by -2.5e-3", "up to 1×10⁸ N/m, below 1×10⁻⁹, by −2.5×10⁻³"),
        ("found -1.88 (-3); SHA-256, 2026-11-22, x-1, 4e50b9", "found −1.88 (−3); SHA-256, 2026-11-22, x-1, 4e50b9"),
        ("`1e-3 -2` stays", "<code>1e-3 -2</code> stays"),
    ],
)
def test_numbers_in_texts_stand_as_in_print(text, shown):
    assert str(marked(text)) == shown


def test_digests_and_paths_may_break_and_are_whole():
    digest, file = "0123456789abcdef" * 4, "/home/someone/models/of/plants/gantry_with_contact.fmu"
    html = to_html(
        Report("R", (Section("s", "S", tables=(Table("T", ("x", "y"), ((digest, file), ("short-name", 1))),)),))
    )
    assert "abcdef<wbr>0123" in html
    assert [text_of(cell) for cell in parsed(html).iter("td")] == [file, "1"]
    assert digest in [text_of(cell) for cell in parsed(html).iter("th")]
    assert "short-name" in html


def test_a_unit_that_a_whole_column_shares_stands_in_its_heading():
    tree = parsed(to_html(report()))
    assert [text_of(th) for th in next(tree.iter("thead")).iter("th")] == [
        "loop",
        "phase margin [°]",
        "gain margin",
        "delay [s]",
        "Ms",
    ]


def test_a_head_that_names_its_unit_shows_it_as_all_others_do():
    numbers = (Number(2.0, "s", 0.0, "x"), Number(3.0, "s", 0.0, "x"))
    page = to_html(Report("R", (Section("s", "S", tables=(Table("T", ("", "t", "end [s]"), (("a", *numbers),)),)),)))
    assert re.findall(r"(\w+) <span class=\"unit\">(.*?)</span>", page) == [("t", "[s]"), ("end", "[s]")]


def test_contents_lists_and_numbering():
    tree = parsed(to_html(report()))
    nav = text_of(next(tree.iter("nav")))
    assert nav == "Contents 1 What was analysed 1.1 A part 2 Inner loops A All numbers B Definitions"
    assert [text_of(li) for ul in tree.iter("ul") for li in ul] == ["one", "two"]
    assert [text_of(c)[:8] for c in tree.iter("caption")] == ["Table 1.", "Table 2."]
    assert [text_of(c)[:9] for c in tree.iter("figcaption")] == ["Figure 1.", "Figure 2."]


def test_a_report_without_numbers_has_no_appendix():
    html = to_html(Report("Empty", (Section("a", "A"),)))
    parsed(html)
    assert "All numbers" not in html


def test_the_same_report_is_the_same_page():
    assert to_html(report()) == to_html(report())


@pytest.mark.slow
def test_only_long_tables_go_over_pages():
    html = to_html(report(rows=60))
    assert html.count('class="table long"') == to_html(report()).count('class="table long"') + 1
    assert "break-inside: avoid" in html


# --- drawings in it -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_large_diagram_is_shown_closed_and_box_by_box():
    tree = parsed(to_html(with_drawing(report(), experiments.compliance().diagram.wired)))
    captions = [text_of(c) for c in tree.iter("figcaption")]
    assert captions[0].startswith("Figure 1. The diagram with its subsystems closed.")
    assert [c for c in captions if "controller" in c and "inside" in c]
    assert not [f for f in tree.iter("div") if f.get("class") == "paper"]  # none is so wide that it is turned


def test_a_small_diagram_is_shown_as_it_is():
    made = with_drawing(report(), Diagram("small", Gain(gain=2.0)(Sine(frequency=1.0))).wired)
    assert [p.caption[:12] for p in made.sections[0].plots] == ["The diagram."]


# --- values ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "tolerance", "text"),
    [
        (71.249812345, 1e-9, "71.2498"),
        (71.249812345, 0.04, "71.25"),
        (71.249812345, 30.0, "71"),
        (1.2, 1e-12, "1.2"),
        (-1.25e-7, 1e-12, "−1.25×10⁻⁷"),
        (math.inf, 0.0, "∞"),
        (-math.inf, 0.0, "−∞"),
        (math.nan, math.nan, "–"),
        (0.0, 0.0, "0"),
        (123456.0, 0.0, "123456"),
    ],
)
def test_a_value_has_the_digits_that_its_tolerance_bears(value, tolerance, text):
    assert value_text(Number(value, "1", tolerance, "")) == text


def test_units_and_tolerances_in_print():
    assert [print_unit(u) for u in ("1", "deg", "N.s/m", "m/s2", "rad/s", "kg*m2")] == [
        "",
        "°",
        "N·s/m",
        "m/s²",
        "rad/s",
        "kg·m²",
    ]
    assert quantity(Number(2.0, "deg", 0.0, "")) == "2°"
    assert quantity(Number(2.0, "N/m", 0.0, "")) == "2\u202fN/m"
    assert tolerance_text(Number(2.0, "s", 2.4e-10, "")) == "±2×10⁻¹⁰"
    assert tolerance_text(Number(2.0, "s", 0.0, "")) == "±0"


def test_cells_of_any_kind():
    assert [cell(v) for v in (None, True, -3, 0.5, 1 - 2j, (1.0, 2.0), "x")] == [
        "–",
        "yes",
        "−3",
        "0.5",
        "1 − 2j",
        "1, 2",
        "x",
    ]
    assert is_numeric([1.0, None, "–", Number(1.0, "1", 0.0, "")])
    assert not is_numeric([1.0, "one"])
    assert not is_numeric([])
    assert plain(1e21) == "1×10²¹"


def test_definitions_are_found_from_the_end_of_a_path():
    assert definition("x.gain_margin.sampled_d0.be_10")[0] == "gain_margin"
    assert definition("x.ms", {"ms": "mine"}) == ("ms", "mine")
    assert definition("nothing.known") is None


# --- JSON -----------------------------------------------------------------------------------------------------------


def test_json_holds_every_number_by_its_path_with_four_entries():
    def refuse(constant):
        raise AssertionError(constant)

    made = json.loads(to_json(report()), parse_constant=refuse)
    leaf = made["inner"]["par"]["sampled_d0"]["phase_margin_deg"]
    assert leaf == {"value": 66.06123456789, "unit": "deg", "tolerance": 1e-9, "confirmed_by": BY_EIGENVALUES}
    assert float(made["inner"]["par"]["sampled_d0"]["gain_margin_high"]["value"]) == math.inf
    assert made["inner"]["par"]["sampled_d0"]["delay_margin_s"]["value"] is None
    assert made["meta"]["versions"] == {"NumPy": "2.1"}


def test_json_refuses_a_number_above_other_numbers():
    one = Number(1.0, "1", 0.0, "")
    for paths in (("a", "a.b"), ("a.b", "a")):
        with pytest.raises(DefinitionError, match="rename"):
            to_json(Report("", (Section("s", "S", numbers=dict.fromkeys(paths, one)),)))


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_page_pdf_and_json_stand_beside_each_other(tmp_path):
    files = write_report(report(), tmp_path / "r.html", pdf=True, json=True)
    assert [f.name for f in files] == ["r.html", "r.pdf", "r.json"]
    document = pypdfium2.PdfDocument(files[1])
    text = "".join(page.get_textpage().get_text_range() for page in document)
    assert "Report of a < b" in text
    assert "66.0612" in text
    width, height = document[0].get_size()
    assert (width, height) == pytest.approx((595.3, 841.9), abs=1)
    document.close()
    assert write_report(report(), None) == []


@pytest.mark.slow
def test_no_heading_and_no_head_of_a_table_stands_alone_at_the_end_of_a_page(tmp_path):
    for lines in range(20, 60, 3):
        text = ("Filling.",) * lines
        parts = (
            Section("a", "First", text),
            Section("b", "HEADING", ("Follows.",)),
            Section("c", "C", text[:-12], (Table("T", ("COLUMN",), tuple((f"row{i}",) for i in range(40))),)),
        )
        (file,) = write_report(Report("R", parts), tmp_path / "r.html", pdf=True)[1:]
        document = pypdfium2.PdfDocument(file)
        pages = [page.get_textpage().get_text_range() for page in document]
        document.close()
        for page in pages[1:]:
            assert "HEADING" not in page or "Follows." in page
        (first,) = [page for page in pages if "row0\r" in page or "row0\n" in page or page.endswith("row0")]
        assert "Table 1." in first


def test_without_the_library_a_pdf_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "plutoprint", None)
    with pytest.raises(OptionError, match=r'pip install "loopwright\[pdf\]"'):
        check_files("x.html", pdf=True, json=False)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("x.pdf", r"Name it x\.html, and ask for the PDF next to it"),
        ("x.txt", r"Name it x\.html\."),
        ("nowhere/x.html", "there is no folder 'nowhere'"),
    ],
)
def test_files_that_cannot_be_written_are_refused_beforehand(path, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OptionError, match=message):
        check_files(path, pdf=False, json=False)
    with pytest.raises(OptionError, match="give its path"):
        check_files(None, pdf=True, json=False)
    (tmp_path / "d.html").mkdir()
    with pytest.raises(OptionError, match="is a folder"):
        check_files("d.html", pdf=False, json=False)


def test_a_notebook_shows_the_page_in_a_frame():
    assert report()._repr_html_().startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')


@pytest.mark.slow
def test_every_figure_has_its_caption_for_people_who_do_not_see_it():
    tree = parsed(to_html(with_drawing(report(), experiments.compliance().diagram.wired)))
    drawn = [svg for svg in tree.iter() if str(svg.tag).endswith("svg") and svg.get("role") == "img"]
    captions = {text_of(caption).partition(". ")[2] for caption in tree.iter("figcaption")}
    assert len(drawn) >= 4
    titled = [svg for svg in drawn if svg.get("class") == "lw-drawing"]  # drawings of diagrams say what they show
    assert all(text_of(next(t for t in svg if str(t.tag).endswith("title"))).startswith("Block") for svg in titled)
    labelled = {svg.get("aria-label").replace("`", "") for svg in drawn if svg not in titled}
    assert labelled < captions
    assert len(labelled) + len(titled) == len(captions)


def test_details_stand_in_the_appendix_numbered_last_and_linked():
    found = report()
    subject, inner = found.sections
    tables = (replace(inner.tables[0], details=True), *inner.tables[1:])
    page = to_html(replace(found, sections=(subject, replace(inner, tables=tables))))
    tree = parsed(page)
    (details,) = [section for section in tree.iter("section") if section.get("id") == "details"]
    assert [text_of(caption) for caption in details.iter("caption")] == ["Table 2. Margins & more"]
    (link,) = [a for a in tree.iter("a") if text_of(a) == "Margins & more"]
    assert link.get("href") == "#x-inner"
    assert page.index('id="details"') > page.index('id="definitions"')


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (Number(-0.0, "1", 0.0, "x"), "0"),
        (Number(1e-17, "1", 0.0, "x"), "0"),
        (Number(2e-15, "1", 1e-9, "x"), "0"),
        (Number(-3e-12, "s", 1e-11, "x"), "0"),
        (Number(2e-7, "1", 6e-7, "x"), "2×10⁻⁷"),
        (Number(2e-12, "1", 1e-15, "x"), "2×10⁻¹²"),
    ],
)
def test_rounding_errors_are_written_as_zero(number, text):
    assert value_text(number) == text


def test_a_pdf_is_on_the_paper_that_is_asked_for(tmp_path):
    small = Report("R", (Section("a", "A", ("Text.",)),))
    write_report(small, tmp_path / "r.html", pdf=True, paper="letter")
    document = pypdfium2.PdfDocument(tmp_path / "r.pdf")
    assert document[0].get_size() == pytest.approx((612, 792), abs=1)
    document.close()
    with pytest.raises(OptionError, match="paper: found 'A5'; expected one of A4, letter"):
        write_report(small, tmp_path / "r.html", pdf=True, paper="A5")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("M_s at the peak", "M<sub>s</sub> at the peak"),
        ("k_e ≈ (d + b_e)/T_d.", "k<sub>e</sub> ≈ (d + b<sub>e</sub>)/T<sub>d</sub>."),
        ("the wire controller.k_e", "the wire controller.k_e"),
        ("k_e_limit and `M_s`", "k_e_limit and <code>M_s</code>"),
        ("M_s < 1", "M<sub>s</sub> &lt; 1"),
    ],
)
def test_symbols_have_their_index_below_the_line_and_names_stay(text, shown):
    assert str(marked(text)) == shown


UNIT_IN_PARENTHESES = re.compile(r"""["'][^"'\n]*\((?:s|1/s|rad/s|Hz|dB|°|deg|m|N|N/m|kg|%|1/s²)\)["']""")
UNIT_IN_WORDS = re.compile(r"""(?:label|set_[xy]label)\S*["'][^"'\n]* in (?:s|rad/s|Hz|dB|°|m|N)["']""")


def test_units_stand_behind_quantities_in_one_way_in_tables_figures_and_on_the_command_line():
    code = Path(__file__).parents[3] / "diagrams"
    for file in (*code.rglob("*.py"), *code.rglob("*.j2")):
        text = file.read_text(encoding="utf-8")
        for kind in (UNIT_IN_PARENTHESES, UNIT_IN_WORDS):
            assert not kind.search(text), (file, kind.search(text))
        assert "N s/m]" not in text, file
    assert with_unit("damping", "N.s/m") == "damping [N·s/m]"
