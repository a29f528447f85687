"""Contrast by WCAG 2.2: 4.5 for texts (1.4.3, level AA), 3 for curves and marks (1.4.11); on screen, light and dark."""

import re
from pathlib import Path

import pytest

from loopwright.diagrams.drawing import diagram_picture, shapes
from loopwright.diagrams.plotting import COLORS, DARK, STONE
from loopwright.diagrams.plotting.style import STYLE
from loopwright.diagrams.report import pages
from loopwright.diagrams.report.variant import LOOKS, OTHER, look_of

CSS = (Path(pages.__file__).parent / "templates" / "style.css").read_text(encoding="utf-8")
TEXT, GRAPHIC = 4.5, 3.0
TEXTS = ("ink", "soft", "link", "passed", "failed", "undecided")


def luminance(color):
    """Relative luminance, as the definition has it."""
    parts = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def whole(color):
    return "#" + "".join(2 * c for c in color[1:]) if len(color) == 4 else color


def scheme(css):
    """Return the colors of texts and those of grounds of a part of the style sheet."""
    named = dict(re.findall(r"--(\w+): (#\w+)", css))
    grounds = re.findall(r"(?:html|tr:target, li:target) \{ background: (#\w+)", css)
    return named, [named["band"], *map(whole, grounds)]


LIGHT, DARK_SCREEN = CSS.split("prefers-color-scheme: dark", 1)


def test_the_measure_is_that_of_the_definition():
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=5e-3)  # the known grey that just fails


@pytest.mark.parametrize("css", [LIGHT, DARK_SCREEN], ids=["light", "dark"])
def test_texts_of_a_page_can_be_read_on_all_its_grounds(css):
    named, grounds = scheme(css)
    assert len(grounds) == 3
    poor = {(name, on): contrast(named[name], on) for name in TEXTS for on in grounds}
    assert not {pair: ratio for pair, ratio in poor.items() if ratio < TEXT}


def test_every_color_of_a_page_is_one_of_the_named_ones():
    written = re.findall(r"(?<![\w-])color: ([^;}]+)", CSS)
    assert set(written) <= {*(f"var(--{name})" for name in TEXTS), "inherit", "#5b6875"}


def test_texts_of_figures_and_drawings_can_be_read():
    grounds = ("#ffffff", shapes.PLANT, "#f5f6f7", *diagram_picture.TINTS)
    for color in (shapes.INK, shapes.NAME, shapes.GREY):
        assert all(contrast(color, on) >= TEXT for on in grounds), color
    for color in (DARK, STONE, STYLE["xtick.color"], STYLE["ytick.color"]):
        assert contrast(color, "#ffffff") >= TEXT


def test_curves_stand_out_from_their_ground_and_have_lines_of_their_own():
    looks = [*LOOKS.values(), *OTHER]
    colors = {look_of("", 0)["color"], *COLORS, *(color for color, _ in looks)}
    assert all(contrast(color, "#ffffff") >= GRAPHIC for color in colors)
    assert len(set(map(str, looks))) == len(looks)  # told apart without color, too


def test_figures_are_drawn_light_on_dark_in_the_colors_of_the_page():
    """Turned round in lightness, the grounds of figures are those of the page, and their texts can be read."""
    ground = re.search(r'\[style\*="fill: #ffffff"\] \{ fill: (#\w{6})', DARK_SCREEN)[1]
    assert "filter: invert(1) hue-rotate(180deg)" in DARK_SCREEN

    def turned(color):
        """hue-rotate(180deg) of Filter Effects, on the inverted color."""
        r, g, b = (255 - int(color[i : i + 2], 16) for i in (1, 3, 5))
        rows = ((-0.574, 1.430, 0.144), (0.426, 0.430, 0.144), (0.426, 1.430, -0.856))
        return "#" + "".join(f"{round(min(max(x * r + y * g + z * b, 0), 255)):02x}" for x, y, z in rows)

    (page,) = re.findall(r"html \{ background: (#\w+)", DARK_SCREEN)
    pairs = zip(*([int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in (turned(ground), page)), strict=True)
    assert max(abs(a - b) for a, b in pairs) <= 8
    assert all(contrast(turned(color), page) >= TEXT for color in (DARK, STONE, STYLE["xtick.color"]))
    assert all(contrast(turned(color), page) >= GRAPHIC for color in COLORS)
