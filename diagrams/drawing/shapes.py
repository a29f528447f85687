"""The shapes of a drawing, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from html import escape

INK, GREY, WIRE, BORDER = "#1f2933", "#5b6875", "#33475b", "#8a9bab"
NAME, PLANT = "#0b5394", "#fff3dc"
"""Colours of the names of wires, and of stepped blocks, such as FMUs."""

DARK = {
    "svg.lw-drawing": "fill:#e4e9ee;background:#14191f",
    ".lw-block": "fill:#1f2830;stroke:#aab7c4",
    ".lw-plant": "fill:#3a3119;stroke:#d8c48a",
    ".lw-line": "stroke:#aab7c4",
    ".lw-curve": "stroke:#e4e9ee",
    ".lw-axes": "stroke:#7d8b99",
    ".lw-wire": "stroke:#9fb3c8",
    ".lw-mark": "fill:#9fb3c8",
    ".lw-grey": "fill:#a3b0bd",
    ".lw-name": "fill:#7fb8f0",
    ".lw-plain": "fill:#1a2027;stroke:#5f6d7a",
    **{f".lw-rate{i}": f"fill:{c};stroke:#5f6d7a" for i, c in enumerate(("#16263a", "#15301f", "#271d38"))},
    **{f".lw-rate{i}": f"fill:{c};stroke:#5f6d7a" for i, c in enumerate(("#3a1c20", "#153038", "#332c14"), 3)},
}
"""Colours in the dark, by classes of shapes."""


def style() -> str:
    """Return the style of a drawing: dark where the system or the page around it is, as notebooks and sites say it."""
    light = ':not([data-theme="light"] *):not([data-jp-theme-light="true"] *)'
    media = "".join(f"{shape}{light}{{{colours}}}" for shape, colours in DARK.items())
    page = "".join(
        f'[data-theme="dark"] {shape},[data-jp-theme-light="false"] {shape}{{{colours}}}'
        for shape, colours in DARK.items()
    )
    return f"<style>@media screen and (prefers-color-scheme:dark){{{media}}}@media screen{{{page}}}</style>\n"


_NARROW, _WIDE = set("iljtfrI.,:;'|!()[]- "), set("mwMW@%")


def width_of(text: str, size: float = 10.0, bold: bool = False) -> float:
    """Estimate the width of a text, rather a little more than less."""
    units = sum(0.32 if c in _NARROW else 0.88 if c in _WIDE else 0.68 if c.isupper() else 0.6 for c in text)
    return units * size * (1.15 if bold else 1.0)


def seconds(time: Fraction) -> str:
    """Write a time with its unit."""
    value = float(time)
    unit, factor = next(((u, f) for u, f in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)) if value * f >= 1), ("ns", 1e9))
    return f"{value * factor:.6g} {unit}"


def line(*runs: Sequence[tuple[float, float]]) -> str:
    """Return a path through points, run by run, as SVG."""
    path = "".join(f"M{x:g} {y:g}" + "".join(f"L{a:g} {b:g}" for a, b in rest) for (x, y), *rest in runs)
    return (
        f'<path class="lw-wire" d="{path}" fill="none" stroke="{WIRE}" stroke-width="1.1" stroke-linecap="square"/>\n'
    )


def rect(x: float, y: float, w: float, h: float, fill: str, radius: float, line: float = 1.0) -> str:
    """Return a rectangle with rounded corners as SVG."""
    kind = {"#ffffff": "lw-block", PLANT: "lw-plant"}.get(fill, "lw-line")
    return (
        f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="{radius:g}" fill="{fill}" '
        f'stroke="{INK}" stroke-width="{line:g}"/>'
    )


def text_at(
    x: float,
    y: float,
    text: str,
    size: float,
    *,
    anchor: str = "",
    bold: bool = False,
    italic: bool = False,
    fill: str = "",
) -> str:
    """Return a line of text at a point as SVG."""
    extra = f' text-anchor="{anchor}"' if anchor else ""
    extra += ' font-weight="bold"' if bold else ""
    extra += ' font-style="italic"' if italic else ""
    extra += f' fill="{fill}"' if fill else ""
    extra += {GREY: ' class="lw-grey"', NAME: ' class="lw-name"'}.get(fill, "")
    return f'<text x="{x:g}" y="{y:g}" font-size="{size:g}"{extra}>{escape(text)}</text>'
