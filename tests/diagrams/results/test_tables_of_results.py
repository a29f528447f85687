"""Results as tables: their numbers are those of the results; nothing is computed that takes long, no file is read."""

import math
import re
from dataclasses import replace

import pytest

import loopwright
from loopwright import (
    Diagram,
    Requirements,
    Run,
    disk_margin,
    experiments,
    frequency,
    margins,
    sweeps,
    types,
)
from loopwright.blocks import Gain, StateSpace, Step
from loopwright.blocks.core import ShownAsTable
from loopwright.frequency import nyquist_count, periodic_margins
from support.shown_drive import drive


def row(text, first):
    """Return the entries of a table's row behind its first one."""
    (line,) = re.findall(rf"^{re.escape(first)} {{2,}}(.*)$", text, re.MULTILINE)
    return re.split(" {2,}", line)


def test_a_run_shows_the_range_and_the_end_of_each_named_wire(run):
    text = str(run)
    for name in ("y", "u", "e"):
        values = run[name]
        assert row(text, name) == [f"{v:.6g}" for v in (values.min(), values.max(), values[-1])]
    assert "0 s to 2 s, 101 samples" in text
    assert "and 7 more signals: run.names" in text
    assert run._repr_html_().count("<tr>") == 1 + 1 + 3  # the time, the head, the wires


def test_a_run_with_few_named_wires_shows_the_plants_outputs_too():
    plant = StateSpace(A=[[-1.0]], B=[1.0], C=[1.0], D=0.0, name="plant")
    run = Diagram("few", plant((Step(times=0.2, values=3.0, name="r") - plant.y).named("e"))).simulate(1.0, step=0.1)
    values = run["plant.y"]
    assert row(str(run), "plant.y") == [f"{v:.6g}" for v in (values.min(), values.max(), values[-1])]
    assert "r.y" not in str(run)


def test_units_and_messages_of_a_run_are_shown():
    wave = Step(times=0.2, values=3.0, unit="rad/s", name="step")
    run = Diagram("speed", Gain(gain=1.0)(wave().named("speed"))).simulate(0.4, step=0.1, progress=False)
    assert row(str(run), "speed") == ["rad/s", "0", "3", "3"]
    said = replace(run, messages=("the first", "the second"))
    assert str(said).splitlines()[-2:] == ["the first", "the second"]
    assert "the second" in said._repr_html_()


def test_a_run_on_disk_is_shown_without_reading_it(diagram, tmp_path, monkeypatch):
    diagram.simulate(0.2, to=tmp_path / "run", progress=False)
    opened = Run.open(tmp_path / "run")
    monkeypatch.setattr(Run, "part", lambda *_: pytest.fail("it was read"))
    assert "It is on disk" in str(opened)
    assert "y" in opened._repr_html_()


def test_poles_of_a_model_have_their_frequency_and_damping():
    plant = StateSpace(A=[[0.0, 1.0], [-9.0, -0.6]], B=[0.0, 9.0], C=[1.0, 0.0], name="plant")
    slow = StateSpace(A=[[-0.5]], B=[1.0], C=[1.0], name="slow")
    model = Diagram("open", slow(plant(Step(times=0.1, values=1.0)).named("y"))).linearize()
    text = str(model)
    assert row(text, f"-0.3 ± {math.sqrt(9 - 0.09):.4g}j") == ["3", "0.1"]
    assert row(text, "-0.5") == ["0.5", "1"]


def test_sampled_poles_have_those_of_continuous_time(diagram):
    """Of the plant alone, sampled exactly: the pole of e^(AT) belongs to the pole of A."""
    model = drive(ki=0.0).replace({"kp.gain": 0.0}).linearize()
    (line,) = re.findall(r"^\S+ ± \S+j +(.*)$", str(model), re.MULTILINE)
    frequency, damping, size = map(float, line.split())
    assert (frequency, damping) == pytest.approx((3.0, 0.1), rel=1e-3)
    assert size == pytest.approx(math.exp(-0.3 * 0.02), rel=1e-5)


def test_margins_have_their_gains_in_decibels_too(diagram):
    found = margins(diagram.linearize().loop("u"))
    value = found.gain_margin_high.value
    assert row(str(found), "gain_margin_high") == [f"{value:.6g}", f"{20 * math.log10(value):.3g} dB"]
    assert row(str(found), "phase_margin_deg")[1] == "deg"
    unstable = margins(drive(ki=2.0).linearize().loop("u"))
    assert str(unstable).startswith("margins: none, as the closed loop is unstable\n")


@pytest.mark.slow
def test_the_review_is_the_table_of_the_first_page(diagram):
    limits = {"ms": 2.0, "phase_margin_deg": 30.0}
    report = diagram.report(only=("inner", "poles"), requirements=Requirements(**limits))
    (table,) = (t for t in report.sections[0].tables if t.title == "Requirements")
    text = str(report.review)
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("verdict "))
    assert re.split(" {2,}", lines[first]) == list(table.columns)
    assert len(table.rows) == len(report.review.results)
    for line, cells in zip(lines[first + 1 :], table.rows, strict=False):
        shown = re.split(" {2,}", line)
        assert shown[:5] == [str(cell) for cell in cells[:5]]
        assert float(shown[5].split()[0]) == pytest.approx(float(cells[5]), rel=1e-3)


@pytest.mark.slow
def test_everything_that_shows_itself_has_a_table_a_short_text_and_no_file(diagram, run, monkeypatch, tmp_path):
    model = diagram.linearize()
    loop = model.loop("u")
    shown = [
        *(diagram, run, model, margins(loop), disk_margin(loop), periodic_margins(loop), nyquist_count(loop)),
        *(diagram["plant"], diagram.operating_point(1.0), diagram.sensitivities("u", ["kp.gain"])),
        diagram.worst_case({"kp.gain": (0.1, 0.3)}, "u", count=2, starts=0),
        diagram.sweep({"kp.gain": (0.1, 0.3)}, 0.1, signals="y", progress=False, workers=1, compile=False),
        experiments.path_following(),
    ]
    monkeypatch.setattr("builtins.open", lambda *_, **__: pytest.fail("a file was opened"))
    monkeypatch.setattr(
        "loopwright.diagrams.linearization.linear_model.linearize", lambda *_: pytest.fail("linearized")
    )
    for value in shown:
        assert isinstance(value, ShownAsTable)
        assert str(value) == str(value) != repr(value)
        assert repr(value) == repr(value)
        assert len(repr(value)) < 400
        assert "\x1b" not in str(value)
        html = value._repr_html_()
        assert html.startswith("<style>") or (value is diagram and "<svg" in html)


PUBLIC = {getattr(room, name) for room in (loopwright, frequency, sweeps, types) for name in room.__all__}
SHOWN = sorted((c for c in PUBLIC if isinstance(c, type) and issubclass(c, ShownAsTable)), key=lambda c: c.__name__)


@pytest.mark.parametrize("cls", SHOWN)
def test_a_result_that_is_half_built_is_shown(cls):
    half = object.__new__(cls)
    assert isinstance(repr(half), str)
    assert isinstance(str(half), str)
    assert half._repr_html_() is None or half._repr_html_().startswith("<style>")


def test_states_of_an_operating_point_are_those_of_the_run(diagram, run):
    text = str(diagram.operating_point(1.0))
    state = run.at(1.0).state
    labels = diagram.flatten().log and diagram.flatten().states.each.labels
    assert [row(text, label)[0] for label in labels] == [f"{v:.6g}" for v in state[: len(labels)]]
