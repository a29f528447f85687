"""Layout of a figure with axes in a grid: the room that ticks, labels and legends take, measured once as a rule.

Matplotlib's constrained layout measures everything twice, which takes most of a figure's time.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAD = 0.05
"""Distance from the figure's edge, and half of that between axes, in inches."""
GUESS = 0.5
"""Room for ticks and labels in inches with which they are measured first: ticks depend on the size of axes."""


def lay_out(figure: Figure) -> bool:
    """Place the axes of a figure; return whether it could: they are in one grid, each in one place of it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    cells = _cells(figure)
    if not cells:
        return False
    rows, columns = shape = 1 + max(row for row, _ in cells.values()), 1 + max(column for _, column in cells.values())
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    legends = [legend.get_tightbbox(renderer) for legend in figure.legends]
    above = max((box.height / figure.dpi for box in legends if box is not None), default=0.0)
    above += PAD if above else 0.0
    _place(figure, shape, (GUESS, GUESS, PAD, above + 0.5 * GUESS), (GUESS, GUESS))
    for _ in range(2):  # again where the axes that come of it have other ticks, of longer numbers
        ticks = _ticks_of(cells)
        left, right, bottom, top = ([0.0] * n for n in (columns, columns, rows, rows))
        for ax, (row, column) in cells.items():
            ax.apply_aspect()
            own, whole = ax.get_window_extent(renderer), ax.get_tightbbox(renderer, for_layout_only=True)
            if whole is None:
                continue
            left[column] = max(left[column], (own.x0 - whole.x0) / figure.dpi)
            right[column] = max(right[column], (whole.x1 - own.x1) / figure.dpi)
            bottom[row] = max(bottom[row], (own.y0 - whole.y0) / figure.dpi)
            top[row] = max(top[row], (whole.y1 - own.y1) / figure.dpi)
        between = max((right[i] + left[i + 1] for i in range(columns - 1)), default=0.0)
        below = max((bottom[i] + top[i + 1] for i in range(rows - 1)), default=0.0)
        edges = (left[0] + PAD, bottom[-1] + PAD, right[-1] + PAD, top[0] + above + PAD)
        _place(figure, shape, edges, (between + PAD, below + PAD))
        if _ticks_of(cells) == ticks:
            break
    return True


def _ticks_of(cells: Iterable[Axes]) -> list[list[float]]:
    """Return the places of the ticks of all axes."""
    return [list(axis.get_majorticklocs()) for ax in cells for axis in (ax.xaxis, ax.yaxis)]


def _cells(figure: Figure) -> dict[Axes, tuple[int, int]]:
    """Return the row and column of all axes; none where they are not in one grid, as a color bar isn't."""
    found: dict[Axes, tuple[int, int]] = {}
    grids: list[object] = []
    for ax in figure.axes:
        place = ax.get_subplotspec()
        if place is None or len(place.rowspan) != 1 or len(place.colspan) != 1:
            return {}
        grid = place.get_gridspec()
        if grids and grid is not grids[0]:
            return {}
        grids.append(grid)
        found[ax] = (place.rowspan.start, place.colspan.start)
    return found


def _place(
    figure: Figure, shape: tuple[int, int], edges: tuple[float, float, float, float], gaps: tuple[float, float]
) -> None:
    """Place axes of equal sizes; edges (left, bottom, right, top) and gaps between axes are in inches."""
    width, height = figure.get_size_inches()
    left, bottom, right, top = edges
    wide = (width - left - right - (shape[1] - 1) * gaps[0]) / shape[1]
    high = (height - bottom - top - (shape[0] - 1) * gaps[1]) / shape[0]
    if min(wide, high) <= 0.0:
        return
    figure.subplots_adjust(
        left / width, bottom / height, 1 - right / width, 1 - top / height, gaps[0] / wide, gaps[1] / high
    )
