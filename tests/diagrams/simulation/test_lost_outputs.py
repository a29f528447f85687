"""Outputs of FMUs that are no numbers: without a reader the run goes on, with one it ends."""

import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Gain, Input, Output, State, StopCondition, UnitDelay
from loopwright.diagrams import Diagram, NonFiniteError, subsystem
from loopwright.diagrams.results import Run
from loopwright.fmus import Fmu, build
from support.lost_output import LIMIT, lost_output

H, END = 0.05, 0.5
TIERS = pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "compiled"])
PLACES = pytest.mark.parametrize("isolate", [False, True], ids=["here", "isolated"])
INTERFACES = pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return lost_output(tmp_path_factory.mktemp("lost"))


def driven(file, *more, **options):
    plant = Fmu(file, name="plant", **options)
    return Diagram("d", plant(u=Constant(value=1.0, name="one")), *(make(plant) for make in more))


def assert_went_on(run, value=np.nan):
    np.testing.assert_allclose(run["plant.x"], run.t, rtol=0, atol=1e-12)  # x = t, whatever stands beside it
    assert run.t[-1] == END
    lost = run.t > LIMIT + 1e-6
    assert lost.any()
    np.testing.assert_array_equal(run["plant.lost"], np.where(lost, value, 1.0))
    said = [m for m in run.messages if "plant.lost" in m]
    assert len(said) == 1
    first = float(run.t[lost][0])
    assert said[0].startswith(f"no finite numbers are in the record of plant.lost from t = {first:.9g} s on: an FMU")
    assert "ports=" in said[0]


@pytest.mark.drawn(1)
@INTERFACES
@PLACES
@TIERS
def test_an_output_that_nothing_reads_does_not_end_the_run(file, interface, isolate, compiled):
    diagram = driven(file, interface=interface, isolate=isolate)
    assert_went_on(diagram.simulate(END, step=H, progress=False, compile=compiled))


@INTERFACES
@PLACES
@TIERS
def test_an_output_that_a_wire_reads_ends_it(file, interface, isolate, compiled):
    diagram = driven(file, lambda p: Gain(name="twice", gain=2.0)(p.lost), interface=interface, isolate=isolate)
    with pytest.raises(NonFiniteError) as e:
        diagram.simulate(END, step=H, progress=False, compile=compiled)
    assert str(e.value).startswith("plant.lost, t = 0.3 s: found [nan]; expected finite numbers.")
    assert "It is read by twice.u." in str(e.value)
    assert "which ports= makes a port; an output that nothing reads may be NaN." in str(e.value)
    assert e.value.run.t[-1] == pytest.approx(LIMIT)
    assert np.isfinite(e.value.run["plant.lost"]).all()


@TIERS
def test_a_stop_condition_reads(file, compiled):
    diagram = driven(file, lambda p: StopCondition(name="stop")(Gain(gain=-1.0)(p.lost)))
    with pytest.raises(NonFiniteError, match=r"^plant\.lost, t = 0\.3 s: found \[nan\]"):
        diagram.simulate(END, step=H, progress=False, compile=compiled)


@TIERS
def test_infinite_numbers_are_no_others(cache, tmp_path, compiled):
    diagram = driven(lost_output(tmp_path, "INFINITY"))
    assert_went_on(diagram.simulate(END, step=H, progress=False, compile=compiled), np.inf)


@pytest.mark.drawn(1)
@TIERS
def test_in_a_diagram_that_is_compiled_block_by_block(file, compiled, monkeypatch):
    monkeypatch.setattr("loopwright.diagrams.flat.flat_diagram.FlatDiagram.by_block", True)
    diagram = driven(file, lambda p: Gain(name="twice", gain=2.0)(p.x))
    run = diagram.simulate(END, step=H, progress=False, compile=compiled)
    assert_went_on(run)
    np.testing.assert_allclose(run["twice.y"], 2.0 * run.t, rtol=0, atol=1e-12)
    with pytest.raises(NonFiniteError, match=r"^plant\.lost, t = 0\.3 s: found \[nan\]"):
        driven(file, lambda p: Gain(name="twice", gain=2.0)(p.lost)).simulate(
            END, step=H, progress=False, compile=compiled
        )


@TIERS
def test_under_a_sampled_controller(file, compiled):
    plant = Fmu(file, name="plant")

    @subsystem(sample_time=H)
    def controller(x):
        return Gain(name="k", gain=0.0)(UnitDelay(name="last")(x)) + 1.0

    run = Diagram("d", plant(u=controller(plant.x))).simulate(END, progress=False, compile=compiled)
    assert_went_on(run)


@pytest.mark.parametrize("coupling", ["gauss_seidel", "iterated"])
def test_coupled_fmus(file, coupling):
    first, second = (Fmu(file, name=name) for name in ("plant", "other"))
    diagram = Diagram("d", first(u=Constant(value=1.0, name="one")), second(u=first.x))
    run = diagram.simulate(END, step=H, progress=False, coupling=coupling)
    assert_went_on(run)


def test_a_run_on_disk_has_it_too(file, tmp_path):
    driven(file).simulate(END, step=H, progress=False, to=tmp_path / "run")
    assert_went_on(Run.open(tmp_path / "run"))


def test_what_is_not_recorded_is_not_said(file):
    run = driven(file).simulate(END, step=H, progress=False, record=["plant.x"])
    assert not run.messages or not any("plant.lost" in m for m in run.messages)
    np.testing.assert_allclose(run["plant.x"], run.t, rtol=0, atol=1e-12)


def test_ports_leave_it_out(file):
    run = driven(file, ports=["u", "x"]).simulate(END, step=H, progress=False)
    assert not any("lost" in m for m in run.messages)


@TIERS
def test_a_sweep_goes_on_as_a_run(file, compiled):
    found = driven(file).sweep(
        {"one.value": (1.0, 2.0)},
        END,
        step=H,
        signals=["plant.x", "plant.lost"],
        progress=False,
        compile=compiled,
        workers=1,
    )
    assert not found.failures
    for i, slope in enumerate((1.0, 2.0)):
        np.testing.assert_allclose(found["plant.x"][i], slope * found.t, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(np.isnan(found["plant.lost"][i]), slope * found.t > LIMIT + 1e-6)


@pytest.mark.drawn(1)
@INTERFACES
def test_a_linear_model_where_it_is_no_number_names_the_output(file, interface):
    def point_and_diagram(**options):
        plant = Fmu(file, name="plant", interface=interface, isolate=False, **options)
        diagram = Diagram("d", plant(u=Gain(name="push", gain=1.0)(Constant(value=1.0, name="one"))))
        return diagram.operating_point(0.4, step=0.1), diagram

    point, diagram = point_and_diagram()
    assert np.isnan(point.values["plant.lost"])
    with pytest.raises(NonFiniteError, match=r"^plant\.lost, t = 0\.4 s: found \[nan\]; .* ports=\[…\]"):
        diagram.linearize(point, inputs=["push.y"], outputs=["plant.x"])
    point, diagram = point_and_diagram(ports=["u", "x"])
    model = diagram.linearize(point, inputs=["push.y"], outputs=["plant.x"])
    np.testing.assert_allclose(model.A, [[0.0]], atol=1e-9)  # ẋ = u
    np.testing.assert_allclose(model.C @ model.B, [[1.0]], rtol=1e-9)


class Emptying(Block):
    """A tank: ẋ = −u, with the root of what is left in it, which an empty one does not have."""

    u = Input(unit="m3/s")
    x = State(start=0.25, unit="m3", output=True)
    root = Output(unit="1")

    def derivative(self, t, x, u):
        return -u.u

    def output(self, t, x, u):
        return np.sqrt(x.x)


@pytest.mark.parametrize("lanes", [True, False])
@pytest.mark.slow
def test_an_fmu_that_was_built_here_refuses_it_itself_in_lanes_too(cache, lanes):
    plant = Fmu(build(Emptying()), name="plant")

    @subsystem(sample_time=H)
    def pump(x):
        return Gain(name="k", gain=1.0)(UnitDelay(name="last")(x)) * 0.0 + Constant(value=0.1, name="rate")

    diagram = Diagram("d", plant(u=pump(plant.x)))
    values = np.linspace(0.1, 2.0, 8)
    found = diagram.sweep(
        {"pump.rate.value": values}, END, signals=["plant.x", "plant.root"], progress=False, lanes=lanes
    )
    fails = values * END > 0.25
    assert [failure.index for failure in found.failures] == np.flatnonzero(fails).tolist()
    for i in np.flatnonzero(~fails):
        np.testing.assert_allclose(found["plant.root"][i], np.sqrt(0.25 - values[i] * found.t), rtol=0, atol=1e-7)
