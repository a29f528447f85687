"""Rates: inherited ones, slow boxes, nearly equal ones, durations."""

from fractions import Fraction

import numpy as np
import pytest

from loopwright.blocks import (
    Clock,
    Constant,
    Gain,
    Integrator,
    OptionError,
    Sine,
    UnitDelay,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import Diagram, subsystem


def sine(t, frequency):
    return np.sin(2 * np.pi * frequency * np.asarray(t))


def nested():
    @subsystem
    def inner(u):
        return UnitDelay(initial_value=0.0)(u).named("late")

    @subsystem(sample_time=1e-3)
    def outer(u):
        return inner(u)

    return Diagram("nested", outer(Sine(frequency=5.0)))


def test_an_inner_box_follows_the_rate_of_the_box_around_it():
    for rate in (1e-3, 2e-3):
        run = nested().replace({"outer.sample_time": rate}).simulate(0.02, step=1e-3, progress=False)
        held = rate * np.floor(run.t / rate + 1e-9)
        assert np.allclose(run["late"], np.where(held > 0, sine(held - rate, 5.0), 0.0), atol=1e-15)


def test_a_box_is_found_by_the_end_of_its_path_and_given_back_its_inherited_rate():
    diagram = nested().replace({"inner.sample_time": 4e-3})
    assert diagram.subsystems["outer.inner"].sample_time == Fraction(1, 250)
    assert diagram.replace({"inner.sample_time": None}).subsystems["outer.inner"].sample_time is None


def test_a_diagram_has_no_sample_time_of_its_own():
    with pytest.raises(UnknownNameError, match=r"its subsystems have: outer\.sample_time, outer\.inner\.sample_time"):
        nested().replace(sample_time=4e-3)


def test_a_slow_box_without_states_holds_its_output():
    @subsystem(sample_time=3e-3)
    def slow(u):
        return Gain(gain=1.0)(u)

    run = Diagram("d", slow(Sine(frequency=25.0)).named("y")).simulate(0.012, step=1e-3, progress=False)
    k = np.arange(13)
    assert np.allclose(run["y"], sine((k - k % 3) * 1e-3, 25.0), atol=1e-15)


def test_a_source_that_a_box_returns_has_the_boxs_rate():
    @subsystem(sample_time=0.1)
    def generator():
        return Sine(frequency=1.0)

    diagram = Diagram("d", Gain(gain=1.0)(generator()).named("y"))
    assert list(diagram.blocks) == ["gain", "generator.sine"]
    run = diagram.simulate(0.2, step=0.05, progress=False)
    assert np.allclose(run["y"], sine([0.0, 0.0, 0.1, 0.1, 0.2], 1.0), atol=1e-15)


def test_one_box_used_twice_names_its_wires_apart():
    @subsystem(sample_time=0.1)
    def double(u):
        return Gain(gain=2.0)(u).named("force")

    diagram = Diagram("d", double(Constant(value=1.0)), double.replace(name="other")(Constant(value=2.0)))
    run = diagram.simulate(0.1, progress=False)
    assert (run["double.force"][0], run["other.force"][0]) == (2.0, 4.0)


def test_nearly_equal_rates_list_no_hyperperiod():
    @subsystem(sample_time=1e-3)
    def one(u):
        return UnitDelay(initial_value=0.0)(u).named("one")

    @subsystem(sample_time=1.0001e-3)
    def two(u):
        return UnitDelay(initial_value=0.0)(u).named("two")

    wave = Sine(frequency=3.0, name="wave")
    run = Diagram("d", one(wave), two(wave)).simulate(2e-3, progress=False)
    assert run.t.tolist() == [0.0, 1e-3, 1.0001e-3, 2e-3]  # of 20001 ticks of 0.1 us, those at which a box acts
    assert run["one"][-1] == pytest.approx(sine(1e-3, 3.0), abs=1e-15)
    assert run["two"][-1] == pytest.approx(0.0, abs=1e-15)  # its second tick, at 1.0001 ms, gave the value of t = 0


@pytest.mark.parametrize(("duration", "ticks"), [(0.1 + 0.2, 3), (np.float32(0.5), 5), (1, 10)])
def test_a_duration_is_taken_to_the_nearest_tick(duration, ticks):
    run = Diagram("d", Sine(frequency=1.0)()).simulate(duration, step=0.1, progress=False)
    assert len(run.t) == ticks + 1


@pytest.mark.parametrize("duration", ["1", None, float("nan"), float("inf"), 0, -1.0, True, [1.0]])
def test_what_is_no_duration_is_refused(duration):
    with pytest.raises(OptionError, match=r"d\.duration: found a duration of .*; expected seconds, positive\. Give"):
        Diagram("d", Sine(frequency=1.0)()).simulate(duration, step=0.1, progress=False)


def test_a_run_that_can_not_fit_is_refused_before_it_takes_memory():
    with pytest.raises(OptionError, match=r"numbers each need .* GiB, and this machine has .*Is the duration in s\?"):
        Diagram("d", Sine(frequency=1.0)()).simulate(1e12, step=1e-3, progress=False)


def test_a_diagram_needs_its_name_first():
    with pytest.raises(WiringError, match=r'where the name is expected; write Diagram\("name", …\)'):
        Diagram(Gain(gain=2.0)(1.0))


def test_a_diagram_is_a_value():
    diagram = nested()
    with pytest.raises(AttributeError, match="a diagram is a value"):
        diagram.name = "other"


def test_a_file_name_is_no_block():
    with pytest.raises(WiringError, match=r"outer\.inner\.unit_delay: found 'x\.fmu'; expected a block in its place"):
        nested().replace({"outer.inner.unit_delay": "x.fmu"})


def test_what_is_decorated_must_be_a_function():
    with pytest.raises(
        WiringError, match=r"found 0\.001; expected a function, or keywords: @subsystem\(sample_time=0\.0"
    ):
        subsystem(1e-3)


def late_by_two(inner_name="y"):
    """An integrator behind a gain of 3 that is computed for two samples of 0.1 s."""

    @subsystem(sample_time=0.1, delay=2)
    def controller(u):
        y = Gain(gain=3.0)(u)
        return y.named(inner_name) if inner_name else y

    return controller


def test_a_wire_named_in_a_subsystem_with_a_delay_is_the_one_that_its_consumers_outside_get():
    """The first computed value, 0, leaves in the first ticks; then 3 t of two ticks before."""
    run = Diagram("d", Integrator()(late_by_two()(Clock()))).simulate(0.5, step=0.1, progress=False)
    assert np.allclose(run["y"], [0, 0, 0, 0.3, 0.6, 0.9], rtol=0, atol=1e-15)
    assert np.allclose(run["gain.y"], 3 * run.t, rtol=0, atol=1e-15)  # the port is the block's own
    # the integral of a signal that is held, computed by hand: 0.1 (0 + 0 + 0 + 0.3 + 0.6)
    assert run["integrator.y"][-1] == pytest.approx(0.1 * run["y"][:-1].sum(), abs=1e-12)


def test_a_named_output_that_nobody_reads_is_late_too():
    run = Diagram("d", late_by_two()(Clock())).simulate(0.5, step=0.1, progress=False)
    assert np.allclose(run["y"], [0, 0, 0, 0.3, 0.6, 0.9], rtol=0, atol=1e-15)


def test_delays_of_nested_subsystems_add_up_on_a_wire_that_is_named_in_the_inner_one():
    @subsystem(sample_time=0.1, delay=1)
    def outer(u):
        return late_by_two()(u)

    run = Diagram("d", Integrator()(outer(Clock()))).simulate(0.5, step=0.1, progress=False)
    assert np.allclose(run["y"], [0, 0, 0, 0, 0.3, 0.6], rtol=0, atol=1e-15)


def test_a_wire_that_stays_inside_is_recorded_without_the_delay_of_what_leaves():
    @subsystem(sample_time=0.1, delay=1)
    def controller(u):
        pair = Gain(gain=[1.0, 2.0], name="pair")(u)
        kept = pair[1].named("kept")
        return pair[0].named("left"), Gain(gain=1.0, name="last")(kept)

    run = Diagram("d", Integrator()(controller(Clock()).left)).simulate(0.3, step=0.1, progress=False)
    assert np.allclose(run["left"], [0, 0, 0.1, 0.2], rtol=0, atol=1e-15)
    assert np.allclose(run["kept"], 2 * run.t, rtol=0, atol=1e-15)


def test_the_loop_at_a_wire_that_leaves_contains_the_delay_wherever_it_was_named():
    """L of 3 z^-2 T / (z - 1) at the wire, by hand; and the wire is cut where it leaves."""

    def closed(controller):
        plant = Integrator(name="plant")
        return Diagram("d", plant(controller(0.0 - plant.y)))

    for inner, outer in (("y", None), (None, "y")):
        controller = late_by_two(inner)
        d = closed((lambda e, c=controller: c(e).named("y")) if outer else controller)
        z = np.exp(0.3j)
        assert complex(d.linearize().loop("y")(z)) == pytest.approx(3 * 0.1 / (z**2 * (z - 1)), rel=1e-9)
