"""Measured loops in a report: their margins beside the model's."""

import json
import math
import re

import control
import numpy as np
import pytest

from loopwright.blocks import Constant, Integrator, OptionError, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram, Requirements, analyse
from loopwright.diagrams.cli.command_line import main
from loopwright.diagrams.report.pages.json import to_json
from loopwright.diagrams.requirements import Limit, Reason, judge_interval
from loopwright.types import Verdict

pytestmark = pytest.mark.usefixtures("without_drawings")


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
    row = next(row for row in section.tables[0].rows if row[1] == "phase margin")
    assert float(row[4]) == pytest.approx(margin, abs=1e-6)
    assert row[5] == "yes"
    assert {plot.key for plot in section.plots} == {"measured_e"}
    assert any("the measured L differs from the model's by at most" in text for text in section.text)
    assert any("not real and negative" in text for text in section.text)


def test_a_model_that_is_not_the_machine_is_outside_of_the_interval():
    report = analyse(drive(), only=("poles",), measured={"e": data(8.0, 0.02)})
    rows = {row[1]: row for row in report.sections[-1].tables[0].rows}
    assert rows["phase margin"][5] == "no"
    assert any("differs from the model's by at most 100 %" in text for text in report.sections[-1].text)


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


# --- requirements -------------------------------------------------------------------------------------------------------

WC = float(np.sqrt((np.sqrt(1 + 4 * 0.16) - 1) / 0.02))
MARGIN = 90 - float(np.degrees(np.arctan(0.1 * WC)))
"""Gain crossover and phase margin of 4/(s (0.1 s + 1)), by hand."""


def judged(limit, uncertainty=0.05, gain=4.0, **more):
    """Return the verdicts on the phase margin of the model and of the measured loop."""
    asked = Requirements(phase_margin_deg=limit, **more)
    report = analyse(drive(), only=("poles", "inner"), measured={"e": data(gain, uncertainty)}, requirements=asked)
    return {r.variant: r for r in report.review.results if r.quantity == "phase_margin_deg"}, report


TURN = float(np.degrees(np.arcsin(0.05)))
"""Turn of L by its uncertainty; the crossing moves as well, by less than thrice that here."""


@pytest.mark.parametrize(
    ("limit", "verdict"),
    [
        (MARGIN - 4 * TURN, Verdict.PASSED),
        (MARGIN - 0.9 * TURN, Verdict.UNDECIDED),
        (MARGIN + 0.9 * TURN, Verdict.UNDECIDED),
        (MARGIN + 4 * TURN, Verdict.FAILED),
    ],
)
@pytest.mark.drawn(2)
def test_an_interval_that_straddles_a_limit_is_not_decided(limit, verdict):
    found, report = judged(limit)
    measured = found["measured"]
    assert measured.verdict is verdict
    assert measured.distance == pytest.approx(MARGIN - limit, abs=0.1)
    assert found["continuous"].verdict is (Verdict.PASSED if limit < MARGIN else Verdict.FAILED)
    tree = json.loads(to_json(report))
    assert tree["requirements"]["verdict"] == report.review.verdict.value
    ends = [tree["measured"]["e"]["interval"]["phase_margin_deg"][end]["value"] for end in ("low", "high")]
    assert ends[0] < MARGIN - TURN < MARGIN + TURN < ends[1]
    if verdict is Verdict.UNDECIDED:
        assert measured.reason is Reason.WITHIN_TOLERANCE
        (row,) = [row for row in report.sections[0].tables[0].rows if row[3] == "measured"]
        assert f"{ends[0]:.4g} … {ends[1]:.4g}" in row[0]


def test_a_sound_model_and_a_machine_that_is_not_fail_together():
    found, report = judged(50.0, gain=24.0)
    assert found["continuous"].verdict is Verdict.PASSED
    assert found["measured"].verdict is Verdict.FAILED
    assert report.review.verdict is Verdict.FAILED


@pytest.mark.slow
def test_data_that_do_not_say_how_uncertain_they_are_pass_nothing():
    found, report = judged(10.0, uncertainty=None)
    assert (found["measured"].verdict, found["measured"].reason) == (Verdict.UNDECIDED, Reason.NO_UNCERTAINTY)
    assert any("Add a column `uncertainty`" in text for text in report.sections[-1].text)
    assert judged(10.0, uncertainty=0.0)[0]["measured"].verdict is Verdict.PASSED
    assert judged(80.0, uncertainty=None)[0]["measured"].verdict is Verdict.FAILED


def test_a_margin_that_the_data_do_not_show_is_not_decided():
    asked = Requirements(gain_margin_high=2.0, variants={"measured": {"phase_margin_deg": 20}})
    report = analyse(drive(), only=("poles", "inner"), measured={"e": data(4.0, 0.01)}, requirements=asked)
    found = {(r.variant, r.quantity): r for r in report.review.results}
    assert found["measured", "gain_margin_high"].reason is Reason.NO_VALUE
    assert found["measured", "phase_margin_deg"].verdict is Verdict.PASSED
    assert ("continuous", "phase_margin_deg") not in found
    assert report.review.verdict is Verdict.UNDECIDED


@pytest.mark.parametrize(("key", "asked"), [("e", False), ("measured", True)])
def test_a_number_that_data_have_not_is_asked_of_them_only_by_their_own_key(key, asked):
    limits = {"loops": {"e": {"disk_margin": 0.1}}} if key == "e" else {"variants": {key: {"disk_margin": 0.1}}}
    report = analyse(
        drive(), only=("poles", "inner"), measured={"e": data(4.0, 0.01)}, requirements=Requirements(**limits)
    )
    found = [r for r in report.review.results if r.variant == "measured"]
    assert [(r.quantity, r.reason) for r in found] == ([("disk_margin", Reason.NO_NUMBER)] if asked else [])


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((2.0, 1.5, 2.5), Verdict.PASSED),
        ((2.0, 0.5, 2.5), Verdict.UNDECIDED),
        ((2.0, 1.5, math.inf), Verdict.UNDECIDED),
        ((0.5, 0.1, 0.9), Verdict.FAILED),
        ((4.0, 3.1, 5.0), Verdict.FAILED),
        ((math.nan, math.nan, math.nan), Verdict.UNDECIDED),
        ((2.0, math.nan, 2.5), Verdict.UNDECIDED),
    ],
)
def test_an_interval_is_judged_by_both_ends(interval, verdict):
    assert judge_interval(*interval, Limit(1.0, 3.0))[0] is verdict


def test_two_files_for_one_wire_are_refused():
    with pytest.raises(OptionError, match="'e' and 'r_minus_place.y', which are one wire"):
        analyse(drive(), only=("poles",), measured={"e": data(4.0, 0.1), "r_minus_place.y": data(4.0, 0.1)})


FILE = """
from loopwright.blocks import Constant, Integrator, TransferFunction
from loopwright.diagrams import Diagram

lag, place = TransferFunction(numerator=[4.0], denominator=[0.1, 1.0], name="lag"), Integrator(name="place")
drive = Diagram("drive", place(lag((Constant(value=0.0, name="r") - place.y).named("e"))))
"""


def write_csv(path, gain=4.0, uncertainty=0.05):
    w = np.geomspace(0.1, 100.0, 60)
    L = gain / (1j * w * (0.1j * w + 1))
    rows = (f"{a},{b.real},{b.imag},{uncertainty}" for a, b in zip(w, L, strict=True))
    path.write_text("omega,real,imag,uncertainty\n" + "\n".join(rows))


@pytest.mark.parametrize(("gain", "status"), [(4.0, 0), pytest.param(24.0, 3, marks=pytest.mark.slow)])
def test_the_command_line_takes_measured_loops(tmp_path, monkeypatch, capsys, gain, status):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(FILE, encoding="utf-8")
    (tmp_path / "limits.toml").write_text("phase_margin_deg = 50", encoding="utf-8")
    write_csv(tmp_path / "e.csv", gain)
    monkeypatch.setattr(
        "loopwright.diagrams.report.analyse", lambda *of, **options: analyse(*of, only=("poles", "inner"), **options)
    )
    line = ["report", "loop.py:drive", "--requirements", "limits.toml", "--check", "--json", "--measured", "e=e.csv"]
    assert main(line) == status
    tree = json.loads((tmp_path / "drive.json").read_text(encoding="utf-8"))
    assert tree["measured"]["e"]["phase_margin_deg"]["value"] == pytest.approx(
        180 - 90 - np.degrees(np.arctan(0.1 * np.sqrt((np.sqrt(1 + 0.04 * gain**2) - 1) / 0.02))), abs=0.1
    )
    assert {r["variant"] for r in tree["requirements"]["results"]} == {"continuous", "measured"}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("e.csv", r"--measured: found 'e.csv'; expected WIRE=FILE.csv, such as --measured u=u.csv"),
        ("e=none.csv", r"none.csv: it can't be read: there is no 'none.csv'; .* Name another file"),
        ("e=bad.csv", r"bad.csv: line 4 has no number in the column 'imag'"),
        ("f=e.csv", r"there is no signal 'f' in this diagram"),
    ],
)
def test_a_measured_loop_that_is_not_there_is_wrong_usage(tmp_path, monkeypatch, capsys, given, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.py").write_text(FILE, encoding="utf-8")
    write_csv(tmp_path / "e.csv")
    (tmp_path / "bad.csv").write_text("omega,real,imag\n1,2,3\n\n2,3,x\n", encoding="utf-8")
    assert main(["report", "loop.py:drive", "--measured", given]) == 2
    assert re.search(said, capsys.readouterr().err)
    assert not list(tmp_path.glob("*.html"))
