"""Events of FMUs in model exchange: of time, of steps, of inputs, and the end that an FMU asks for."""

import re
from fractions import Fraction

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, Quantizer, SimulationError, Step, Sum, WiringError
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, FmuRuntimeError
from support.eventful import eventful_fmu, exact


@pytest.fixture(scope="module", params=[2, 3])
def file(request, cache, tmp_path_factory):
    return eventful_fmu(tmp_path_factory.mktemp("eventful"), request.param)


def named(events, name):
    return [e.t for e in events if e.event == name]


def plant(file, **start):
    return Fmu(file, name="plant", start=start)


RADAU = pytest.param("Radau", marks=pytest.mark.one_tier)  # its output `steps` counts the solver's, one less in C


@pytest.mark.parametrize("solver", ["RK45", RADAU, "BDF", "CVODE_Adams", "rk4", "euler"])
@pytest.mark.drawn(2)
def test_a_solver_lands_on_time_events(file, solver):
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(1.1, step=0.1, solver=solver, progress=False)
    assert named(run.events, "time_event") == [0.25, 0.5, 0.75, 1.0]
    np.testing.assert_allclose(run["plant.x"], exact(run.t, 0.5), atol=1e-12)  # linear between events: no error
    np.testing.assert_array_equal(run["plant.k"], np.floor(4.0 * run.t))


def test_an_interface_that_is_the_only_one_is_chosen_and_told(file):
    fmu = plant(file)
    assert fmu.used_interface == "model_exchange"
    assert "model exchange" in repr(fmu)
    run = Diagram("d", fmu(u=Constant(value=0.5), n=Constant(value=0.0))).simulate(0.1, step=0.1, progress=False)
    assert any("model exchange" in message for message in run.messages)


def test_a_discrete_input_is_set_in_event_mode_and_taken_over_at_once(file):
    step = Step(times=0.333, values=3.0, name="step")
    run = Diagram("d", plant(file)(u=Constant(value=1.0, name="u"), n=step)).simulate(0.8, step=0.05, progress=False)
    np.testing.assert_array_equal(run["plant.m"], np.where(run.t >= 0.333, 3.0, 0.0))
    np.testing.assert_allclose(run["plant.x"], exact(run.t, 1.0), atol=1e-12)


def test_an_input_that_is_no_integer_is_refused_with_the_way_to_convert_it(file):
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=1.5, name="n")))
    with pytest.raises(FmuRuntimeError, match=r"^plant\.n.*: found 1\.5; expected an integer") as error:
        diagram.simulate(0.2, step=0.1, progress=False)
    assert error.value.message.endswith("Convert the signal before this input, with Quantizer, say.")


@pytest.mark.drawn(1)
def test_a_sampled_integer_output_reaches_the_fmu_at_its_tick(file):
    @subsystem(sample_time=0.1)
    def sampler(x):
        return Quantizer(quantum=1.0, name="whole")(Gain(gain=10.0, name="tenfold")(x))

    fmu = plant(file)
    run = Diagram("d", fmu(u=Constant(value=1.0, name="u"), n=sampler(fmu.x))).simulate(0.5, progress=False)
    np.testing.assert_array_equal(run["plant.m"], np.rint(10.0 * exact(run.t, 1.0) - 1e-9))
    np.testing.assert_array_equal(run["plant.m"], run["plant.n"] if "plant.n" in run else run["plant.m"])


@pytest.mark.drawn(1)
def test_a_jump_of_a_continuous_input_is_an_event(file):
    fmu = plant(file)
    quiet = Diagram("d", fmu(u=Constant(value=1.0, name="u"), n=Constant(value=0.0, name="n")))
    jumping = quiet.replace(u=Step(times=0.4, values=1.0, initial_value=0.0, name="u"))
    events = [d.simulate(0.6, step=0.1, progress=False)["plant.events"][-1] for d in (quiet, jumping)]
    assert events == [3.0, 4.0]  # at the start, at 0.25 and 0.5 s; and at 0.4 s


@pytest.mark.drawn(1)
def test_a_step_event_sets_states_and_nominal_values_anew(file):
    diagram = Diagram("d", plant(file, armed=1)(u=Constant(value=8.0, name="u"), n=Constant(value=0.0, name="n")))
    with diagram.simulation(step=0.05, solver="rk4") as simulation:
        simulation.advance(0.2)
        run = simulation.run()
    assert named(run.events, "step_event") == [pytest.approx(0.15)]
    np.testing.assert_allclose(run["plant.x"], [0.0, 0.4, 0.8, 0.0, 0.4], atol=1e-12)
    with diagram.simulation(step=0.05, solver="RK45", atol=1e-7) as simulation:
        simulation.advance(0.05)
        solver = simulation._engine.continuous.method
        assert np.ravel(solver.atol) == [1e-7]
        simulation.advance(0.5)
        assert np.ravel(solver.atol) == [5e-7]  # the nominal value is 5 after the event


def test_every_accepted_step_is_completed_once(file):
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(0.2, step=0.02, solver="euler", progress=False)
    np.testing.assert_array_equal(run["plant.steps"], np.arange(11))


def test_an_fmu_ends_the_run(file):
    diagram = Diagram("d", plant(file, last=3)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(2.0, step=0.1, progress=False)
    assert (run.stopped.t, run.stopped.block) == (0.75, "plant")
    assert run.t[-1] == 0.75
    assert run["plant.k"][-1] == 3.0
    assert any("terminateSimulation" in message for message in run.messages)


def test_two_fmus_pass_an_event_on_at_the_same_instant(file):
    first, second = plant(file), Fmu(file, name="second")
    fixed = Constant(value=0.5, name="u")
    diagram = Diagram("d", first(u=fixed, n=Constant(value=0.0, name="n")), second(u=fixed, n=first.k))
    run = diagram.simulate(1.0, step=0.05, progress=False)
    np.testing.assert_array_equal(run["second.m"], run["plant.k"])


def test_discrete_signals_that_chase_each_other_end_in_an_error(file):
    fmu = plant(file)
    diagram = Diagram(
        "d", fmu(u=Constant(value=0.5, name="u"), n=Sum(signs="++")(fmu.m, Constant(value=1.0, name="one")))
    )
    with pytest.raises(SimulationError, match=r"plant.*(without end|still change)"):
        diagram.simulate(0.2, step=0.1, progress=False)


def test_it_refuses_to_stand_in_an_enabled_subsystem(file):
    @subsystem(enabled="held")
    def box(u):
        return plant(file)(u=u, n=Constant(value=0.0, name="n")).x

    with pytest.raises(
        WiringError, match=r"box.plant: an FMU in model exchange can't be in a subsystem that is enabled"
    ):
        Diagram("d", box(Constant(value=1.0), enable=Constant(value=1.0)).named("x"))


@pytest.mark.drawn(2)
@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("return 3;", "computing the derivatives of its states failed with fmi3Error at t = 0"),
        ("return 2;", "The FMU discards what the solver tries: computing the derivatives of its states at t = 0"),
        ("dx[0] = 0.0 / 0.0; return 0;", "the rate of plant.x = 0.2 is 1.5 there and is not finite just beyond"),
    ],
    ids=["error", "discard", "nan"],
)
def test_a_failure_names_fmu_call_and_time_and_keeps_the_samples(cache, tmp_path, fault, told):
    file = eventful_fmu(tmp_path, 3, fault=f"if (c->t > 0.3) {{ {fault} }}")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    with pytest.raises(SimulationError, match=told) as error:
        diagram.simulate(1.0, step=0.1, progress=False)
    assert error.value.block == "plant"
    assert error.value.t == pytest.approx(0.3, abs=0.1)
    np.testing.assert_allclose(error.value.run["plant.x"], exact(error.value.run.t, 0.5), atol=1e-12)
    assert error.value.run.t[-1] >= 0.2


@pytest.mark.drawn(2)
@pytest.mark.parametrize("solver", ["RK45", "Radau", "BDF", "CVODE_Adams", "rk4", "euler"])
@pytest.mark.parametrize("duration", [0.7, 0.72])
def test_no_solver_evaluates_beyond_the_end_of_the_run(cache, tmp_path, solver, duration):
    """The FMU fails fatally there, as one with a table that ends; the run's end may lie between two ticks."""
    file = eventful_fmu(tmp_path, 3, fault=f"if (c->t > {duration} * (1.0 + 1e-15)) return 4;")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(duration, step=0.1, solver=solver, progress=False)
    assert run.t[-1] == duration
    np.testing.assert_allclose(run["plant.x"], exact(run.t, 0.5), atol=1e-12)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", [2, 3])
def test_time_events_that_pile_up_are_an_error(cache, tmp_path, fmi):
    file = eventful_fmu(tmp_path, fmi, following="c->t < 0.25 ? 0.25 : c->t + 1e-12")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    told = r"pile up \(time_event\): they came at 500 instants .* the next time event is at t \+ 1e-12 s"
    with pytest.raises(SimulationError, match=told) as error:
        diagram.simulate(1.0, step=0.1, progress=False)
    assert error.value.block == "plant"
    assert error.value.t == pytest.approx(0.25 + 499e-12, abs=1e-12)
    assert error.value.run.t[-1] == 0.2


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    ("tick", "refused"), [(1e-7, True), pytest.param(1.2e-9, False, marks=pytest.mark.slow), (1e-10, False)]
)
def test_time_events_in_picoseconds_are_told_where_ticks_are_short(cache, tmp_path, tick, refused):
    """Events 1e-12 s apart: 1e5, 1200 and 100 between two ticks."""
    file = eventful_fmu(tmp_path, 3, following="c->t + 1e-12")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    with diagram.simulation(step=Fraction(tick).limit_denominator(10**12), solver="euler") as simulation:
        if refused:
            with pytest.raises(SimulationError, match=r"pile up \(time_event\): .*ticks are 1e-07 s apart"):
                simulation.advance(tick)
            return
        simulation.advance(tick)
        told = [m for m in simulation.run().messages if "so the run continues slowly" in m]
    assert len(told) == (tick == 1.2e-9)
    assert all("its events (time_event) come every 1e-12 s, about 1.2e+03 times between two ticks" in m for m in told)


def test_many_time_events_that_leave_the_run_its_way_are_none(cache, tmp_path):
    file = eventful_fmu(tmp_path, 3, following="c->t + 1e-5")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    with diagram.simulation(step=1e-3, solver="euler") as simulation:
        simulation.advance(6e-3)
        assert len(named(simulation.run().events, "time_event")) == pytest.approx(600, abs=7)


@pytest.mark.slow
def test_a_run_in_picoseconds_has_as_many_time_events_as_it_likes(cache, tmp_path):
    file = eventful_fmu(tmp_path, 3, following="c->t + 1e-12")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(6e-10, step=Fraction(1, 10**11), solver="euler", progress=False)
    assert len(named(run.events, "time_event")) == pytest.approx(600, abs=60)
    assert run.t[-1] == 6e-10


@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_next_event_time_that_is_no_number_is_an_error(cache, tmp_path, fmi):
    file = eventful_fmu(tmp_path, fmi, following="c->t < 0.25 ? 0.25 : 0.0 / 0.0")
    diagram = Diagram("d", plant(file)(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0.25 s: .*nextEventTime.*NaN") as error:
        diagram.simulate(1.0, step=0.1, progress=False)
    assert error.value.run.t[-1] == 0.2


@pytest.mark.drawn(1)
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_input_that_leaves_its_range_between_events_is_refused_at_the_step(tmp_path, cache, fmi, isolate):
    """u = 4 t leaves the range at t = 0.5, where nothing else happens."""
    path = eventful_fmu(tmp_path, fmi, following="1e9", largest=2.0)
    ramp = Integrator(initial_value=0.0, name="ramp")(Constant(value=4.0, name="slope"))
    plant = Fmu(path, name="plant", isolate=isolate)
    diagram = Diagram("d", plant(u=ramp, n=Constant(value=0.0, name="n")))
    text = (
        r"^plant\.u, t = (\S+) s: found (\S+); expected at most 2\. Limit the signal before this input, with Saturation"
    )
    with pytest.raises(FmuRuntimeError, match=text) as caught:
        diagram.simulate(1.0, step=0.25, max_step=0.0625, progress=False)
    error = caught.value
    assert error.port == "u"
    assert 0.5 < error.t <= 0.5625 + 1e-12
    assert float(re.match(text, str(error)).group(2)) == pytest.approx(4.0 * error.t, rel=1e-6)
    np.testing.assert_allclose(error.run["ramp.y"], 4.0 * error.run.t, atol=1e-9)


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_warning_of_an_evaluation_is_told_once_for_each_kind_of_call(tmp_path, cache, fmi, isolate):
    getter = "int NAME(REAL_GET)(void *p, const unsigned r[], size_t n, double v[] SIZE) {\n    instance *c = p;"
    warns = (getter, getter + " if (c->t > 0.3) { if (!n) return 0; GOT; return 1; }")
    values = (
        "for (size_t i = 0; i < n; i++) v[i] = r[i] == 1 ? c->x : r[i] == 2 ? c->u + c->k : r[i] == 3 ? c->u : c->t"
    )
    path = eventful_fmu(tmp_path, fmi, changes=[(warns[0], warns[1].replace("GOT", values))])
    plant = Fmu(path, name="plant", isolate=isolate)
    run = Diagram("d", plant(u=Constant(value=0.5), n=Constant(value=0.0))).simulate(1.0, step=0.1, progress=False)
    told = [m for m in run.messages if "Warning" in m]
    assert len(told) == 1, run.messages
    found = re.fullmatch(
        rf"plant: reading the outputs gave fmi{fmi}Warning at t = (\S+) s; further ones are not reported.", told[0]
    )
    assert 0.3 < float(found.group(1)) <= 0.4
    np.testing.assert_allclose(run["plant.x"], exact(run.t, 0.5), atol=1e-12)  # its values count
