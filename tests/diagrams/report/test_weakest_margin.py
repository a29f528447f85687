"""The weakest margin on the first page of a report, with its frequency."""

import control
import numpy as np

from loopwright.blocks import Constant, Gain, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.frequency import Realization, find_disk_frequency
from loopwright.diagrams.report import Case, analyse
from loopwright.diagrams.report.sections.summary import _weakest


def test_the_disk_margin_is_told_at_its_own_frequency():
    """Around this unstable plant |S| is largest at π/T, and |S − T| at a low frequency."""

    @subsystem(sample_time=0.01)
    def controller(y):
        return Gain(gain=3.0, name="k")(Constant(value=0.0, name="r") - y)

    plant = TransferFunction(numerator=[2.0, 4.0], denominator=[1.0, 0.5, -1.5], name="plant")
    diagram = Diagram("unstable", plant(controller(plant.y).named("u")))
    L = diagram.linearize().loop("u")
    exact = 3.0 * control.c2d(control.tf([2.0, 4.0], [1.0, 0.5, -1.5]), 0.01)
    w = np.geomspace(0.01, np.pi / 0.01, 100_001)
    at = exact(np.exp(0.01j * w))
    peak = w[np.argmax(np.abs((1 - at) / (1 + at)))]
    worst = w[np.argmax(np.abs(1 / (1 + at)))]
    assert worst > 10.0 * peak
    assert abs(find_disk_frequency(Realization.of(L)) / peak - 1.0) < 1e-3
    numbers = analyse(diagram, only=("inner",)).numbers()
    text = next(_weakest(Case(diagram.wired), numbers))
    assert f" near {peak:.3g} rad/s" in text
