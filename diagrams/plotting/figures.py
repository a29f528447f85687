"""Figures: those of a person, which are pyplot's like any other library's, and those of pages, which are nobody's else.

`shown_figure` is for what a person calls, such as ``run.plot()``: pyplot has the figure, so that ``plt.show()`` opens
it, a notebook shows it wherever in a cell it was made, and ``plt.close()`` ends it. `new_figure` is for reports, the
command line and other threads: pyplot is not imported, and a figure goes with its last reference.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...blocks.core import replace_file
from .style import STYLE, WIDTH, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INLINE = ("inline", "module://matplotlib_inline.backend_inline")
"""Names of the backend that shows the pyplot figures of a cell as pictures at its end, and closes them."""


@cache
def _figure_class() -> type[Figure]:
    """Return a class of figures that a notebook shows once, whether pyplot has them or not."""
    from io import BytesIO

    from matplotlib.figure import Figure

    class Picture(Figure):
        cell: int | None = None
        """Number of the notebook's cell that made it, where a live backend shows it at the cell's end."""

        def _repr_png_(self) -> bytes:
            buffer = BytesIO()
            with style():
                self.savefig(buffer, format="png", dpi=110)
            return buffer.getvalue()

        def _ipython_display_(self) -> None:
            _display(self)

        def show(self, warn: bool = True) -> None:
            """Show the figure: in a window, or in the notebook."""
            if _shell() is not None and (_is_inline() or not _is_in_pyplot(self)):
                _display(self)
            else:
                super().show(warn)

        def __reduce__(self) -> tuple[Any, ...]:
            return _bare_figure, (), self.__getstate__()

    return Picture


def _bare_figure() -> Figure:
    """Return a figure that a copy, or a figure from another process, is put into."""
    kind = _figure_class()
    return kind.__new__(kind)


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Return an empty figure that pyplot doesn't have, of the usual width, or another one; both are in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _figure_class()(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def shown_figure(height: float, width: float = WIDTH, *, is_shown: bool = True) -> Iterator[Figure]:
    """Draw a figure in our style within the block: one of pyplot's, if it is shown to a person.

    Parameters
    ----------
    height, width : float
        Size in inches.
    is_shown : bool
        Whether a person has asked for it. Other threads than the main one have figures without pyplot all the same, as
        windows belong to the main thread.
    """
    is_pyplot = is_shown and threading.current_thread() is threading.main_thread()
    if not is_pyplot:
        with style():
            yield new_figure(height, width)
        return
    from matplotlib import pyplot

    # made outside of the style: what a backend sets when it is loaded is to last
    size, white = (width, height), STYLE["figure.facecolor"]
    figure = pyplot.figure(figsize=size, layout="constrained", facecolor=white, FigureClass=_figure_class())
    figure.cell = getattr(_shell(), "execution_count", None)  # type: ignore[attr-defined]
    manager: Any = figure.canvas.manager
    if hasattr(figure.canvas, "_repr_mimebundle_") and not hasattr(manager, "reshow"):
        manager.reshow = figure._ipython_display_  # type: ignore[attr-defined]  # IPython asks a live view for it
    with style():
        try:
            yield figure
            for ax in figure.axes:
                keep_style(ax)
        except BaseException:
            pyplot.close(figure)
            raise


def keep_style(ax: Axes) -> None:
    """Give ticks that come later, as those of a zoom, the style of now: they would take that of their time."""
    from matplotlib import rcParams

    settings: Any = rcParams
    grid = {f"grid_{name}": settings[f"grid.{name}"] for name in ("color", "linewidth", "alpha")}
    ax.tick_params("x", labelsize=settings["xtick.labelsize"], color=settings["xtick.color"], **grid)
    ax.tick_params("y", labelsize=settings["ytick.labelsize"], color=settings["ytick.color"], **grid)


def save(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Write a figure as PNG (150 dpi) and SVG, the same bytes for the same figure, and return the files."""
    files = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    with style(), replace_file(files[0]) as png, replace_file(files[1]) as svg:
        figure.savefig(png, dpi=150, metadata={"Software": None})
        figure.savefig(svg, metadata={"Date": None, "Creator": None})
    return files


# --- in notebooks ----------------------------------------------------------------------------------------------------


def _shell() -> Any:
    """Return IPython's shell, None outside of notebooks and IPython."""
    ipython = sys.modules.get("IPython")
    return None if ipython is None else ipython.get_ipython()


def _is_inline() -> bool:
    """Whether pyplot's figures are shown as pictures at the end of a cell."""
    import matplotlib

    return "matplotlib.pyplot" in sys.modules and matplotlib.get_backend().lower() in INLINE


def _is_in_pyplot(figure: Figure) -> bool:
    """Whether pyplot has a figure."""
    pyplot, manager = sys.modules.get("matplotlib.pyplot"), figure.canvas.manager
    return pyplot is not None and manager is not None and manager.num in pyplot.get_fignums()


def _display(figure: Any) -> None:
    """Show a figure in a notebook's cell: once, and behind those that were made before it."""
    if not _is_in_pyplot(figure):
        _publish(figure)
        return
    from matplotlib import pyplot

    if _is_inline():
        number = figure.canvas.manager.num
        earlier = [pyplot.figure(n) for n in pyplot.get_fignums() if n < number]
        for one in (*(e for e in earlier if isinstance(e, _figure_class())), figure):
            _publish(one)
            if _closes_figures():  # else the end of the cell would show it a second time
                pyplot.close(one)
    elif hasattr(figure.canvas, "_repr_mimebundle_"):  # a live view, which the end of its cell shows
        if figure.cell != _shell().execution_count:
            from IPython.display import display

            display(figure.canvas)
    else:
        _publish(figure)


def _closes_figures() -> bool:
    """Whether figures are closed at the end of a cell, IPython's setting."""
    from matplotlib_inline.config import InlineBackend

    return bool(InlineBackend.instance().close_figures)


def _publish(figure: Any) -> None:
    """Send a figure's picture to the notebook, in the format that is set there."""
    from IPython.display import publish_display_data

    hidden = ["_ipython_display_", *["_repr_png_"] * _is_inline()]  # the formats that are set there, and no other PNG
    figure.__dict__.update(dict.fromkeys(hidden))
    try:
        data, metadata = _shell().display_formatter.format(figure)
    finally:
        for name in hidden:
            del figure.__dict__[name]
    publish_display_data(data, metadata)
