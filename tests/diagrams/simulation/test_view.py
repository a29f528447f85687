"""What others may see and change of a running simulation: its view is read-only, parameters change by a method."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from loopwright.blocks import (
    Compare,
    Constant,
    Gain,
    Integrator,
    OptionError,
    ParameterError,
    Ramp,
    SimulationError,
    Sine,
    Step,
    StopCondition,
    UnitDelay,
    UnknownNameError,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, mass_spring_damper

T = 0.125
DECAY = Diagram("decay", Integrator(name="x", initial_value=1.0)(Gain(gain=-2.0, name="rate")(Constant(value=1.0))))


@subsystem(sample_time=T)
def halving():
    """x⁺ = x / 2 + 1 from x = 0: x_k = 2 − 2^(1−k)."""
    memory = UnitDelay(initial_value=0.0, name="memory")
    half = Gain(gain=0.5, name="half")(memory.y)
    return memory(half + 1.0)


HALVING = Diagram("halving", halving())


def test_the_view_shows_the_instant_as_it_is_recorded_and_what_follows():
    with HALVING.simulation() as simulation:
        view = simulation.view
        for k in (0, 1, 4):
            if k:
                simulation.advance((k - view.tick) * T)
            assert (view.t, view.tick) == (k * T, k)
            where = simulation.flat.states.slices["halving.memory"]
            assert view.x[where].item() == 2.0 - 2.0 ** (1 - k)
            assert view.x_next[where].item() == 2.0 - 2.0**-k
            assert view.log[simulation.flat.log.slices["halving.half.y"]].item() == 1.0 - 2.0**-k
        assert view is simulation.view


def test_the_view_refuses_writes():
    with HALVING.simulation() as simulation:
        view = simulation.view
        for name in ("x", "x_next", "w", "z", "log"):
            with pytest.raises(ValueError, match="read-only"):
                getattr(view, name)[...] = 1.0
            with pytest.raises(FrozenInstanceError):
                setattr(view, name, np.zeros(1))
        with pytest.raises(TypeError):
            view.plants["plant"] = None
        for name in ("t", "tick", "events"):
            with pytest.raises((AttributeError, FrozenInstanceError)):
                setattr(view, name, 1)
        simulation.advance(T)
        assert simulation.run()["halving.memory.y"].tolist() == [0.0, 1.0]


def test_the_view_shows_plants_with_their_inputs_and_outputs(tmp_path):
    plant = Fmu(mass_spring_damper.build(), name="plant")
    with Diagram("d", plant(force=Constant(value=3.0))).simulation(step=0.01) as simulation:
        simulation.advance(0.1)
        view, flat = simulation.view, simulation.flat
        assert list(view.plants) == ["plant"]
        assert view.plants["plant"].operating_point()["t"] == pytest.approx(0.1, abs=1e-15)
        assert view.z[flat.plant_inputs.slices["plant.force"]].tolist() == [3.0]
        position = view.w[flat.plant_outputs.slices["plant.position"]].item()
        assert position == simulation.run()["plant.position"][-1] > 0.0


def test_the_view_shows_the_events_of_this_instant_alone(tmp_path):
    step = Step(times=0.5, values=1.0, name="step")

    def of(simulation):
        return [(event.block, event.t) for event in simulation.view.events]

    @subsystem(enabled="held")
    def box():
        return Integrator(name="x")(Constant(value=1.0))

    diagram = Diagram("d", box(enable=step))
    for options in ({}, {"to": tmp_path / "run"}):  # on disk, events are not kept in memory
        with diagram.simulation(step=0.25, **options) as simulation:
            seen = []
            for _ in range(4):
                seen.append(of(simulation))
                simulation.advance(0.25)
        assert seen == [[], [], [("box", 0.5)], []]


def test_a_stopped_run_shows_when_and_by_whom():
    x = Integrator(name="x")(Constant(value=1.0))
    diagram = Diagram("d", StopCondition(name="end")(Compare(">")(Gain(gain=4.0)(x), 1.0)))
    with diagram.simulation(step=0.1) as simulation:
        simulation.advance(1.0)
        assert simulation.view.t == simulation.t == simulation.stopped.t == pytest.approx(0.25, abs=1e-12)
        assert simulation.stopped.block == "end"


def test_the_residual_at_a_saved_state_is_that_of_the_run():
    """It was taken from the start of the run instead."""
    with HALVING.simulation() as simulation:
        simulation.advance(3 * T)
        state = simulation.save()
    point = HALVING.operating_point(3 * T, start=state)
    assert point.residual == pytest.approx(0.125 / 2.75, rel=1e-14)  # x⁺ − x over 1 + x = 1 + 1.75
    assert point.residual == HALVING.operating_point(3 * T).residual


# --- parameters in a run ------------------------------------------------------------------------------------------------


def test_a_run_takes_over_parameters_and_no_other_run_does():
    with DECAY.simulation(step=0.25) as simulation:
        simulation.advance(0.5)
        simulation.set_parameters("rate", DECAY["rate"].replace(gain=3.0))
        simulation.advance(0.5)
        assert np.allclose(simulation.run()["x.y"], [1.0, 0.5, 0.0, 0.75, 1.5], atol=1e-12)
    assert np.allclose(DECAY.simulate(0.5, step=0.25, progress=False)["x.y"], [1.0, 0.5, 0.0], atol=1e-12)


def test_a_sampled_block_is_discretized_anew_with_its_parameters():
    @subsystem(sample_time=T)
    def box():
        return Integrator(name="x")(Gain(gain=2.0, name="gain")(Constant(value=1.0)))

    diagram = Diagram("d", box())
    with diagram.simulation() as simulation:
        simulation.advance(2 * T)
        simulation.set_parameters("box.gain", diagram["box.gain"].replace(gain=-1.0))
        simulation.advance(2 * T)
        # the next state at 2 T has been computed with the old gain
        assert simulation.run()["box.x.y"].tolist() == [0.0, 0.25, 0.5, 0.75, 0.625]


@pytest.mark.parametrize(
    ("path", "block", "error", "words"),
    [
        ("nobody", Gain(gain=1.0), UnknownNameError, "no block there is evaluated"),
        ("rate", Gain(gain=np.ones(2)), ParameterError, "its equations change"),
        ("rate", Constant(value=1.0), ParameterError, "its equations change"),
        ("zero", Gain(gain=1.0), ParameterError, "none in the place of a zero"),
        ("wave", Sine(frequency=2.0), ParameterError, "longest step follows"),
    ],
)
def test_parameters_that_a_run_cannot_take_over_are_refused(path, block, error, words):
    wave = Sine(frequency=1.0, name="wave")
    diagram = Diagram(
        "d", Integrator(name="x")(Gain(gain=2.0, name="rate")(wave) + Gain(gain=0.0, name="zero")(Ramp(slope=1.0)))
    )
    with diagram.simulation(step=0.1) as simulation:
        before = simulation.view.log.copy()
        with pytest.raises(error, match=words) as caught:
            simulation.set_parameters(path, block)
        assert caught.value.block == path
        assert np.array_equal(simulation.view.log, before)


# --- states of another diagram ------------------------------------------------------------------------------------------


def test_states_are_taken_over_by_name_and_new_ones_settle():
    def variant(*, delay):
        @subsystem(sample_time=T)
        def box():
            x = UnitDelay(initial_value=1.0, name="x")
            x(Gain(gain=0.5)(x.y))
            return UnitDelay(initial_value=-5.0, name="late")(x.y) if delay else x.y

        return Diagram("d", Gain(gain=1.0, name="out")(box()))

    plain, delayed = variant(delay=False), variant(delay=True)
    flat = plain.flatten()
    with delayed.simulation() as simulation:
        simulation.take_over(np.full(flat.width, 3.0), flat)
        view, states = simulation.view, simulation.flat.states.slices
        assert view.x[states["box.x"]].item() == 3.0
        assert view.x[states["box.late"]].item() == 3.0  # it holds what its input settles at
        assert view.x_next[states["box.x"]].item() == 1.5
    with pytest.raises(OptionError, match="this run has ended"):
        simulation.take_over(np.zeros(flat.width), flat)


def test_states_at_which_a_value_is_not_finite_are_refused():
    diagram = HALVING
    with (
        diagram.simulation() as simulation,
        pytest.raises(SimulationError, match=r"halving\.memory\.y"),
    ):
        simulation.take_over(np.full(simulation.flat.width, np.nan), simulation.flat)
