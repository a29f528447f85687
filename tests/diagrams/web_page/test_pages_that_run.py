"""Diagrams as pages: their modules, run by wasmtime, have the samples of runs in Python."""

import base64
import copy
import hashlib
import re
from functools import cache

import numpy as np
import pytest

from loopwright import Diagram, Fmu, subsystem
from loopwright.blocks import (
    Constant,
    DiscreteIntegrator,
    Gain,
    PythonFunction,
    Sine,
    Step,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import DefinitionError, OptionError, UnknownNameError
from loopwright.diagrams.web_page.notebook_link import PageRecord
from loopwright.fmus import bouncing_ball, dc_motor
from support.exported_diagrams import mass_at_two_rates
from support.web_modules import Module

T = 1e-3


@subsystem(sample_time=T)
def speed_loop(reference, speed):
    error = reference - speed
    total = DiscreteIntegrator(name="total")(error)
    return (Gain(gain=0.05, name="kp")(error) + Gain(gain=0.8, name="ki")(total)).named("voltage")


@subsystem(sample_time=4 * T)
def slow_filter(voltage):
    before = UnitDelay(initial_value=0.0, name="before")
    return before(0.5 * before.y + 0.5 * voltage).named("smooth")


def drive(target):
    motor = Fmu(dc_motor.build(), name="motor")
    voltage = speed_loop(target, motor.speed.named("speed"))
    return Diagram("drive", motor(voltage=voltage, load_torque=Constant(value=0.0, name="load")), slow_filter(voltage))


TARGET = Constant(value=0.0, unit="rad/s", name="target")


@cache
def page():
    return drive(TARGET).to_html(
        inputs={"target": (-200.0, 200.0), "load": (-0.2, 0.2)},
        sliders={"kp.gain": (0.0, 1.0), "motor.resistance": None},
        plots=[["speed", "target"], "voltage", "motor.current"],
    )


def same(rows, module, run):
    """Whether all columns are those of a run in Python, in every bit."""
    assert rows.shape[0] == len(run.t)
    assert np.array_equal(rows[:, 0], run.t)
    return all(np.array_equal(rows[:, 1 + i], run[name]) for i, name in enumerate(module.names))


def test_a_module_has_the_samples_of_a_run_in_every_bit():
    """The loop at two rates, and the motor's FMU, whose equations are merged: moved by hand as by a step in Python."""
    module = Module(page().html)
    assert module.begin()
    first = module.run(1)
    module.set(module.slider("target")["place"], 100.0)  # acts at the tick at 1 ms
    rows = np.concatenate([first, module.run(1999)])
    stepped = drive(Step(times=T, values=100.0, unit="rad/s", name="target"))
    assert same(rows, module, stepped.simulate(1999 * T, progress=False))
    assert 99.0 < rows[-1, 1] < 101.0


def test_a_parameter_is_moved_while_it_runs_and_a_reset_begins_again():
    module, diagram = Module(page().html), drive(TARGET.replace(value=50.0))
    for _ in range(2):  # the second time after a reset
        module._call("fill")
        module.set(module.slider("target")["place"], 50.0)
        assert module.begin()
        before = module.run(500)
        module.set(module.slider("kp.gain")["place"], 0.3)
        rows = np.concatenate([before, module.run(500)])
        with diagram.simulation() as simulation:
            simulation.advance(499 * T)
            simulation.set_parameters("speed_loop.kp", diagram["kp"].replace(gain=0.3))
            simulation.advance(500 * T)
            assert same(rows, module, simulation.run())


def test_a_parameter_of_an_fmu_is_moved_from_the_start_on_as_its_start_value_is():
    module, diagram = Module(page().html), drive(TARGET.replace(value=50.0)).replace({"motor.resistance": 3.0})
    for _ in range(2):  # the second time after a reset
        module._call("fill")
        module.set(module.slider("motor.resistance")["place"], 3.0)
        module.set(module.slider("target")["place"], 50.0)
        assert module.begin()
        assert same(module.run(500), module, diagram.simulate(0.499, progress=False))


def test_a_parameter_of_an_fmu_is_moved_between_steps():
    """At rest at ω the current is b ω / K, and the voltage R b ω / K + K ω: with another R after the move."""
    module = Module(page().html)
    module.set(module.slider("target")["place"], 100.0)
    assert module.begin()
    column = {name: 1 + i for i, name in enumerate(module.names)}
    rest = [module.run(4000)[-1]]
    module.set(module.slider("motor.resistance")["place"], 6.0)
    rest.append(module.run(4000)[-1])
    motor_constant, friction, w = 0.05, 1e-5, 100.0
    for row, resistance in zip(rest, (1.2, 6.0), strict=True):
        assert row[column["speed"]] == pytest.approx(w, rel=1e-9)
        assert row[column["motor.current"]] == pytest.approx(friction * w / motor_constant, rel=1e-9)
        voltage = resistance * friction * w / motor_constant + motor_constant * w
        assert row[column["voltage"]] == pytest.approx(voltage, rel=1e-9)


def test_a_page_is_one_file_that_asks_for_nothing():
    html = page().html
    assert page().size < 200_000
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', html)[1]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe-eval" not in policy.replace("wasm-unsafe-eval", "")
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    assert len(scripts) == 2  # the page's own, and the drawing's
    for script in scripts:
        assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in policy
    assert not re.search(r"""(src|href)=["'](?!data:)""", html)
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|import)\s*\(", "".join(scripts))
    assert set(Module(html).imports) <= {"exp", "log", "pow"}  # of adaptive steps alone; no sine, cosine, tanh


def test_plots_and_sliders_have_names_units_and_ranges():
    _, data = Module(page().html), Module(page().html).data
    names = [[data["columns"][i]["name"] for i in plot["curves"]] for plot in data["plots"]]
    assert names == [["speed", "target"], ["voltage"], ["motor.current"]]
    assert [plot["unit"] for plot in data["plots"]] == ["rad/s", "", "A"]
    columns = ["speed", "target", "voltage", "motor.current", "slow_filter.smooth"]  # each signal once
    assert [column["name"] for column in data["columns"]] == columns
    inputs, parameters = data["groups"]
    assert [(s["label"], s["low"], s["high"], s["value"], s["unit"]) for s in inputs["sliders"]] == [
        ("target", -200.0, 200.0, 0.0, "rad/s"),
        ("load", -0.2, 0.2, 0.0, ""),
    ]
    assert [(s["name"], s["low"], s["high"], s["value"], s["unit"], s["log"]) for s in parameters["sliders"]] == [
        ("kp.gain", 0.0, 1.0, 0.05, "", False),
        ("motor.resistance", 0.24, 6.0, 1.2, "Ohm", True),
    ]


def test_without_choices_a_page_has_the_constants_and_the_named_wires():
    diagram = Diagram(
        "d", Gain(gain=[1.0, 2.0], name="two")(Constant(value=3.0, unit="m", name="u")).named("y"), step(0.5)
    )
    data = Module(diagram.to_html().html).data
    assert [s["name"] for group in data["groups"] for s in group["sliders"]] == ["u", "level"]
    assert [s["high"] for group in data["groups"] for s in group["sliders"]] == [6.0, 1.0]
    assert [c["name"] for c in data["columns"]] == ["y[1]", "y[2]"]


def test_names_have_letters_of_all_alphabets_on_a_page(tmp_path):
    @subsystem(sample_time=0.5)
    def box(φ):
        return DiscreteIntegrator(name="ω")(φ).named("θ")

    diagram = Diagram("Größe", box(Constant(value=1.0, unit="N.m", name="φ")))
    made = diagram.to_html(title="<script>alert('x')</script> & Söhne")
    module = Module(made.html)
    assert [c["name"] for c in module.data["columns"]] == ["θ"]
    assert module.slider("φ")["unit"] == "N.m"
    assert module.begin()
    assert module.run(4)[:, 1].tolist() == [0.0, 0.5, 1.0, 1.5]
    assert made.html.count("<script>") == 2  # of ours
    assert "<title>&lt;script&gt;alert(&#x27;x&#x27;)&lt;/script&gt; &amp; Söhne</title>" in made.html
    with pytest.raises(DefinitionError, match=r"the variable name '[\w.]+' is not made of identifiers.*A to Z"):
        diagram.to_c(tmp_path, subsystem="box")


def step(value):
    """Return a sampled part: a page needs a clock."""

    @subsystem(sample_time=0.5)
    def box(u):
        return UnitDelay(name="delay")(u)

    return box(Constant(value=value, name="level"))


def test_a_page_is_shown_in_a_notebook_and_saved(tmp_path):
    shown = page()._repr_html_()
    assert '<iframe sandbox="allow-scripts allow-downloads"' in shown
    assert "<script" not in shown  # all of it is text of an attribute
    assert "is shown in a trusted notebook" in shown.partition("<iframe")[0]
    assert page().save(tmp_path / "drive.html").read_text(encoding="utf-8") == page().html
    with pytest.raises(OptionError, match=r"expected a page; name it drive\.html"):
        page().save(tmp_path / "drive.txt")


# --- what was played in a notebook ----------------------------------------------------------------------------------------


def sent(rows, first, *changes, run=1):
    """Return a message of a page, as a notebook passes it on."""
    listed = [{"after": after, "t": t, "name": name, "value": value} for after, t, name, value in changes]
    return {"view": "a", "run": run, "first": first, "count": len(rows), "changes": listed}, [rows.tobytes()]


def test_the_samples_of_a_page_come_back_and_the_same_run_in_python_has_them():
    played, module = copy.copy(page()), Module(page().html)
    played._record = PageRecord(len(module.names) + 1)
    with pytest.raises(
        OptionError, match=r"found no sample of this page; they come back .* notebook.*save the record as CSV"
    ):
        _ = played.run
    module.set(module.slider("kp.gain")["place"], 0.1)
    assert module.begin()
    first = module.run(300)
    module.set(module.slider("target")["place"], 100.0)
    rows = np.concatenate([first, module.run(700)])
    gain, aim = (0, None, "kp.gain", 0.1), (300, 0.299, "target", 100.0)
    played._record.take(None, *sent(rows[:5], 0, run=0))  # before a reset
    played._record.take(None, *sent(rows[:300], 0, gain))
    played._record.take(None, *sent(rows[300:900], 300, (*aim[:3], 70.0)))
    played._record.take(None, *sent(rows[700:], 700, aim))  # some rows twice; the slider was moved on at the same tick
    run = played.run
    assert np.array_equal(run.t, rows[:, 0])
    assert np.array_equal(run["speed"], rows[:, 1])
    assert np.array_equal(run["motor.current"], rows[:, 1 + module.names.index("motor.current")])
    assert run.unit("speed") == "rad/s"
    assert [(c.t, c.name, c.value) for c in played.changes] == [gain[1:], aim[1:]]
    again = played.simulate()
    assert all(np.array_equal(run[name], again[name]) for name in run.names)
    played._record.take(None, *sent(rows[:0], 1000, (1000, 0.999, "motor.resistance", 2.0)))
    with pytest.raises(OptionError, match=r"'motor.resistance' was moved at t = 0.999 s; expected .* before the run"):
        played.simulate()


# --- what is refused, before anything is compiled -------------------------------------------------------------------------


@pytest.fixture
def uncompiled(monkeypatch):
    def refuse(*arguments):
        raise AssertionError("compiled")

    monkeypatch.setattr("loopwright.diagrams.web_page.module.compile_webassembly", refuse)


def test_a_function_of_python_is_refused_by_its_path(uncompiled):
    @subsystem(sample_time=T)
    def box(u):
        return PythonFunction(lambda u: 2.0 * u, name="own")(u)

    with pytest.raises(
        DefinitionError, match="Python evaluates it.*Write its equations with NumPy functions"
    ) as caught:
        Diagram("d", box(Constant(value=1.0))).to_html()
    assert caught.value.block == "box.own"


def test_an_fmu_of_others_is_refused_by_its_path(uncompiled, monkeypatch):
    monkeypatch.setattr("loopwright.diagrams.exporting.plants_to_merge.read_own_sources", lambda path: None)
    with pytest.raises(DefinitionError, match=r"dc_motor\.fmu, an FMU that .*has not built.*Replace it by") as caught:
        drive(TARGET).to_html()
    assert caught.value.block == "motor"


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"inputs": ["targett"]}, UnknownNameError, "Did you mean"),
        ({"inputs": {"target": (1.0, 2.0)}}, OptionError, "which is 0; expected one that has it"),
        ({"inputs": {"target": (1.0, 1.0)}}, OptionError, "expected its smallest and its largest value"),
        ({"sliders": ["motor.integrator"]}, OptionError, r"of an FMU; expected one .* motor\.resistance, motor\.induc"),
        ({"sliders": ["motor.start"]}, OptionError, "of an FMU; expected one of its parameters that may change"),
        ({"sliders": {"motor.resistance": (0.0, 2.0)}}, OptionError, "expected values above 0"),
        ({"sliders": ["target.unit"]}, OptionError, "expected a parameter that is a number"),
        ({"plots": ["speeed"]}, UnknownNameError, "Did you mean 'speed'"),
        ({"plots": [3]}, OptionError, "found 3 among the plots"),
        ({"path": "drive.txt"}, OptionError, "name it drive.html"),
    ],
)
def test_mistakes_are_refused(uncompiled, options, error, words):
    with pytest.raises(error, match=words):
        drive(TARGET).to_html(**options)


# --- diagrams of other kinds ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_continuous_diagram_is_sampled_at_a_step():
    """ÿ + ẏ/2 + y = 1, from rest: the closed form, to the tolerance of the method."""
    lag = TransferFunction(numerator=[1.0], denominator=[1.0, 0.5, 1.0])
    page = Diagram("lag", lag(Constant(value=1.0, name="u")).named("y")).to_html(step=0.05, plots=["y"])
    module = Module(page.html)
    assert module.begin()
    t, y = module.run(200).T[:2]
    w = np.sqrt(1.0 - 0.25**2)
    assert np.array_equal(t, np.arange(200) / 20)
    assert np.abs(y - (1.0 - np.exp(-0.25 * t) * (np.cos(w * t) + 0.25 / w * np.sin(w * t)))).max() < 1e-6


def test_a_page_without_clocks_and_states_is_evaluated_at_its_steps():
    module = Module(Diagram("d", Gain(gain=2.0)(Sine(frequency=1.0)).named("y")).to_html(step=0.01, plots=["y"]).html)
    assert module.begin()
    t, y = module.run(101).T
    np.testing.assert_allclose(y, 2.0 * np.sin(2.0 * np.pi * t), rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_plant_behind_blocks_in_continuous_time_steps_at_the_pages_steps():
    motor = Fmu(dc_motor.build(), name="motor")
    voltage = Gain(gain=-0.02)(motor.speed) + 1.0
    diagram = Diagram("d", motor(voltage=voltage, load_torque=Constant(value=0.0)))
    module = Module(diagram.to_html(step=T, inputs=[], plots=["motor.speed"]).html)
    assert module.begin()
    run = diagram.simulate(0.1, step=T, progress=False)
    assert same(module.run(len(run.t)), module, run)


@pytest.mark.slow
def test_plants_step_at_the_ticks_of_all_rates_around_them():
    """At 2 and 3 ticks: the plant steps at 2, 3, 4, 6, and each subsystem holds its outputs."""
    diagram = mass_at_two_rates()
    module = Module(diagram.to_html(inputs=[], plots=["force", "v", "plant.position"]).html)
    assert module.begin()
    run = diagram.simulate(0.6, progress=False)
    assert same(module.run(len(run.t)), module, run)
    assert module.run(1)[0, 0] == 0.602


@pytest.mark.slow
def test_an_fmu_with_events_between_ticks():
    """A ball that bounces: the FMU finds its contacts within its steps."""

    @subsystem(sample_time=0.01)
    def look(height):
        return Gain(gain=2.0)(height).named("twice")

    ball = Fmu(bouncing_ball.build(), name="ball")
    diagram = Diagram("ball", look(ball.height))
    module = Module(diagram.to_html(inputs=[], plots=["twice", "ball.height"]).html)
    assert module.begin()
    assert same(module.run(301), module, diagram.simulate(3.0, progress=False))


def test_a_module_stops_where_a_value_is_not_finite():
    @subsystem(sample_time=1.0)
    def box(u):
        total = DiscreteIntegrator(initial_value=-3.0, name="total")(u)
        return np.sqrt(0.0 - total).named("root")  # the total is -3, -2, -1, 0, 1: the root of -1 is none

    module = Module(Diagram("d", box(Constant(value=1.0, name="u"))).to_html(plots=["root"]).html)
    assert module.begin()
    rows = module.run(10)
    assert rows[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert module._call("failed") == 1
    assert module._call("plant") == -1
