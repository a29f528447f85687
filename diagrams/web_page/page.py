"""A diagram as a page that runs: one file, without a server and without a network."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from ...blocks.core import OptionError, accepts, brief, check_file, explain_calls, kinds, write_text
from ..drawing import Facts, draw
from ..flat import Target, WiredDiagram
from ..wiring import Wire
from .module import Tuned, make_module
from .shown_signals import PlotNames, ShownColumns, plots_of
from .sliders import Slider, default_sources, find_sliders, place_of

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
SPANS = (2.0, 5.0, 10.0, 30.0, 60.0)
_SCRIPTS = ("shared", "model", "record", "plots", "sliders", "page")
_LARGEST_DRAWING = 400_000
_HINT = (
    "Double-click a name to set it back. Keys: space runs and pauses, → is one step, r resets. Point at a plot to read "
    "its numbers."
)


@dataclass(frozen=True)
class Scene:
    """A picture of what runs, which a script draws, and parameters that it moves.

    Attributes
    ----------
    script : str
        A script that defines ``window.makeScene(page, box)``, which returns an object with ``draw()``.
    data : mapping
        What it needs; it is ``page.data.scene``.
    moved : mapping of str to (Target, int)
        Numbers that it moves by ``page.set``, by its names for them: the parameter, and the entry in it.
    signals : tuple of str
        Signals that it reads by ``page.now``.
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


@explain_calls
class WebPage:
    """A page on which a diagram runs; a notebook shows it.

    Attributes
    ----------
    html : str
        The page: a whole file.
    size : int
        Its size in bytes.

    Methods
    -------
    save(path)
        Write it to a file.
    """

    def __init__(self, html: str, name: str, height: int):
        self.html, self._name, self._height = html, name, height

    @property
    def size(self) -> int:
        """Size of the page in bytes."""
        return len(self.html.encode())

    def __repr__(self) -> str:
        return brief(f"page of {self._name!r}", f"{self.size / 1e3:.0f} kB", then=".save('page.html'), .html")

    def _repr_html_(self) -> str:
        return (
            f'<iframe sandbox="allow-scripts allow-downloads" style="width:100%;height:{self._height}px;border:0" '
            f'srcdoc="{escape(self.html, quote=True)}"></iframe>'
        )

    @accepts(path=kinds.path)
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, and return the file.

        Parameters
        ----------
        path : path
            File, ``.html``.

        Raises
        ------
        OptionError
            If the file has another ending, or its folder isn't there.
        """
        file = _check_page(path)
        write_text(file, self.html)
        return file


def _check_page(path: str | os.PathLike[str]) -> Path:
    file = Path(path)
    if file.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"found {str(path)!r}; expected a page; name it {file.stem}.html.", port="path")
    return check_file(file)


@accepts(path=kinds.path.or_none(), speed=kinds.positive, span=kinds.positive, title=kinds.text.or_none())
def make_page(
    wired: WiredDiagram,
    facts: Facts,
    path: str | os.PathLike[str] | None = None,
    *,
    inputs: Any = None,
    sliders: Any = None,
    plots: PlotNames | None = None,
    step: float | None = None,
    solver: str = "auto",
    speed: float = 1.0,
    span: float = 10.0,
    title: str | None = None,
    text: PageText | None = None,
    labels: Mapping[str, str] | None = None,
    scene: Scene | None = None,
) -> WebPage:
    """Return a diagram as a page that runs; see `Diagram.to_html`.

    Parameters
    ----------
    facts : Facts
        Shapes and units of its signals, for the drawing.
    text : PageText, optional
        Its words; ``title`` is one of them.
    labels : mapping of str to str, optional
        What the page calls sliders and signals, by their names.
    scene : Scene, optional
        A picture above the plots.
    """
    text = text or PageText(title or wired.name)
    moved = find_sliders(wired, inputs, "inputs") if inputs is not None else default_sources(wired)
    tuned = find_sliders(wired, sliders, "sliders") if sliders is not None else []
    flat = wired.flatten(step)
    columns = ShownColumns(flat, wired.name)
    shown = plots_of(columns, plots)
    for name in scene.signals if scene else ():
        columns.add(name)
    columns.add_wires()
    groups = [("Inputs" if tuned else "", moved), ("Parameters", tuned)]
    every = [slider for _, group in groups for slider in group]
    targets = [slider.target for slider in every if slider.reference is None]
    tuned_plants = [_tuned(one) for one in every if one.reference is not None]
    targets += [target for target, _ in scene.moved.values()] if scene else []
    wires = [(Wire(column.block, column.port, None), column.entry) for column in columns.found]
    module = make_module(wired, flat, wires, targets, tuned_plants, solver=solver)
    spec = module.spec

    def place(one: Slider) -> int:  # those of FMUs from -1 downwards
        return place_of(one, spec) if one.reference is None else -1 - tuned_plants.index(_tuned(one))

    hidden = {} if scene is None else {n: place_of(Slider.of_scene(n, t, i), spec) for n, (t, i) in scene.moved.items()}
    data = {
        "name": wired.name,
        "step": float(spec.base),
        "speed": speed,
        "span": span,
        "columns": [
            {"name": column.name, "unit": column.unit, "label": (labels or {}).get(column.name, column.name)}
            for column in columns.found
        ],
        "plots": shown,
        "groups": [
            {"title": head, "sliders": [_slider(one, place(one), labels or {}) for one in group]}
            for head, group in groups
            if group
        ],
        "hidden": hidden,
        "labels": [list(label) for label in spec.labels],
        "plants": list(module.plants),
        "guards": [list(guard) for guards in spec.guards for guard in guards.names],
        "events": [[block, name] for block, name, _ in spec.events],
        "scene": None if scene is None else dict(scene.data),
    }
    if path is not None:
        _check_page(path)
    html = _fill(text, data, module.compile(), _draw(wired, facts), scene, speed=speed, span=span)
    height = 240 + 180 * len(shown) + (460 if scene else 0)
    page = WebPage(html, wired.name, min(height, 900))
    if path is not None:
        page.save(path)
    return page


def _tuned(one: Slider) -> Tuned:
    assert one.reference is not None
    return one.path, one.reference, one.entry


def _slider(one: Slider, place: int, labels: Mapping[str, str]) -> dict[str, Any]:
    return {
        "name": one.name,
        "label": labels.get(one.name, one.label),
        "unit": one.unit,
        "low": one.low,
        "high": one.high,
        "value": one.value,
        "log": one.is_logarithmic,
        "place": place,
    }


def _draw(wired: WiredDiagram, facts: Facts) -> str:
    """Return the drawing: the one that answers, or where that is large the picture alone."""
    drawing = draw(wired.structure, wired.name, facts)
    return drawing.html if len(drawing.html) < _LARGEST_DRAWING else drawing.svg


def _fill(
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
