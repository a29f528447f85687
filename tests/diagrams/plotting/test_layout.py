"""Layout of figures: ticks, labels and legends have room, nothing overlaps, and axes fill what is left."""

from itertools import combinations

import numpy as np
import pytest

from loopwright.diagrams.plotting import WIDTH, lay_out, legend_above, new_figure, style

SLACK = 1.5
"""Pixels by which rounding may move a label."""


def drawn(rows, columns, height, width=WIDTH, *, legend=True, equal=False, span=1e4, title=""):
    """Return a figure of curves with ticks and labels of various widths."""
    x = np.geomspace(1.0, 1e3, 50)
    with style():
        figure = new_figure(height, width)
        axes = figure.subplots(rows, columns, squeeze=False)
        for i, ax in enumerate(axes.flat):
            ax.plot(x, np.linspace(-span, span, 50) * 10.0**i, label="one of two curves")
            ax.plot(x, np.linspace(span, 0.0, 50), label="the other one of them")
            ax.set_xlabel("frequency")
            ax.set_ylabel("size")
            ax.set_title(title)
            if equal:
                ax.set_aspect("equal")
                ax.set(xlim=(-2.6, 1.4), ylim=(-1.7, 1.7))
        if legend:
            legend_above(figure, axes[0, 0])
    return figure


def area(figure, renderer):
    """Return the area of all axes in square pixels."""
    for ax in figure.axes:
        ax.apply_aspect()
    return sum(ax.get_window_extent(renderer).width * ax.get_window_extent(renderer).height for ax in figure.axes)


@pytest.mark.parametrize(
    ("shape", "options"),
    [
        ((2, 1, 3.0), {}),
        ((1, 2, 2.1), {"title": "T"}),
        ((2, 1, 1.25), {"width": WIDTH / 2, "legend": False}),
        ((1, 1, 2.9), {"equal": True}),
        ((2, 2, 4.0), {"span": 1e-7}),
    ],
)
@pytest.mark.drawn(3)
def test_nothing_is_cut_off_or_overlaps_and_the_axes_fill_the_rest(shape, options):
    figure = drawn(*shape, **options)
    engine = figure.get_layout_engine()
    renderer = figure.canvas.get_renderer()
    engine.execute(figure)
    usual = area(figure, renderer)
    figure.set_layout_engine(None)
    assert lay_out(figure)
    figure.draw(renderer)
    boxes = [ax.get_tightbbox(renderer) for ax in figure.axes]
    boxes += [legend.get_tightbbox(renderer) for legend in figure.legends]
    whole = figure.bbox
    for box in boxes:
        assert box.x0 >= whole.x0 - SLACK
        assert box.y0 >= whole.y0 - SLACK
        assert box.x1 <= whole.x1 + SLACK
        assert box.y1 <= whole.y1 + SLACK
    for one, two in combinations(boxes, 2):
        assert min(one.x1, two.x1) - max(one.x0, two.x0) < SLACK or min(one.y1, two.y1) - max(one.y0, two.y0) < SLACK
    assert area(figure, renderer) > 0.9 * usual  # what matplotlib's own layout leaves for the axes


def test_axes_that_stand_in_no_grid_are_left_to_matplotlib():
    figure = drawn(1, 1, 2.0)
    figure.colorbar(figure.axes[0].scatter([1.0, 2.0], [1.0, 2.0], c=[1.0, 2.0]), ax=figure.axes[0])
    before = [ax.get_position().bounds for ax in figure.axes]
    figure.set_layout_engine(None)
    assert not lay_out(figure)
    assert [ax.get_position().bounds for ax in figure.axes] == before


def test_longer_numbers_that_the_placed_axes_have_room_for_are_measured_as_well():
    """Ticks at 0, 1 and 2 in the room that was guessed; the axes come out higher, and have 0.0, 0.5, 1.0, …."""
    with style():
        figure = new_figure(1.7, WIDTH / 2)
        ax = figure.subplots()
        ax.plot([0.0, 6.0], [0.0, 1.5])
        ax.set(xlabel="time", ylabel="answer")
    figure.set_layout_engine(None)
    assert lay_out(figure)
    assert ax.get_tightbbox(figure.canvas.get_renderer()).x0 >= -SLACK
