"""A diagram as a page that runs: one file, without a server and without a network."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import OptionError, accepts, brief, check_file, explain_calls, kinds, write_text
from ..drawing import Facts, draw
from ..flat import WiredDiagram
from ..results import Run
from ..wiring import Wire
from .module import make_module
from .notebook_link import Change, PageRecord, repeat, runs_in_kernel
from .page_html import DATA_BEGIN, PageText, Scene, choose_drawing, draw_still, fill_page
from .shown_signals import PlotNames, ShownColumns, plots_of
from .sliders import Slider, default_sources, find_sliders, place_of


@dataclass(frozen=True)
class Played:
    """Parts of a page that its record needs."""

    diagram: Any
    columns: ShownColumns
    sliders: Mapping[str, Slider]
    options: Mapping[str, Any]


@explain_calls
class WebPage:
    """A page on which a diagram runs; a notebook shows it, and what was played there comes back.

    Attributes
    ----------
    html : str
        The page: a whole file.
    size : int
        Its size in bytes.
    run : Run
        The samples since the page's last reset, in a notebook.
    changes : list of Change
        What was moved meanwhile, in a notebook.

    Methods
    -------
    save(path)
        Write it to a file.
    simulate()
        Return the same run in Python.
    """

    def __init__(self, html: str, name: str, height: int, picture: str, played: Played):
        self.html, self._name, self._height, self._picture, self._played = html, name, height, picture, played
        self._record = PageRecord(len(played.columns.found) + 1)

    @property
    def size(self) -> int:
        """Size of the page in bytes."""
        return len(self.html.encode())

    @property
    def run(self) -> Run:
        """The samples since the page's last reset, of the signals that the page has.

        They come while the page is played in a notebook of JupyterLab with the extra ``notebook``.

        Raises
        ------
        OptionError
            If nothing has come.
        """
        rows, signals = self._rows(), self._played.columns.signals
        columns = np.array([column.place for column in self._played.columns.found])
        return Run(
            t=rows[:, 0].copy(),
            data=rows[:, 1:],
            signals=replace(signals, columns=columns, has_states=False),
            diagram=self._played.diagram,
            tier="page",
            messages=(self._record.message,) if self._record.message else (),
        )

    @property
    def changes(self) -> list[Change]:
        """What was moved since the page's last reset: number of samples before, time, name and value.

        Raises
        ------
        OptionError
            If nothing has come.
        """
        self._rows()
        return self._record.changes

    def simulate(self) -> Run:
        """Return the same run in Python: as long, with the same moves after the same samples.

        Where the diagram has no elementary functions, its samples are those of `run` bit for bit.

        Raises
        ------
        OptionError
            If nothing has come; if a parameter of an FMU was moved while the page ran.
        """
        played, rows = self._played, self._rows()
        return repeat(played.diagram, played.sliders, self._record.changes, float(rows[-1, 0]), played.options)

    def _rows(self) -> np.ndarray:
        rows = self._record.rows
        if not len(rows):
            raise OptionError(f"found no sample of this page; {self._why_nothing()}", block=self._name, port="run")
        return rows

    def _why_nothing(self) -> str:
        if not runs_in_kernel():
            return (
                "they come back from a page that is shown in a notebook. Elsewhere save the record as CSV on the page."
            )
        if not self._record.listen():
            return (
                "expected the package anywidget, which brings them back. Install it: pip install "
                '"loopwright[notebook]", restart the kernel, and reload the window.'
            )
        return (
            "expected the page to be shown in this notebook. Show it (the page as last line of a cell), and press Run."
        )

    def __repr__(self) -> str:
        return brief(f"page of {self._name!r}", f"{self.size / 1e3:.0f} kB", then=".save('page.html'), .html, .run")

    def _repr_html_(self) -> str:
        html = self.html
        if self._record.listen():
            html = html.replace(DATA_BEGIN, f'{DATA_BEGIN}"key":"{self._record.key}",', 1)
        # sites and notebooks that forbid frames leave the text and the picture below it
        return (
            f'<div style="position:relative;height:{self._height}px;overflow:hidden">'
            f'<div aria-hidden="true"><p>The page of {escape(self._name)} is shown in a trusted notebook (JupyterLab: '
            f"Trust Notebook in the command palette), or when this cell has run.</p>{self._picture}</div>"
            '<iframe sandbox="allow-scripts allow-downloads" title="the page" '
            'style="position:absolute;top:0;left:0;width:100%;height:100%;border:0" '
            f'srcdoc="{escape(html, quote=True)}"></iframe></div>'
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
    headings: Mapping[str, str] | None = None,
    scene: Scene | None = None,
) -> WebPage:
    """Return a diagram as a page that runs; see `Diagram.to_html`.

    ``facts``: shapes and units of its signals, for the drawing.
    ``labels``: what the page calls sliders and signals, by their names.
    ``headings``: headings above sliders of parameters, by their names; those of one heading follow each other.
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
    groups = [("Inputs" if tuned else "", moved), *_under_headings(tuned, headings or {})]
    every = [*moved, *tuned]
    # The module is compiled with room for just these values; sliders of plants reach theirs through the plant.
    targets = [slider.target for slider in every if not slider.of_plant]
    targets += [target for target, _ in scene.moved.values()] if scene else []
    wires = [(Wire(column.block, column.port, None), column.entry) for column in columns.found]
    module = make_module(wired, flat, wires, targets, solver=solver)
    spec = module.spec
    pulled = {} if scene is None else {n: Slider.of_scene(wired, n, t, i) for n, (t, i) in scene.moved.items()}
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
            {"title": head, "sliders": [_slider(one, place_of(one, spec), labels or {}) for one in group]}
            for head, group in groups
            if group
        ],
        "hidden": {name: place_of(one, spec) for name, one in pulled.items()},
        "labels": [list(label) for label in spec.labels],
        "plants": [plant.placed.path for plant in spec.plants],
        "guards": [list(guard) for guards in spec.guards for guard in guards.names],
        "events": [[block, name] for block, name, _ in spec.events],
        "scene": None if scene is None else dict(scene.data),
    }
    if path is not None:
        _check_page(path)
    drawing = draw(wired.structure, wired.name, facts)
    html = fill_page(text, data, module.compile(), choose_drawing(drawing), scene, speed=speed, span=span)
    height = 130 + max(180 * len(shown) + (460 if scene else 0), 90 + 57 * len(every))
    played = Played(wired.facade, columns, {one.name: one for one in every} | pulled, {"step": step, "solver": solver})
    page = WebPage(html, wired.name, min(height, 900), draw_still(drawing), played)
    if path is not None:
        page.save(path)
    return page


def _under_headings(sliders: Sequence[Slider], headings: Mapping[str, str]) -> list[tuple[str, list[Slider]]]:
    """Return headings with their sliders, in order."""
    grouped = groupby(sliders, key=lambda one: headings.get(one.name, "Parameters"))
    return [(heading, list(each)) for heading, each in grouped]


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
