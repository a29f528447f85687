"""compile="auto": generated code takes over in runs that take long, with the same bits whenever that is."""

from dataclasses import fields
from itertools import count
from unittest import mock

import numpy as np
import pytest

from loopwright.blocks import (
    Compare,
    Gain,
    Lookup1D,
    OptionError,
    Product,
    SimulationError,
    Sine,
    StopCondition,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Run, subsystem
from loopwright.diagrams.compiled import background, compiled_libraries, expanded_functions
from loopwright.diagrams.simulation import RunOptions, change_over, sampled_ticks
from loopwright.fmus import Fmu, dc_motor
from support.both_forms import assert_same_bits

pytestmark = pytest.mark.one_tier

QUIET = {"progress": False}


class AtOnce:
    """A thread that ends before it has begun."""

    def __init__(self, target, args, **_):
        self.start = lambda: target(*args)

    def join(self):
        pass


@pytest.fixture
def eager(monkeypatch):
    """Code is made at the first look, for every run; counts how often it takes over."""
    monkeypatch.setattr(change_over, "_PATIENCE", -1.0)
    for name in ("_WRITING", "_COMPILING"):
        monkeypatch.setattr(background, name, 0.0)
    monkeypatch.setattr(background, "_LEAST", -1.0)
    monkeypatch.setattr(background, "Thread", AtOnce)
    monkeypatch.setattr(change_over, "_REPORTED", [])
    begun, hand_over = [], sampled_ticks.SampledTicks.hand_over

    def watched(self, code):
        begun.append(True)
        return hand_over(self, code)

    monkeypatch.setattr(sampled_ticks.SampledTicks, "hand_over", watched)
    return begun


@pytest.fixture
def no_compiler(monkeypatch):
    """Whoever starts a compiler fails."""
    compiled_libraries.load_compiled.cache_clear()
    monkeypatch.setenv("LOOPWRIGHT_CC", "no-such-compiler")


def sums(block=None, every=0.01):
    """A running sum of a sine, and its square."""

    @subsystem(sample_time=every, name="box")
    def box(u):
        before = UnitDelay(initial_value=0.0, name="sum")
        total = u + before.y
        before(total)
        return (block or Gain(gain=1.0, name="g"))(Product(name="square")(total, total))

    return Diagram("d", box(Sine(frequency=0.7, name="source")).named("y"))


def test_code_takes_over_within_a_run_and_the_bits_are_the_same(eager):
    run = sums().simulate(40.0, compile="auto", **QUIET)
    assert len(eager) == 1
    assert run.messages == ()
    assert run.tier == "both"
    assert_same_bits(sums().simulate(40.0, compile=False, **QUIET), run)
    assert np.array_equal(run["y"], np.cumsum(run["source.y"]) ** 2)


def test_a_run_with_an_fmu_goes_on_in_c_and_is_saved_on_both_sides(eager):
    @subsystem(sample_time=1e-3, name="controller")
    def controller(speed):
        return 0.05 * (10.0 - speed)

    plant = Fmu(dc_motor.build(), name="plant")
    made = Diagram("loop", plant(voltage=controller(plant.speed), load_torque=0.02))
    whole = made.simulate(3.0, compile=False, **QUIET)
    with made.simulation(compile="auto") as simulation:
        simulation.advance(0.5)
        early = simulation.save()
        simulation.advance(1.5)
        late = simulation.save()
        simulation.advance(1.0)
        assert_same_bits(whole, simulation.run())
    assert len(eager) == 1
    for state in (early, late):
        again = made.simulate(3.0 - state.t, start=state, compile=False, **QUIET)
        assert again.data.tobytes() == whole.data[round(state.t * 1000) :].tobytes()


@pytest.mark.parametrize("last", [500, 1000, 1001, 1500])
def test_a_stop_condition_ends_it_before_at_and_after_the_change(eager, last):
    @subsystem(sample_time=0.01)
    def box(u):
        before = UnitDelay(initial_value=0.0, name="n")
        before(before.y + 1.0)
        return StopCondition(name="stop")(Compare(">")(before.y, last - 0.5)) + 0.0 * u

    made = Diagram("d", box(Sine(frequency=1.0)))
    run = made.simulate(30.0, compile="auto", **QUIET)
    assert_same_bits(made.simulate(30.0, compile=False, **QUIET), run)
    assert run.stopped.t == pytest.approx(last / 100)
    assert len(run.t) == last + 1


def test_a_run_to_disk_and_every_nth_sample_are_the_same(eager, tmp_path):
    run = sums().simulate(40.0, compile="auto", every=7, to=tmp_path / "run", **QUIET)
    assert eager
    assert_same_bits(sums().simulate(40.0, compile=False, every=7, **QUIET), run)
    assert Run.open(tmp_path / "run").tier == "both"
    assert sums().simulate(1.0, compile=True, **QUIET).tier == "compiled"


def test_what_c_does_not_do_to_the_last_bit_stays_interpreted(eager):
    table = Lookup1D(breakpoints=[0.0, 1.0, 9.0], values=[0.0, 3.0, -1.0], name="table")
    made = sums(table)
    run = made.simulate(40.0, compile="auto", **QUIET)
    assert not eager
    assert run.messages == ()
    assert run.tier == "interpreted"
    assert_same_bits(made.simulate(40.0, compile=False, **QUIET), run)


def test_a_missing_compiler_is_told_once(eager, no_compiler):
    runs = [sums().simulate(20.0, compile="auto", **QUIET) for _ in range(2)]
    assert ["no-such-compiler" in " ".join(run.messages) for run in runs] == [True, False]
    assert_same_bits(*runs)
    assert_same_bits(sums().simulate(20.0, compile=False, **QUIET), runs[0])


def test_a_cache_that_fails_leaves_the_run_interpreted_and_is_told(eager, monkeypatch, tmp_path):
    compiled_libraries.load_compiled.cache_clear()
    compiled_libraries.load_runtime.cache_clear()
    (tmp_path / "file").touch()
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "file"))
    run = sums().simulate(20.0, compile="auto", **QUIET)
    assert run.tier == "interpreted"
    assert any(str(tmp_path) in message for message in run.messages)
    at_once = sums().simulate(20.0, compile=True, **QUIET)
    assert at_once.tier == "interpreted"
    assert any("Set LOOPWRIGHT_CACHE" in message for message in at_once.messages)
    assert_same_bits(sums().simulate(20.0, compile=False, **QUIET), run)


def test_a_short_run_asks_for_no_code(monkeypatch):
    clock = count()
    monkeypatch.setattr(
        change_over, "perf_counter", lambda: 1e-4 * next(clock)
    )  # 0.1 ms a chunk, whatever else goes on
    with mock.patch.object(expanded_functions, "write_functions", side_effect=AssertionError("written")):
        assert len(sums().simulate(20.0, compile="auto", **QUIET).t) == 2001


def test_code_takes_over_in_a_run_in_small_pieces(eager):
    with sums().simulation(compile="auto") as simulation:
        for _ in range(60):
            simulation.advance(0.5)
        run = simulation.run()
    assert len(eager) == 1
    assert run.tier == "both"
    assert_same_bits(sums().simulate(30.0, compile=False, **QUIET), run)


def test_a_failure_after_the_change_says_the_same(eager):
    @subsystem(sample_time=0.01)
    def box(u):
        total = UnitDelay(name="total", initial_value=1.0)
        return total(1.3 * total.y) + 0.0 * u

    made, found = Diagram("d", box(Sine(frequency=1.0))), []
    for form in (False, "auto"):
        with pytest.raises(SimulationError, match="overflow") as caught:
            made.simulate(40.0, compile=form, **QUIET)
        found.append((str(caught.value), caught.value.run.data.tobytes()))
    assert found[0] == found[1]
    assert len(eager) == 1


@pytest.mark.parametrize("value", ["yes", 1, None])
def test_another_value_is_refused(value):
    with pytest.raises(OptionError, match='expected True, False or "auto"'):
        sums().simulate(1.0, compile=value, **QUIET)


def test_the_docstring_of_simulate_names_every_option():
    options = (field.name for field in fields(RunOptions))
    assert not [name for name in options if f"``{name}``" not in Diagram.simulate.__doc__]
