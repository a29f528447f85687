"""HTML of a page that runs: its words, its picture, its data, its module and its scripts in one file."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from ..drawing import Drawing
from ..flat import Target

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
SPANS = (2.0, 5.0, 10.0, 30.0, 60.0)
_SCRIPTS = ("shared", "model", "record", "plots", "sliders", "page")
_LARGEST_DRAWING, _LARGEST_PICTURE = 400_000, 60_000
DATA_BEGIN = '<script type="application/json" id="lw-data">{'
"""What the page's data begins with; in a notebook a key of it comes first."""
_HINT = (
    "Double-click a name to set it back. Keys: space runs and pauses, → is one step, r resets. Point at a plot to read "
    "its numbers."
)


@dataclass(frozen=True)
class Scene:
    """A picture of what runs, which a script draws, and parameters that it moves.

    ``script``: a script that defines ``window.makeScene(page, box)``, which returns an object with ``draw()``.
    ``moved``: numbers that it moves by ``page.set``, by its names for them: the parameter, and the entry in it.
    """

    script: str
    data: Mapping[str, Any] = field(default_factory=dict)
    moved: Mapping[str, tuple[Target, int]] = field(default_factory=dict)
    signals: tuple[str, ...] = ()


@dataclass(frozen=True)
class PageText:
    """The words of a page: its title, what it is about, and a hint below the sliders."""

    title: str
    about: str = ""
    hint: str = _HINT


def choose_drawing(drawing: Drawing) -> str:
    """Return the drawing that answers, or where that is large the picture alone."""
    return drawing.html if len(drawing.html) < _LARGEST_DRAWING else drawing.svg


def draw_still(drawing: Drawing) -> str:
    """Return the drawing as a picture without a script; nothing where it is large."""
    svg = drawing.svg.encode()
    return (
        ""
        if len(svg) > _LARGEST_PICTURE
        else f'<img alt="" src="data:image/svg+xml;base64,{base64.b64encode(svg).decode()}">'
    )


def fill_page(
    text: PageText,
    data: Mapping[str, Any],
    module: bytes,
    drawing: str,
    scene: Scene | None,
    *,
    speed: float,
    span: float,
) -> str:
    """Return the page's HTML."""
    own = ["" if scene is None else scene.script, "\n".join(_file(f"{name}.js") for name in _SCRIPTS)]
    scripts = "".join(f"<script>{script}</script>\n" for script in own if script)
    hashes = [_hash(script) for script in re.findall(r"<script>(.*?)</script>", drawing + scripts, re.DOTALL)]
    policy = (
        f"default-src 'none'; script-src {' '.join(hashes)} 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    return Template(_file("page.html")).substitute(
        policy=policy,
        title=escape(text.title),
        about=f'<p class="about">{escape(text.about)}</p>' if text.about else "",
        hint=escape(text.hint),
        style=_file("page.css"),
        speeds=_options(SPEEDS, speed, "{:g} ×"),
        spans=_options(SPANS, span, "{:g} s"),
        no_scene=" hidden" if scene is None else "",
        drawing=drawing,
        module=base64.b64encode(module).decode(),
        data=json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        scripts=scripts,
    )


def _hash(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _options(values: tuple[float, ...], chosen: float, form: str) -> str:
    return "".join(f'<option value="{v:g}">{form.format(v)}</option>' for v in sorted({*values, chosen}))


def _file(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text(encoding="utf-8")
