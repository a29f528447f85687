"""Objects as tables: one declaration, as text and as HTML; hostile texts; objects that lack parts."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from loopwright.blocks import PID, Gain
from loopwright.blocks.core import MOST_ROWS, Grid, Sheet, ShownAsTable, brief, cell_text, decibels, enumerate_some

HOSTILE = '<script>alert(1)</script>"&\x1b[31m\u202e\n'


class Cells(HTMLParser):
    """The texts of tables' cells, all tags, and all text but the style's."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.tags, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data):
        if self.tags[-1] != "style":
            self.text += data
        if self.tags[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def test_text_and_html_have_the_same_cells():
    sheet = Sheet(
        "a drive", (("time", "1 s"), ("none", "")), (Grid("Wires", ("wire", "end"), (("u", 0.5), ("speed", -12.25))),)
    )
    assert sheet.as_text().splitlines() == [
        "a drive",
        "  time  1 s",
        "",
        "Wires",
        "wire      end",
        "u         0.5",
        "speed  -12.25",
    ]
    cells = Cells(sheet.as_html())
    assert cells.rows == [["time", "1 s"], ["wire", "end"], ["u", "0.5"], ["speed", "-12.25"]]
    assert 'class="shown-number">-12.25</td>' in sheet.as_html()


def test_texts_of_others_are_escaped_and_control_neither_terminal_nor_writing():
    sheet = Sheet(HOSTILE, ((HOSTILE, HOSTILE),), (Grid(HOSTILE, (HOSTILE,), ((HOSTILE,),), HOSTILE),), (HOSTILE,))
    cells = Cells(sheet.as_html())
    assert "script" not in cells.tags
    assert cells.text.count("<script>alert(1)</script>") == 8
    for shown in (sheet.as_text(), sheet.as_html()):
        assert not {"\x1b", "\u202e"} & set(shown)
    assert len(sheet.as_text().splitlines()) == 9  # no line break of theirs


def test_what_is_long_is_cut_and_counted():
    grid = Grid("", ("k",), tuple((k,) for k in range(MOST_ROWS + 5)))
    lines = Sheet("x", (), (grid,)).as_text().splitlines()
    assert lines[-1] == "and 5 more"
    assert lines[-2] == str(MOST_ROWS - 1)
    assert len(cell_text("a" * 10_000)) == 100
    assert cell_text(np.zeros((1000, 1000))) == "array of shape (1000, 1000)"


def test_colors_are_those_of_the_page():
    style = re.search("<style>(.*)</style>", Sheet("x").as_html(), re.DOTALL)[1]
    assert set(re.findall(r"[^-]color: (\w+)", style)) == {"inherit"}
    assert "background" not in style
    assert "overflow-x: auto" in style  # a wide table is scrolled, not cut off


class Broken(ShownAsTable):
    def __repr__(self):
        return f"<broken {self.missing}>"

    def _sheet(self):
        return Sheet(str(self.missing))


def test_an_object_that_lacks_parts_says_so_and_never_raises():
    broken = Broken()
    assert repr(broken) == str(broken) == "<Broken that can't be shown: AttributeError>"
    assert broken._repr_html_() is None


def test_a_block_shows_its_parameters_and_ports():
    text = str(PID(kp=1.5, ki=2.0, name="pid"))
    assert text.startswith("PID 'pid'\n")
    assert re.search(r"^kp +1\.5 +proportional gain$", text, re.MULTILINE)
    assert re.search(r"^r +set-point$", text, re.MULTILINE)
    assert "proportional gain" in Cells(PID(kp=1.5, ki=2.0)._repr_html_()).text
    assert repr(Gain(gain=2.0, name="g")) == "Gain(gain=2, name='g')"
    assert cell_text(Gain(gain=2.0, name="g")) == "Gain(gain=2, name='g')"  # of a parameter that is a block itself


@pytest.mark.parametrize("kind", [PID, Gain])
def test_a_block_that_is_half_built_is_shown(kind):
    half = kind.__new__(kind)
    assert repr(half).startswith(f"<{kind.__name__} that can't be shown")
    assert str(half)
    assert half._repr_html_() is None


def test_short_texts_of_values():
    values = 1 / 3, -0.0, True, None, (1.0, "a"), "a\n\u202eb"
    assert [*map(cell_text, values)] == ["0.333333", "0", "yes", "", "1, a", "a\\n\\u202eb"]
    assert [*map(decibels, (2.0, 0.0, float("inf")))] == ["6.02 dB", "", ""]
    assert enumerate_some(["x", "y", "z"], most=2) == "x, y and 1 more"
    assert brief("run of 'd'", "11 samples", "", then="run['y']") == "<run of 'd': 11 samples; run['y']>"
