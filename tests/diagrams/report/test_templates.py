"""Templates of the report: what they show is escaped, what they ask for is given, and every text is used."""

import re
from pathlib import Path

import jinja2
import pytest
from matplotlib.figure import Figure

import loopwright.diagrams
from loopwright.diagrams import Plot, Section, Table
from loopwright.diagrams.report.pages.html import to_html
from loopwright.diagrams.report.pages.templating import Texts, environment
from loopwright.frequency import Number
from loopwright.types import Report

pytestmark = pytest.mark.usefixtures("without_drawings")

ROOM = Path(loopwright.diagrams.__file__).parent
EVIL = "<script>alert('x')</script> & \"y\""


def sources(package):
    return "".join(path.read_text(encoding="utf-8") for path in sorted((ROOM / package).glob("*.py")))


def macros():
    for file in sorted(ROOM.rglob("templates/*.txt.j2")):
        for name in re.findall(r"{% macro (\w+)\(", file.read_text(encoding="utf-8")):
            yield file.parents[1].relative_to(ROOM).as_posix(), file.name.removesuffix(".txt.j2"), name


def test_every_text_is_used():
    code = {package: sources(package) for package, _, _ in macros()}
    assert len(code) > 3
    assert not [
        (package, file, macro)
        for package, file, macro in macros()
        if f'Texts(__package__, "{file}")' not in code[package]
        or not re.search(rf'\.(line|paragraphs)\(\s*"{macro}"', code[package])
    ]


@pytest.mark.parametrize("package", ["paper", "report", "report/figures", "report/sections"])
def test_every_text_that_is_asked_for_is_there(package):
    known = {name for of, _, name in macros() if of == package}
    assert set(re.findall(r'TEXTS\.(?:line|paragraphs)\(\s*"(\w+)"', sources(package))) <= known


def test_everything_that_a_report_shows_is_escaped():
    number = Number(1.0, EVIL, 0.0, EVIL)
    section = Section(
        "s" + EVIL,
        EVIL,
        (EVIL, f"- {EVIL}"),
        (Table(EVIL, (EVIL, "x"), ((EVIL, number), (number, EVIL)), EVIL),),
        (Plot(EVIL, EVIL, Figure(figsize=(1, 1))),),
        {EVIL: number},
    )
    inner = Section("t", EVIL, sections=(section,))
    meta = {EVIL: EVIL, "definitions": {EVIL: EVIL}, "list": [EVIL], "mapping": {EVIL: EVIL}}
    page = to_html(Report(EVIL, (inner,), meta))
    assert "<script" not in page
    assert page.count("&lt;script&gt;") > 20


def test_a_template_that_asks_for_what_nobody_gave_is_an_error():
    with pytest.raises(jinja2.UndefinedError, match="'nothing' is undefined"):
        environment("loopwright.diagrams.report").from_string("{{ nothing }}").render()
    with pytest.raises(jinja2.UndefinedError, match="'wire'"):
        Texts("loopwright.diagrams.report.figures", "figures").line("bode")


def test_blank_lines_part_paragraphs_and_ends_of_lines_are_spaces(tmp_path, monkeypatch):
    text = Texts("loopwright.diagrams.report", "two")
    made = jinja2.Environment().from_string("{% macro two(x) %}\nOne <b>\nis {{ x }}.\n  \n\nTwo.\n{% endmacro %}")
    monkeypatch.setattr(Texts, "_template", lambda self: made)
    assert text.paragraphs("two", x="1\n\n<2") == ("One <b> is 1 <2.", "Two.")
    with pytest.raises(ValueError, match="too many values"):
        text.line("two", x=1)
