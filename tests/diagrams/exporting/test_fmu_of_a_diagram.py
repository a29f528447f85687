"""What an FMU of a diagram does: its start, saved states, parameters that are tuned, steps that don't fit, errors."""

import time
import zipfile

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from loopwright import build, experiments
from loopwright.blocks import (
    PID,
    PT1,
    Constant,
    DiscreteStateSpace,
    Gain,
    ParameterError,
    Power,
    Sine,
    StateSpace,
    Step,
    Sum,
    TransferFunction,
    UnitDelay,
    UnknownNameError,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus.checks import validate
from support import exported_diagrams
from support.instances import open_instance

pytestmark = pytest.mark.slow
FMI = (2, 3)


@subsystem(sample_time=0.01)
def controller(reference, level):
    """PI with a filtered derivative."""
    return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")


@pytest.mark.parametrize("fmi", FMI)
def test_the_start_is_computed_from_the_inputs_that_are_set(fmi, tmp_path):
    """The derivative's filter begins with the level, so that D = 0: u = 2 · (1 − 0.3)."""
    item = open_instance(build(controller, fmi=fmi), tmp_path).initialize(reference=1.0, level=0.3)
    assert item["effort"] == pytest.approx(1.4, rel=1e-15)
    assert item["pid.filtered"] == -0.3
    item.step(0.0, 0.01)
    assert item["effort"] == pytest.approx(1.4, rel=1e-15)
    item.free()


def test_held_outputs_begin_with_what_is_computed_from_the_inputs(tmp_path):
    """A slow subsystem's output is held from the start on, though it acts later, by its offset."""

    @subsystem(sample_time=0.01)
    def both(u):
        slow = subsystem(sample_time=0.02, offset=0.01, name="slow")(lambda v: Gain(gain=10.0)(v))
        return Sum(signs="++")(slow(u), u).named("y")

    item = open_instance(build(both), tmp_path).initialize(u=0.5)
    assert item["y"] == 5.5
    item.step(0.0, 0.01, u=1.0)
    assert item["y"] == 6.0
    item.step(0.01, 0.01, u=2.0)
    assert item["y"] == 22.0
    item.free()


@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize("make", [exported_diagrams.sampled, exported_diagrams.continuous])
def test_a_run_continues_from_a_saved_state_elsewhere_bit_for_bit(fmi, make, tmp_path):
    file = build(make(), fmi=fmi)
    name = "outer.inner_wanted" if make is exported_diagrams.sampled else "warmth"
    one = open_instance(file, tmp_path / "one").initialize()
    other = open_instance(file, tmp_path / "two").initialize()
    for k in range(100):
        one.step(0.013 * k, 0.013)
    state = one.fmu.getFMUState()
    assert one.fmu.serializeFMUState(state) == one.fmu.serializeFMUState(state)
    one.fmu.freeFMUState(state)
    one.copied_to(other)
    seen = []
    for k in range(100, 300):
        for item in (one, other):
            item.step(0.013 * k, 0.013)
        assert one[name] == other[name]
        seen.append(one[name])
    assert np.ptp(seen) > 0.1
    one.fmu.reset()
    one.begin()
    for k in range(300):
        one.step(0.013 * k, 0.013)
    assert one[name] == other[name]
    one.free()
    other.free()


@pytest.mark.parametrize("fmi", FMI)
def test_a_parameter_is_tuned_between_two_steps(fmi, tmp_path):
    """u = kp e + ki T Σ e; ki changes after ten ticks, and what was integrated stays."""
    item = open_instance(build(exported_diagrams.controller, fmi=fmi), tmp_path).initialize(wanted=1.0)
    for k in range(10):
        item.step(0.01 * k, 0.01)
    item.step(0.1, 0.01, **{"pid.ki": 6.0})
    assert item["effort"] == pytest.approx(2.0 + 3.0 * 0.01 * 10, rel=1e-14)
    item.step(0.11, 0.01)
    assert item["effort"] == pytest.approx(2.0 + 3.0 * 0.01 * 10 + 6.0 * 0.01, rel=1e-14)
    item.free()


def test_a_filter_is_computed_again_where_its_time_constant_is_tuned(tmp_path):
    """The exact discretization of D = kd ẋ_f with T_f: after a step of the level by 1, x_f moves by 1 − exp(−T/T_f)."""
    item = open_instance(build(controller), tmp_path).initialize(**{"pid.filter_time": 0.05})
    item.step(0.0, 0.01, level=1.0)
    item.step(0.01, 0.01)
    assert item["pid.filtered"] == pytest.approx(-(1.0 - np.exp(-2 * 0.01 / 0.05)), rel=1e-13)
    item.free()


@pytest.mark.parametrize("fmi", FMI)
def test_steps_from_tick_to_tick_are_asked_for(fmi, tmp_path):
    item = open_instance(build(exported_diagrams.controller, fmi=fmi, communication="ticks"), tmp_path).initialize()
    item.step(0.0, 0.03)
    with pytest.raises(FMICallException):
        item.step(0.03, 0.005)
    assert "doesn't fit" in item.log[-1][2]
    assert "every 0.01 s" in item.log[-1][2]
    item.free()


@pytest.mark.parametrize("fmi", FMI)
def test_a_guard_that_fails_names_its_block(fmi, tmp_path):
    diagram = experiments.compliance().diagram
    item = open_instance(build(diagram, subsystem="controller", fmi=fmi), tmp_path).initialize()
    item.step(0.0, 1e-3)
    with pytest.raises(FMICallException):
        item.step(1e-3, 1e-3, position=np.array([0.5, 0.5]))  # the ellipse's centre
    assert "path_projection." in item.log[-1][2]
    assert "this guard is not positive" in item.log[-1][2]
    assert "Start nearer to the path, or limit the force that drives the position off it." in item.log[-1][2]
    assert "path_projection.foot" in item.description.description
    item.free()


def test_the_first_block_with_a_value_that_is_no_number_is_named(tmp_path):
    @subsystem(sample_time=0.01)
    def root(u):
        below = Power(exponent=-1.0, name="inverse")(u)
        return Gain(gain=2.0)(below).named("y")

    diagram = Diagram("whole", root(Constant(value=1.0)))
    item = open_instance(build(diagram, subsystem="root"), tmp_path).initialize()
    item.step(0.0, 0.01)
    assert item["y"] == 2.0
    with pytest.raises(FMICallException):
        item.step(0.01, 0.01, u=0.0)
    assert "inverse.y at t = 0.01 s: found inf" in item.log[-1][2]
    item.free()


def test_ticks_and_steps_of_any_length_agree(tmp_path):
    """Ticks lie where they are on the clocks: long steps and short ones that don't fit give the same outputs."""

    @subsystem(sample_time=0.01)
    def count(u):
        total, before = Sum(signs="++"), UnitDelay(initial_value=0.0)
        made = total(u, before.y)
        before(made)
        return made.named("number")

    item = open_instance(build(count), tmp_path).initialize(u=1.0)
    t = 0.0
    for h in (0.025, 0.0031, 0.0019, 0.07, 0.1):
        item.step(t, h)
        t += h
        assert item["number"] == np.floor((t - 1e-9) / 0.01) + 1
    item.free()


@pytest.mark.slow
def test_zeros_can_be_set_where_nothing_else_depends_on_them(tmp_path):
    """A sine's phase and bias are 0; D = 0 of a state space would be a new wire, and is none."""

    @subsystem(sample_time=0.01)
    def both(u):
        made = DiscreteStateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]], name="space")(u)
        return Sum(signs="++")(made, Sine(frequency=1.0, name="wave")).named("y")

    item = open_instance(build(both), tmp_path).initialize(**{"wave.bias": 2.0, "wave.phase": np.pi / 2})
    item.step(0.0, 0.01)
    assert item["y"] == pytest.approx(3.0, rel=1e-15)
    item.step(0.01, 0.01, **{"wave.bias": -1.0})
    assert item["y"] == pytest.approx(np.cos(2 * np.pi * 0.01) - 1.0, rel=1e-14)
    assert "space.D" not in {v.name for v in item.description.modelVariables}
    item.free()


@pytest.mark.slow
def test_inputs_start_where_they_are_to(tmp_path):
    """By start=, by the default of an argument, else at 0; states begin with them: the filter of D with the level."""

    @subsystem(sample_time=0.01)
    def own(reference=2.0, level=0.0):
        return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")

    item = open_instance(build(own, start={"level": 0.5}), tmp_path).initialize()
    starts = {v.name: v.start for v in item.description.modelVariables}
    assert (starts["reference"], starts["level"]) == ("2.0", "0.5")
    assert item["effort"] == 3.0
    assert item["pid.filtered"] == -0.5
    item.free()


def test_starts_that_no_input_has_are_refused():
    with pytest.raises(UnknownNameError, match=r"no input 'levle' in it\. Did you mean 'level'"):
        build(controller, start={"levle": 1.0})
    with pytest.raises(ParameterError, match=r"found \[1\.0, 2\.0\] for the start of 'level'; expected finite numbers"):
        build(controller, start={"level": [1.0, 2.0]})


def lag(tau):
    """A lag of a second behind one of tau."""
    fast = TransferFunction(numerator=[1.0], denominator=[tau, 1.0], name="fast")(Step(times=0.5, values=1.0))
    return Diagram("lags", TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="slow")(fast).named("y"))


@pytest.mark.slow
def test_a_stiff_diagram_gets_an_implicit_method(tmp_path):
    """Time constants of 1 s and 1e-7 s, at steps of 10 ms: the explicit method would take 30,000 steps in each."""
    file = build(lag(1e-7), step_size=0.01, tolerance=1e-8)
    item = open_instance(file, tmp_path).initialize()
    began = time.process_time()
    for k in range(200):
        item.step(0.01 * k, 0.01)
        t = 0.01 * (k + 1)
        assert item["y"] == pytest.approx(max(0.0, 1.0 - np.exp(-(t - 0.5))), rel=0, abs=2e-7)
    assert time.process_time() - began < 2.0  # 0.02 s; 15 s by the explicit method
    item.free()


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_names_have_letters_of_all_alphabets(fmi, tmp_path):
    """They are flat names then, which may have them; both ways of checking find nothing."""

    @subsystem(sample_time=0.5)
    def box(φ):
        return Gain(gain=2.0, name="κ")(φ).named("θ")

    file = build(box, tmp_path / "greek.fmu", fmi=fmi)
    assert validate_fmu(str(file)) == []
    assert not validate(file).problems
    item = open_instance(file, tmp_path / "item").initialize(φ=1.5)
    assert item.description.variableNamingConvention == "flat"
    item.step(0.0, 0.5, **{"κ.gain": 4.0})
    assert item["θ"] == 6.0
    item.free()


def test_a_diagram_without_names_puts_out_what_nothing_reads(tmp_path):
    """It had no output at all; y = 3 (1 − exp(−t/2))."""
    lag = TransferFunction(numerator=[1.0], denominator=[2.0, 1.0], name="lag")
    diagram = Diagram("plain", Gain(gain=3.0, name="thrice")(lag(Constant(value=1.0, name="one"))))
    item = open_instance(build(diagram, tolerance=1e-9), tmp_path).initialize()
    assert item["thrice.y"] == 0.0
    item.step(0.0, 1.0)
    assert item["thrice.y"] == pytest.approx(3.0 * (1.0 - np.exp(-0.5)), rel=1e-7)
    item.free()


def test_states_between_ticks_have_the_bits_of_the_run(tmp_path):
    """Steps of variable length have the tolerances of a run without more, the absolute one, too."""
    plant = StateSpace(A=[[-600.0, -25.0], [2500.0, -0.5]], B=[500.0, 0.0], C=[0.0, 1.0], name="plant")

    @subsystem(sample_time=0.01)
    def law(y):
        return PID(kp=0.05, ki=2.0)(Step(times=0.02, values=300.0, name="wish"), y)

    diagram = Diagram("loop", plant(law(plant.y)).named("y"))
    run = diagram.simulate(0.2, progress=False)
    item = open_instance(build(diagram), tmp_path).initialize()
    for k in range(20):
        item.step(float(run.t[k]), 0.01)
        assert item["y"] == run["y"][k + 1]
    assert item["y"] > 200.0
    item.free()


@pytest.mark.parametrize("fmi", FMI)
def test_a_state_that_is_an_output_is_two_variables(fmi, tmp_path):
    """Two variables of one name make no FMU: the state has a word more, and starts the run, y = 1 − (1 − y₀) e⁻ᵗ."""
    lag = PT1(time_constant=1.0, name="lag")
    file = build(Diagram("plain", lag(Constant(value=1.0, name="one"))), tmp_path / "lag.fmu", fmi=fmi, tolerance=1e-9)
    assert validate_fmu(str(file)) == []
    assert not validate(file).problems
    item = open_instance(file, tmp_path / "item").initialize(**{"lag.y_state": 0.25})
    assert item["lag.y"] == 0.25
    item.step(0.0, 1.0)
    assert item["lag.y"] == item["lag.y_state"] == pytest.approx(1.0 - 0.75 * np.exp(-1.0), rel=1e-7)
    item.free()


def test_one_diagram_is_one_text(uncompiled, tmp_path):
    """Arrays of a run are anywhere in memory; the order of members, and so the file's token, doesn't follow from that."""
    texts, held = set(), []
    for i in range(6):
        held.append([np.ones(size) for size in np.random.default_rng(i).integers(1, 400, 300)])
        del held[-1][:: i + 2]  # holes for the next arrays
        with zipfile.ZipFile(build(controller, tmp_path / f"{i}.fmu")) as archive:
            texts.add(archive.read("sources/model.c") + archive.read("modelDescription.xml"))
    assert len(texts) == 1
