"""Diagrams with FMUs of our own inside leave as one FMU: the C of the FMUs is merged, an instance of it in each memory.

Oracles: the matrix exponential for a motor with a sampled controller, and runs of the diagrams with the FMUs themselves.
"""

import zipfile

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from scipy.linalg import expm

from loopwright import Fmu, build
from loopwright.blocks import Constant, DefinitionError, Gain, Step, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import StepOptions, bouncing_ball, dc_motor
from loopwright.fmus.export import compiler
from loopwright.fmus.toolchain import flags
from support import exported_diagrams
from support.ecos import load_ecospy
from support.instances import open_instance

T = 1e-3
FMI = (2, 3)


@subsystem(sample_time=T)
def speed_loop(wanted, speed):
    """PI of the speed, which lets no voltage through before it has acted."""
    error = wanted - speed
    before = UnitDelay(initial_value=0.0, name="total")
    total = before.y + error
    before(total)
    return (Gain(gain=0.02, name="kp")(error) + Gain(gain=8e-4, name="ki")(total)).named("voltage")


def drive(model=dc_motor.nominal, **options):
    motor = Fmu(dc_motor.build(model, **options), name="motor")
    wanted = Step(times=0.01, values=100.0, unit="rad/s", name="wanted")
    voltage = speed_loop(wanted, motor.speed.named("speed"))
    return Diagram("drive", motor(voltage=voltage, load_torque=Constant(value=0.0, name="load")))


def exact(ticks, changed_at=None, motor=dc_motor.nominal):
    """Return the speed at ticks, by the exponential of the motor's matrix: its resistance doubles at a tick."""
    x, total, found = np.zeros(2), 0.0, []
    for k in range(ticks):
        R = motor.resistance * (2.0 if changed_at is not None and k >= changed_at else 1.0)
        L, K, J, b = motor.inductance, motor.motor_constant, motor.inertia, motor.friction
        A = np.array([[-R / L, -K / L, 1 / L], [K / J, -b / J, 0.0], [0.0, 0.0, 0.0]])
        found.append(x[1])
        error = (100.0 if k >= 10 else 0.0) - x[1]
        total += error
        x = (expm(A * T) @ [*x, 0.02 * error + 8e-4 * total])[:2]
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_a_motor_with_its_controller_is_one_fmu(fmi, tmp_path):
    """The exponential to the error of the motor's Runge-Kutta method, and the run itself in every bit."""
    diagram = drive()
    run = diagram.simulate(0.3, progress=False)
    item = open_instance(build(diagram, fmi=fmi), tmp_path).initialize()
    speeds = []
    for k in range(300):
        assert item["speed"] == run["speed"][k]
        speeds.append(item["speed"])
        item.step(run.t[k], T)
        assert item["speed_loop.voltage"] == run["voltage"][k]
    np.testing.assert_allclose(speeds, exact(300), rtol=0, atol=1e-5)
    assert max(speeds) > 90.0
    item.free()


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_instances_are_independent_and_states_move_between_them(fmi, tmp_path):
    file = build(drive(), fmi=fmi)
    one = open_instance(file, tmp_path / "one").initialize()
    other = open_instance(file, tmp_path / "two").initialize(**{"motor.resistance": 2.4})
    speeds = {one: [], other: []}
    for k in range(100):
        for item in (one, other):
            item.step(k * T, T)
            speeds[item].append(item["speed"])
    assert abs(speeds[one][50] - speeds[other][50]) > 1.0
    state = one.fmu.getFMUState()
    seen = []
    for _ in range(2):
        for k in range(100, 200):
            one.step(k * T, T)
        seen.append(one["speed"])
        one.fmu.setFMUState(state)
    assert seen[0] == seen[1]
    data = one.fmu.serializeFMUState(state)
    one.fmu.freeFMUState(state)
    one.copied_to(other)
    again = other.fmu.getFMUState()
    assert other.fmu.serializeFMUState(again) == data  # no address is in it
    other.fmu.freeFMUState(again)
    for k in range(100, 200):
        other.step(k * T, T)
    assert other["speed"] == seen[0]
    one.fmu.reset()
    one.begin()
    for k in range(100):
        one.step(k * T, T)
        assert one["speed"] == speeds[one][k]
    one.free()
    other.free()


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_a_parameter_of_the_plant_is_tuned_between_steps(fmi, tmp_path):
    item = open_instance(build(drive(), fmi=fmi), tmp_path).initialize()
    speeds = []
    for k in range(200):
        speeds.append(item["speed"])
        item.step(k * T, T, **({"motor.resistance": 2.4} if k == 40 else {}))
    np.testing.assert_allclose(speeds, exact(200, 40), rtol=0, atol=1e-5)
    assert np.abs(exact(200, 40) - exact(200)).max() > 1.0
    item.free()


@pytest.mark.slow
def test_steps_of_any_length_agree(tmp_path):
    """The motor steps at the ticks of its controller, wherever communication points are; between them it is held."""
    file = build(drive(), outputs=["speed", "motor.angle"])
    ticks = open_instance(file, tmp_path / "one").initialize()
    other = open_instance(file, tmp_path / "two").initialize()
    t = 0.0
    for h in (0.0025, 0.00031, 0.00019, 0.02, 0.007, 0.1):
        other.step(t, h)
        t += h
        while ticks["time"] + T <= t + 1e-9:
            ticks.step(ticks["time"], T)
        for name in ("speed", "motor.angle"):
            assert other[name] == ticks[name]
    assert ticks["speed"] > 50.0
    ticks.free()
    other.free()


@pytest.mark.slow
def test_a_start_between_two_ticks(tmp_path):
    """From t = 0.5 ms on, by steps of 1 ms, and of half as much: the first step of the motor is a short one."""
    file = build(drive())
    items = [open_instance(file, tmp_path / f"{n}", start_time=0.0005).initialize() for n in range(2)]
    for k in range(200):
        items[0].step(0.0005 + k * T, T)
        for i in range(2):
            items[1].step(0.0005 + k * T + i * T / 2, T / 2)
        assert items[0]["speed"] == items[1]["speed"]
    np.testing.assert_allclose(items[0]["speed"], exact(201)[-1], rtol=0, atol=1e-5)
    for item in items:
        item.free()


def rates():
    return exported_diagrams.mass_at_two_rates(), 0.3, ("force", "v")


def two_in_a_row():
    """A motor whose torque loads another one at once, without a block between them, and a lag in continuous time."""
    first, second = (Fmu(dc_motor.build(), name=name) for name in ("first", "second"))
    wired = (
        first(voltage=speed_loop(Constant(value=20.0, unit="rad/s"), second.speed), load_torque=Constant(value=0.0)),
        second(voltage=Constant(value=2.0), load_torque=first.torque),
    )
    lag = TransferFunction(numerator=[1.0], denominator=[0.05, 1.0], name="lag")
    return Diagram("row", *wired, lag(second.current).named("late")), 0.2, ("voltage", "late")


def ball():
    """An FMU that finds its own events."""

    @subsystem(sample_time=0.01)
    def look(height):
        return Gain(gain=2.0)(height).named("twice")

    ball = Fmu(bouncing_ball.build(), name="ball")
    return Diagram("ball", look(ball.height)), 3.0, ("twice",)


def implicit():
    """A plant with the implicit integrator, whose matrix is in the memory."""
    return drive(integrator="rodas"), 0.1, ("voltage",)


@pytest.mark.slow
@pytest.mark.parametrize("make", [rates, two_in_a_row, ball, implicit], ids=lambda make: make.__name__)
def test_it_has_the_numbers_of_the_run(make, tmp_path):
    diagram, duration, names = make()
    run = diagram.simulate(duration, progress=False)
    item = open_instance(build(diagram, tmp_path, outputs=names), tmp_path / "item").initialize()
    found = [[item[name] for name in names]]
    for k in range(1, len(run.t)):
        item.step(run.t[k - 1], run.t[k] - run.t[k - 1])
        found.append([item[name] for name in names])
    for i, name in enumerate(names):
        shift = 0 if name == "late" else 1  # a tick acts with the step after it
        values = np.array(found)[shift:, i]
        np.testing.assert_allclose(values, run[name][: len(values)], rtol=0, atol=1e-9 * np.ptp(run[name]))
        assert np.ptp(run[name]) > 1e-3
    item.free()


@pytest.mark.slow
def test_what_a_plant_says_is_passed_on(tmp_path):
    """A step that is coarse for the motor is a warning of it; a current that has no bound an error, at its time."""
    file = build(drive(internal_step=4e-4))
    item = open_instance(file, tmp_path / "one").initialize(**{"motor.inductance": 2e-4})
    assert [status for status, *_ in item.log] == [1]
    assert "motor: internal_step = 0.0004 s is coarse beside the fastest mode" in item.log[0][2]
    item.free()
    item = open_instance(file, tmp_path / "two").initialize(**{"motor.inductance": 1e-9})
    item.step(0.0, 10 * T)
    with pytest.raises(FMICallException):
        item.step(10 * T, 100 * T)
    assert "motor: " in item.log[-1][2]
    assert "expected a finite number" in item.log[-1][2]
    item.free()


@pytest.mark.slow
def test_parameters_of_plants_are_described(tmp_path):
    found = {v.name: v for v in open_instance(build(drive()), tmp_path).description.modelVariables}
    one = found["motor.resistance"]
    assert (one.unit, one.variability, one.start, one.min) == ("Ohm", "tunable", "1.2", found["motor.inductance"].min)
    assert "motor.internal_step" in found
    assert "motor.integrator" not in found


@pytest.mark.slow
@pytest.mark.parametrize(("make", "fmi"), [(drive, 3), (exported_diagrams.continuous, 2)])
def test_it_is_compiled_for_other_platforms_without_a_warning(make, fmi, monkeypatch):
    """Warnings are errors here; folders are those of the version's platforms."""
    monkeypatch.setattr(compiler, "flags", lambda *platform, zig: (*flags(*platform, zig=zig), "-Werror"))
    names = ("aarch64-linux", "x86_64-darwin", "aarch64-darwin")
    with zipfile.ZipFile(build(make(), fmi=fmi, platform=names, name="cross_compiled")) as archive:
        found = {n.split("/")[1]: n.rpartition(".")[2] for n in archive.namelist() if n.startswith("binaries/")}
    darwin = "x86_64-darwin" if fmi == 3 else "darwin64"
    assert found == {"aarch64-linux": "so", "aarch64-darwin": "dylib", darwin: "dylib"}


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_ecos_has_the_same_numbers(fmi):
    """Without clocks: ecos 0.7.2 frees memory twice where it closes any FMU that has some."""
    ecospy = load_ecospy()
    file, rows = build(drive(), fmi=fmi, clocks=False), []
    with ecospy.EcosSimulationStructure() as structure:
        structure.add_model("drive", str(file))
        structure.add_parameter_set("given", {})
        with ecospy.EcosSimulation(structure=structure, step_size=T) as simulation:
            assert simulation.init(parameter_set="given"), ecospy.EcosLib.get_last_error()
            for _ in range(200):
                simulation.step()
                rows.append(simulation.get_real("drive::speed"))
            simulation.terminate()
    np.testing.assert_allclose(rows, exact(201)[1:], rtol=0, atol=1e-5)


# --- what is refused, before anything is compiled ------------------------------------------------------------------------


@pytest.fixture
def uncompiled(monkeypatch):
    file = dc_motor.build()

    def refuse(*arguments, **options):
        raise AssertionError("compiled")

    monkeypatch.setattr("loopwright.fmus.export.fmu_package._archive", refuse)
    return file


def refused(motor):
    voltage = speed_loop(Constant(value=1.0, unit="rad/s"), motor.speed)
    with pytest.raises(DefinitionError) as caught:
        build(Diagram("drive", motor(voltage=voltage, load_torque=Constant(value=0.0))))
    assert caught.value.block == "motor"
    assert "outside=['motor']" in str(caught.value)
    assert "to_ssp" in str(caught.value)
    return str(caught.value)


def test_an_fmu_of_others_is_refused(uncompiled, monkeypatch):
    monkeypatch.setattr("loopwright.diagrams.exporting.plants_to_merge.read_own_sources", lambda path: None)
    assert "dc_motor.fmu, an FMU that this version of Loopwright has not built" in refused(
        Fmu(uncompiled, name="motor")
    )


def test_model_exchange_inside_is_refused(uncompiled):
    text = refused(Fmu(uncompiled, name="motor", interface="model_exchange"))
    assert "interface='co_simulation'" in text


def test_options_of_the_stepping_are_refused(uncompiled):
    assert "Leave stepping out" in refused(Fmu(uncompiled, name="motor", stepping=StepOptions(communication_step=0.01)))


@pytest.mark.slow
def test_an_fmu_of_a_diagram_is_refused():
    """It has clocks and events of its own; its diagram is put in its place."""
    inner = Fmu(build(speed_loop), name="inner")
    motor = Fmu(dc_motor.build(), name="motor")
    whole = Diagram("drive", motor(voltage=inner(wanted=0.0, speed=motor.speed), load_torque=Constant(value=0.0)))
    with pytest.raises(DefinitionError, match="put its blocks into this diagram") as caught:
        build(whole)
    assert caught.value.block == "inner"
