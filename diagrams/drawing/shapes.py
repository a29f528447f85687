"""The shapes of a drawing, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from html import escape

INK, GREY, WIRE, BORDER = "#1f2933", "#5b6875", "#33475b", "#8a9bab"
NAME, PLANT = "#0b5394", "#fff3dc"
"""Colours of the names of wires, and of stepped blocks, such as FMUs."""

_NARROW, _WIDE = set("iljtfrI.,:;'|!()[]- "), set("mwMW@%")


def width(text: str, size: float = 10.0, bold: bool = False) -> float:
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
    return f'<path d="{path}" fill="none" stroke="{WIRE}" stroke-width="1.1" stroke-linecap="square"/>\n'


def rect(x: float, y: float, w: float, h: float, fill: str, radius: float, line: float = 1.0) -> str:
    """Return a rectangle with rounded corners as SVG."""
    return (
        f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="{radius:g}" fill="{fill}" stroke="{INK}" '
        f'stroke-width="{line:g}"/>'
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
    return f'<text x="{x:g}" y="{y:g}" font-size="{size:g}"{extra}>{escape(text)}</text>'
