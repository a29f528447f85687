"""Measured loops in a report: their margins beside the model's."""

import control
import numpy as np
import pytest

from loopwright.blocks import Constant, Integrator, OptionError, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram, analyse


def drive(gain=4.0):
    """L = gain/(s (0.1 s + 1))."""
    lag, place = TransferFunction(numerator=[gain], denominator=[0.1, 1.0], name="lag"), Integrator(name="place")
    return Diagram("drive", place(lag((Constant(value=0.0, name="r") - place.y).named("e"))))


def data(gain, uncertainty):
    w = np.geomspace(0.1, 100.0, 80)
    found = control.frd(gain / (1j * w * (0.1j * w + 1)), w)
    found.uncertainty = uncertainty
    return found


def test_a_measured_loop_stands_beside_the_model():
    report = analyse(drive(), only=("poles",), measured={"e": data(4.0, 0.02)})
    section = report.sections[-1]
    wc = np.sqrt((np.sqrt(1 + 4 * 0.16) - 1) / 0.02)
    margin = 90 - np.degrees(np.arctan(0.1 * wc))
    number = report.numbers()["measured.e.phase_margin_deg"]
    assert number.value == pytest.approx(margin, abs=0.1)
    assert number.tolerance > np.degrees(0.02)
    row = next(row for row in section.tables[0].rows if row[1] == "phase margin deg")
    assert float(row[4]) == pytest.approx(margin, abs=1e-6)
    assert row[5] == "yes"
    assert {plot.key for plot in section.plots} == {"measured_e"}
    assert any("the measured L is at most" in text for text in section.text)
    assert any("not real and negative" in text for text in section.text)


def test_a_model_that_is_not_the_machine_is_outside_of_the_interval():
    report = analyse(drive(), only=("poles",), measured={"e": data(8.0, 0.02)})
    rows = {row[1]: row for row in report.sections[-1].tables[0].rows}
    assert rows["phase margin deg"][5] == "no"
    assert any("100 % of the model's" in text for text in report.sections[-1].text)


def test_a_file_is_read_and_a_wire_that_is_not_there_is_named(tmp_path):
    file = tmp_path / "e.csv"
    w = np.geomspace(0.1, 100.0, 60)
    L = 4.0 / (1j * w * (0.1j * w + 1))
    file.write_text("omega,real,imag\n" + "\n".join(f"{a},{b.real},{b.imag}" for a, b in zip(w, L, strict=True)))
    report = analyse(drive(), only=("poles",), measured={"e": file})
    assert report.numbers()["measured.e.ms"].value > 1.0
    with pytest.raises(UnknownNameError, match="'f'"):
        analyse(drive(), only=("poles",), measured={"f": file})
    with pytest.raises(OptionError, match="expected frequency-response data"):
        analyse(drive(), only=("poles",), measured={"e": 3.0})
