"""Frequencies at which a confirmation measures: those of crossings of another model of the same diagram."""

import numpy as np
import pytest

from loopwright.blocks import PID, Constant, OptionError, TransferFunction
from loopwright.diagrams import Diagram
from loopwright.diagrams.studies.confirmed_cases import _deciding_frequency
from loopwright.frequency import margins


def loop():
    plant = TransferFunction(numerator=[2.0], denominator=[1.0, 3.0, 2.0, 0.0], name="plant")
    law = PID(kp=0.5, name="law")
    return Diagram("drive", plant(law(Constant(value=0.0), plant.y).named("u"))).linearize().loop("u")


@pytest.mark.parametrize("off", [0.0, 1e-13, -1e-9, 1e-5])
def test_a_crossing_is_found_by_its_margin_but_for_rounding(off):
    """The model whose sources are held differs in its last digits: the frequency was NaN."""
    L = loop()
    found = margins(L)
    phase, gain = found.phase_margin_deg.value * (1.0 + off), found.gain_margin_high.value * (1.0 + off)
    w = np.geomspace(0.01, 100.0, 400001)
    s = 1j * w
    exact = 1.0 / (s**3 + 3.0 * s**2 + 2.0 * s)  # 0.5 times the plant's 2
    size, angle = np.abs(exact), np.unwrap(np.angle(exact))
    assert _deciding_frequency(L, "phase_margin_deg", phase, "d") == pytest.approx(
        w[np.argmin(np.abs(size - 1.0))], 1e-4
    )
    expected = w[np.argmin(np.abs(angle + np.pi))]
    assert _deciding_frequency(L, "gain_margin_high", gain, "d") == pytest.approx(expected, 1e-4)


@pytest.mark.parametrize(("quantity", "advice"), [("disk_margin", "Simulate found"), ("ms", "quantity='disk_margin'")])
def test_a_number_without_a_frequency_has_another_next_step_for_a_disk_margin(quantity, advice):
    """|S| of 0.5/(s + 1) comes to its largest value, 1, at infinity."""
    lag = TransferFunction(numerator=[0.5], denominator=[1.0, 1.0], name="lag")
    L = Diagram("lag", lag((-1.0 * lag.y).named("u"))).linearize().loop("u")
    with pytest.raises(OptionError, match=f"found '{quantity}', which is decided at inf rad/s; .*{advice}"):
        _deciding_frequency(L, quantity, margins(L).numbers()[quantity].value, "lag")
