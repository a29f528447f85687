"""Plots of runs: names stand where they hide nothing."""

from loopwright.blocks import Gain, Ramp
from loopwright.diagrams import Diagram


def test_labels_of_neighbours_do_not_overlap_however_long_the_names_are():
    ramp = Ramp(slope=1.0, name="ramp")
    names = [f"a_{'long_' * k}name" for k in (0, 2, 4, 8, 10)]
    run = Diagram("d", *(Gain(gain=2.0, name=f"g{k}")(ramp).named(name) for k, name in enumerate(names))).simulate(
        1.0, step=0.1, progress=False
    )
    figure = run.plot(*names)
    figure.canvas.draw()
    boxes = [ax.yaxis.label.get_window_extent() for ax in figure.axes]
    boxes += [ax.title.get_window_extent() for ax in figure.axes]
    boxes += [ax._left_title.get_window_extent() for ax in figure.axes]
    boxes += [ax.get_window_extent() for ax in figure.axes]
    shown = [box for box in boxes if box.width > 1.0 and box.height > 1.0]
    assert len(shown) == 2 * len(names)
    for i, one in enumerate(shown):
        assert one.x0 >= 0.0
        assert one.x1 <= figure.bbox.width
        assert not any(one.overlaps(other) for other in shown[:i])
    told = [ax.get_ylabel() or ax.get_title(loc="left") for ax in figure.axes]
    assert told == names
