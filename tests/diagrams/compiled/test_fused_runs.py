"""Fused runs: ticks and plants in one unit, for this machine's processor. Their bound is stated, and their words remain."""

import shutil

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Clock, Gain, Sine, TransferFunction
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.compiled.generated_text import reorder
from loopwright.fmus import Fmu, FmuError, FmuRuntimeError, dc_motor, gantry_contact

QUIET = {"progress": False}
BOUND = 1e-10  # of each signal's size where the motion doesn't magnify rounding, as benchmarks/README.md states


def differ(first, second):
    size = np.maximum(1e-3, np.abs(first.data).max(axis=0))
    return float((np.abs(first.data - second.data) / size).max())


def inside(run):
    return [m.split()[4] for m in run.messages if "are in the loop" in m]


@pytest.mark.parametrize("letter", ["C", *(pytest.param(x, marks=pytest.mark.slow) for x in "ABD")])
def test_experiments_stay_within_the_stated_bound(letter):
    diagram = experiments.EXPERIMENTS[letter]().diagram
    plain, fused = diagram.simulate(2.0, compile=True, **QUIET), diagram.simulate(2.0, fuse=True, **QUIET)
    assert inside(fused) == ["plant"]
    assert fused.tier == "compiled"
    assert 0.0 < differ(plain, fused) < BOUND
    assert any("values differ by rounding, which some motions magnify" in message for message in fused.messages)


def motor(name, every=1e-3, start=None, **options):
    """A motor under a step of voltage, which is held from tick to tick."""

    @subsystem(sample_time=every, name=f"box_{name}")
    def box(speed):
        return 6.0 + Gain(gain=0.0, name="none")(speed)

    plant = Fmu(dc_motor.build(**options), start=start or {}, name=name)
    return plant(voltage=box(plant.speed), load_torque=0.0).speed


@pytest.mark.slow
def test_several_plants_stand_in_one_unit_and_keep_their_names_apart():
    made = Diagram("motors", motor("a"), motor("b"), motor("c", fmi=2))
    plain, fused = made.simulate(0.05, compile=True, **QUIET), made.simulate(0.05, fuse=True, **QUIET)
    assert inside(fused) == ["a", "b", "c"]
    assert differ(plain, fused) < BOUND
    R, L, K, J, b = 1.2, 2e-3, 0.05, 2e-5, 1e-5
    A = np.array([[-R / L, -K / L, 6.0 / L], [K / J, -b / J, 0.0], [0.0, 0.0, 0.0]])
    for k in (1, 10, 50):
        exact = (expm(A * k * 1e-3) @ [0.0, 0.0, 1.0])[1]
        for name in "abc":  # Runge-Kutta's steps of 0.1 ms: 1e-3 · (600 · 1e-4)^4
            assert fused[f"{name}.speed"][k] == pytest.approx(exact, rel=2e-7)


def test_a_fused_run_goes_on_branches_and_is_saved():
    made = experiments.hand_guiding().diagram
    whole = made.simulate(0.6, fuse=True, **QUIET)
    with made.simulation(fuse=True) as simulation:
        simulation.advance(0.3)
        half = simulation.save()
        simulation.advance(0.3)
        assert simulation.run().data.tobytes() == whole.data.tobytes()
        simulation.restore(half)
        simulation.advance(0.3)
        assert simulation.run().data[-1].tobytes() == whole.data[-1].tobytes()


@pytest.mark.parametrize("fuse", [True, False])
@pytest.mark.drawn(1)
def test_a_state_of_the_other_kind_of_run_is_refused_and_fuse_is_named(fuse):
    made = experiments.hand_guiding().diagram
    first = made.simulate(0.01, fuse=fuse, **QUIET)
    assert made.simulate(0.01, fuse=fuse, start=first.final_state, **QUIET).t[-1] == pytest.approx(0.02)
    with pytest.raises(FmuError, match=r"^plant: .*Run the FMU that was saved, with the fuse= of that run\.$"):
        made.simulate(0.01, fuse=not fuse, start=first.final_state, **QUIET)


def test_an_error_within_the_loop_has_the_words_of_the_fmu():
    made = Diagram("motor", motor("plant", every=1.0, start={"internal_step": 1.0}))  # unstable: 5e9 times a step
    errors = []
    for options in ({"compile": False}, {"compile": True}, {"fuse": True}):
        with pytest.raises(FmuRuntimeError, match="became") as caught:
            made.simulate(100.0, **QUIET, **options)
        errors.append(str(caught.value))
    assert errors[0] == errors[1] == errors[2]


def test_a_sine_of_a_large_angle_is_that_of_an_unfused_tick():
    @subsystem(sample_time=1e-3, name="box")
    def box(time):
        return Sine(frequency=1.0, name="sine")() + 0.0 * time

    slow = Diagram("slow", box(Clock()))
    for frequency in (1.0, 2.0**22):  # below the limit of the short functions, and soon beyond it
        fused = slow.replace({"box.sine.frequency": frequency}).simulate(0.5, fuse=True, **QUIET)
        exact = np.sin(2.0 * np.pi * frequency * fused.t)
        assert np.abs(fused["box.sine.y"] - exact).max() < 4e-16 * (1.0 + 2.0 * np.pi * frequency)


@pytest.mark.slow
def test_an_fmu_with_events_keeps_its_own_step():
    fmu = Fmu(gantry_contact.build(), name="plant")
    made = experiments.hand_guiding(plant=fmu).diagram
    plain, fused = made.simulate(0.05, compile=True, **QUIET), made.simulate(0.05, fuse=True, **QUIET)
    assert inside(fused) == []
    assert differ(plain, fused) < BOUND


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"ports": ("voltage", "load_torque", "speed", "der(speed)")}, {"start": {"integrator": 2}}]
)
def test_an_fmu_with_derivatives_as_ports_or_another_integrator_keeps_its_own_step(options):
    @subsystem(sample_time=1e-3, name="box")
    def box(speed):
        return 6.0 - Gain(gain=0.01, name="gain")(speed)

    plant = Fmu(dc_motor.build(), name="plant", **options)
    made = Diagram("motor", plant(voltage=box(plant.speed), load_torque=0.0).speed)
    plain, fused = made.simulate(0.05, compile=True, **QUIET), made.simulate(0.05, fuse=True, **QUIET)
    assert inside(fused) == []
    assert fused.tier == "compiled"
    assert differ(plain, fused) < BOUND


@pytest.mark.parametrize("solver", ["rk4", "RK45"])
def test_continuous_states_stay_within_the_bound_and_as_near_to_the_exact_ones(solver):
    @subsystem(sample_time=0.01, name="controller")
    def controller(y):
        return 2.0 * (1.0 - y)

    lag = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="lag")
    made = Diagram("loop", lag(controller(lag.y)))
    options = {"solver": solver, "rtol": 1e-10, "atol": 1e-12, **QUIET}
    plain, fused = made.simulate(1.0, compile=True, **options), made.simulate(1.0, fuse=True, **options)
    assert differ(plain, fused) < BOUND
    assert any(
        "rates are compiled for this processor; values differ by rounding, which some motions magnify." in m
        for m in fused.messages
    )
    y, decay = 0.0, np.exp(-0.2)
    for value in fused["lag.y"]:
        assert value == pytest.approx(y, abs=1e-5 if solver == "rk4" else 1e-9)  # rk4: (0.2)^5/120 of a step
        y = decay * y + (1.0 - decay) * 2.0 * (1.0 - y)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_gcc_fuses_too(monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CC", "gcc")
    diagram = experiments.hand_guiding().diagram
    plain, fused = diagram.simulate(0.5, compile=False, **QUIET), diagram.simulate(0.5, fuse=True, **QUIET)
    assert inside(fused) == ["plant"]
    assert differ(plain, fused) < BOUND


def test_compile_false_asks_for_no_loop_in_c():
    run = experiments.hand_guiding().diagram.simulate(0.01, fuse=True, compile=False, **QUIET)
    assert run.tier == "interpreted"
    assert inside(run) == []


def test_only_plain_assignments_are_reordered():
    text = (
        "static int casadi_f0(const casadi_real** arg, int m) {\n  casadi_real a0;\n%s  res[0][0]=a0;\n  return 0;\n}"
    )
    made = reorder(text % "  a0=arg[0][0];\n  a0=sin(a0);\n", "fast", "7.0")
    assert "v1=sin(v0)" in made
    assert "if (!(fabs(v0) < 7.0)) return 1;" in made
    assert reorder(text % "  for (;;) a0=1;\n", "fast", "7.0") is None
