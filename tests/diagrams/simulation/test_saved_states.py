"""Complete states: saved, restored, pickled, continued, in another process too, and branched.

A run that goes on from a saved state is the straight run to the last bit where the straight run, too, starts its
solver anew at that tick: where something sampled acts there, where an FMU takes part, or with a solver of fixed step.
Elsewhere the straight run steps over the tick, and both agree within the tolerance.
"""

import pickle
import re
import subprocess
import sys
from dataclasses import replace as replaced
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    Function,
    Gain,
    Integrator,
    OptionError,
    PulseTrain,
    Relay,
    Sine,
    Step,
    StopCondition,
    Sum,
    TransportDelay,
    UnitDelay,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.fmus import Fmu, bouncing_ball, gantry_contact
from support import TESTS
from support.hybrid_blocks import TIGHT, Ball, Crossings, Lag, counting, decay


def thermostat():
    """Continuous states, events, a sampled box in the loop, a source with edges, a transport delay."""
    lag, relay = Lag(name="lag", k=1.5), Relay(name="relay", on_point=0.45, off_point=0.3)

    @subsystem(sample_time=0.1)
    def filtered(u):
        z = UnitDelay(initial_value=0.0, name="z")
        return (Gain(gain=0.5, name="g")(z(u)) + Gain(gain=0.5, name="h")(u)).named("mean")

    late = TransportDelay(delay=0.23, name="late")
    disturbance = PulseTrain(period=0.77, amplitude=0.2)
    heat = 1.0 - relay(late(lag.y))
    return Diagram("thermostat", lag(heat + disturbance + Gain(gain=0.1, name="k")(filtered(lag.y))))


def continued(diagram, cut, rest, **options):
    """Return the straight run from the cut on, and the one that goes on from the pickled state there."""
    options = {"progress": False} | options
    straight = diagram.simulate(cut + rest, **options)
    first = diagram.simulate(cut, **options)
    state = pickle.loads(pickle.dumps(first.final_state))
    second = diagram.simulate(rest, start=state, **options)
    at = int(np.searchsorted(straight.t, cut))
    assert second.t[0] == straight.t[at] == cut
    return straight, at, first, second


def assert_same_bits(diagram, cut, rest, **options):
    straight, at, first, second = continued(diagram, cut, rest, **options)
    assert np.array_equal(second.t, straight.t[at:])
    assert np.array_equal(second.data, straight.data[at:])
    assert np.array_equal(first.data, straight.data[: at + 1])
    assert [(e.t, e.block, e.event) for e in (*first.events, *second.events)] == [
        (e.t, e.block, e.event) for e in straight.events
    ]
    return straight


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    "solver", ["auto", "RK45", "DOP853", "Radau", "BDF", "LSODA", "CVODE_BDF", "euler", "heun", "rk4"]
)
def test_it_goes_on_to_the_last_bit_from_a_tick_at_which_a_box_acts(solver):
    step = {"step": 0.01} if solver in ("euler", "heun", "rk4") else {}
    straight = assert_same_bits(thermostat(), 1.7, 1.3, solver=solver, **step)
    switched = np.array([e.t for e in straight.events])
    assert np.sum(switched < 1.7 - 0.23) == np.sum((switched > 1.7 - 0.23) & (switched < 1.7)) == 1  # one in the delay
    assert np.sum(switched > 1.7) == 2


def test_where_nothing_acts_it_goes_on_within_the_tolerance():
    lag = Lag(name="lag", k=2.0)
    diagram = Diagram("d", lag(Sine(frequency=1.0)), Ball(name="ball", restitution=1.0))
    for rtol in (1e-6, 1e-9):
        straight, at, _, second = continued(diagram, 1.0, 2.0, step=0.05, rtol=rtol, atol=rtol * 1e-3)
        assert np.max(np.abs(second["lag.y"] - straight["lag.y"][at:])) < 100 * rtol
        assert np.max(np.abs(second["ball.height"] - straight["ball.height"][at:])) < 1000 * rtol


@pytest.mark.drawn(1)
@pytest.mark.parametrize("cut", [0.1, 0.2, 0.5])
def test_in_the_middle_of_a_transport_delay_what_is_under_way_comes_out(cut):
    late = TransportDelay(delay=0.35, initial_value=-2.0, name="late")
    diagram = Diagram("d", Integrator(name="i")(late(Sine(frequency=3.0))), counting(0.1)().named("n"))
    straight = assert_same_bits(diagram, cut, 1.0, step=0.01, solver="rk4")
    s = np.clip(straight.t - 0.35, 0, None)
    exact = -2.0 * np.minimum(straight.t, 0.35) + (1 - np.cos(6 * np.pi * s)) / (6 * np.pi)
    assert np.max(np.abs(straight["i.y"] - exact)) < 1e-6


def test_with_events_in_boxes_that_are_open_or_closed():
    @subsystem(enabled="reset", name="box")
    def box(u):
        return Compare(">", name="c")(u, 0.5)

    enable = Step(times=(0.3, 0.8, 1.1, 1.5), values=(0.0, 1.0, 0.0, 1.0), initial_value=1.0)
    wired = box(Sine(frequency=0.3), enable=enable).named("y")
    diagram = Diagram("d", wired, Crossings(name="cross")(Sine(frequency=2.0, phase=1.0)), counting(0.1)().named("n"))
    for cut in (0.2, 0.5, 0.9, 1.2):
        assert_same_bits(diagram, cut, 1.0)


def test_with_rates_offsets_and_computational_delays_and_solved_loops():
    @subsystem(sample_time=0.2, offset=0.1, delay=2)
    def slow(u):
        e, cube = Sum(signs="+-", name="e"), Function(lambda v: v**3, name="cube")
        return e(u, cube(e.y))

    diagram = Diagram("d", slow(Sine(frequency=0.4)).named("s"), counting(0.3, "c")().named("n"), loops="solve")
    straight = assert_same_bits(diagram, 1.2, 2.0)
    assert np.max(straight.residual) < 1e-12


def test_a_simulation_goes_back_and_repeats_itself():
    with thermostat().simulation(step=0.05) as simulation:
        simulation.advance(1.0)
        state = simulation.save()
        simulation.advance(2.0)
        first = simulation.run()
        simulation.restore(state)
        assert simulation.t == 1.0
        simulation.advance(2.0)
        second = simulation.run()
    assert second.t[0] == 1.0
    assert np.array_equal(second.data, first.data[first.t >= 1.0])


@pytest.mark.parametrize("continuous", [False, True])
def test_a_run_that_was_interrupted_goes_back_to_a_state_and_not_on_from_where_it_was(continuous):
    """C goes over thousands of ticks at a time: after an interrupt within them the numbers are those of a later one."""

    @subsystem(sample_time=1e-3, name="box")
    def box(u):
        memory = UnitDelay(initial_value=0.0, name="n")
        return memory(memory.y + u)

    def interrupt(t):
        if t > 0.2:
            raise KeyboardInterrupt

    one = Constant(value=1.0, name="one")
    more = [Integrator(name="time")(one)] if continuous else []
    with Diagram("d", box(one).named("y"), *more).simulation() as simulation:
        simulation.advance(0.1)
        state = simulation.save()
        with pytest.raises(KeyboardInterrupt) as caught:
            simulation.advance(10.0, progress=interrupt)
        assert caught.value.run.t[-1] > 0.2
        assert not simulation.can_save
        with pytest.raises(OptionError, match=r"^d: the run has failed, or was interrupted, .* can't continue"):
            simulation.advance(0.1)
        with pytest.raises(OptionError, match=r"can't be saved there.*simulation\.restore\(state\)"):
            simulation.save()
        simulation.restore(state)
        simulation.advance(0.1)
        run = simulation.run()
    assert run["y"].tolist() == [*range(100, 201)]
    if continuous:
        assert run["time.y"] == pytest.approx(run.t, abs=1e-12)


@pytest.mark.slow
def test_a_saved_state_is_not_changed_by_what_happens_later():
    with thermostat().simulation() as simulation:
        simulation.advance(1.0)
        state = simulation.save()
        before = pickle.dumps(state)
        simulation.advance(2.0)
        simulation.restore(state)
        simulation.advance(2.0)
        assert pickle.dumps(state) == before


@pytest.mark.slow
def test_it_goes_on_in_another_process(tmp_path):
    diagram = thermostat()
    straight = diagram.simulate(4.0, progress=False)
    state = diagram.simulate(2.0, progress=False).final_state
    (tmp_path / "state.pickle").write_bytes(pickle.dumps(state))
    code = (
        "import sys, pickle, numpy as np; sys.path[:0] = sys.argv[2:]\n"
        "from test_saved_states import thermostat\n"
        "state = pickle.load(open(sys.argv[1] + '/state.pickle', 'rb'))\n"
        "run = thermostat().simulate(2.0, start=state, progress=False)\n"
        "np.save(sys.argv[1] + '/run.npy', run.data)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path), str(Path(__file__).parent), str(TESTS)], check=True)
    assert np.array_equal(np.load(tmp_path / "run.npy"), straight.data[straight.t >= 2.0])


def test_a_branch_goes_on_with_other_parameters_from_the_same_state():
    diagram = Diagram("d", Lag(name="lag", k=1.0)(Constant(value=1.0)))
    half = diagram.simulate(1.0, step=0.1, **TIGHT).final_state
    branch = diagram.replace({"lag.k": 3.0}).simulate(1.0, step=0.1, start=half, **TIGHT)
    y0 = 1 - np.exp(-1.0)
    exact = 1 / 3 + (y0 - 1 / 3) * decay(branch.t - 1.0, 3.0)
    assert np.max(np.abs(branch["lag.y"][1:] - exact[1:])) < 1e-11
    again = diagram.simulate(1.0, step=0.1, start=half, **TIGHT)
    assert again["lag.y"][-1] == pytest.approx(1 - np.exp(-2.0), abs=1e-11)


# --- with FMUs ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("letter", "cut"), [("A", 5.5), ("C", 6.0)])
def test_the_papers_experiments_go_on_to_the_last_bit_from_half_way(letter, cut):
    experiment = experiments.EXPERIMENTS[letter]()
    assert_same_bits(experiment.diagram, cut, experiment.duration - cut)


@pytest.mark.slow
def test_an_ideal_controller_beside_an_fmu_goes_on_to_the_last_bit():
    diagram = experiments.path_following().diagram.continuous()
    assert_same_bits(diagram, 0.4, 0.3, step=1e-3)


@pytest.mark.slow
def test_an_fmu_with_events_goes_on_to_the_last_bit():
    ball = Fmu(bouncing_ball.build(), name="ball")
    straight = assert_same_bits(Diagram("d", Integrator(name="i")(ball.height)), 1.0, 1.5, step=0.01)
    assert straight["ball.bounces"][-1] > straight["ball.bounces"][100] > 0
    assert_same_bits(Diagram("d", Gain(gain=1.0)(ball.height)), 1.0, 1.5, step=0.01)


@pytest.mark.slow
def test_a_gantry_that_touches_its_wall_goes_on_to_the_last_bit_in_contact():
    plant = Fmu(gantry_contact.build(), name="plant", start={"position": (0.5, 0.63), "velocity": (0.0, 0.4)})
    still = Constant(value=(0.0, 0.0))
    diagram = Diagram("wall", plant(motor_force=still, external_force=still))
    straight = diagram.simulate(0.2, step=1e-3, progress=False)
    contact = straight["plant.contact"]
    inside = np.flatnonzero(contact > 0.5)
    assert inside.size
    cut = round(float(straight.t[inside[inside.size // 2]]), 9)
    assert_same_bits(diagram, cut, 0.1, step=1e-3)


@pytest.mark.slow
def test_an_fmu_branches_into_two_futures():
    def diagram(force):
        plant = Fmu(gantry_contact.build(), name="plant")
        return Diagram(
            "d",
            plant(motor_force=Constant(value=(force, 0.0), name="force"), external_force=Constant(value=(0.0, 0.0))),
        )

    start = diagram(10.0).simulate(0.1, step=1e-3, progress=False).final_state
    left = diagram(10.0).replace({"force.value": (-60.0, 0.0)}).simulate(0.2, step=1e-3, start=start, progress=False)
    right = diagram(10.0).replace({"force.value": (60.0, 0.0)}).simulate(0.2, step=1e-3, start=start, progress=False)
    assert np.array_equal(left["plant.position"][0], right["plant.position"][0])
    assert left["plant.position"][-1][0] < right["plant.position"][-1][0]


# --- what doesn't fit ---------------------------------------------------------------------------------------------------


def test_a_state_of_other_blocks_is_refused_and_says_what_differs():
    state = Diagram("one", Lag(name="lag")(Constant(value=1.0))).simulate(1.0, step=0.1, progress=False).final_state
    other = Diagram("two", Lag(name="leg")(Constant(value=1.0)))
    with pytest.raises(
        OptionError,
        match=r"two\.start: found the state of a run of 'one' with other blocks: it has the state of 'lag\.y'",
    ):
        other.simulate(1.0, step=0.1, start=state, progress=False)


def test_a_state_with_other_events_is_refused():
    def diagram(*more):
        return Diagram("d", Lag(name="lag")(Constant(value=1.0)), *more)

    state = diagram().simulate(1.0, step=0.1, progress=False).final_state
    with pytest.raises(OptionError, match=r"with other blocks: it lacks the .*'c"):
        diagram(Crossings(name="c")(Clock())).simulate(1.0, step=0.1, start=state, progress=False)


def test_a_state_on_other_ticks_is_refused():
    state = thermostat().simulate(1.0, progress=False).final_state
    with pytest.raises(OptionError, match=r"saved on ticks of 0\.1 s; this run has ticks of 0\.05 s. Give step=0\.1"):
        thermostat().simulate(1.0, step=0.05, start=state, progress=False)


def test_what_is_no_state_is_refused():
    with pytest.raises(OptionError, match=r"found 3; expected a saved state\. Give run\.final_state"):
        thermostat().simulate(1.0, start=3, progress=False)


def test_a_run_without_a_final_state_is_not_begun_anew():
    diagram = Diagram("d", Integrator()(Constant(value=1.0)))
    ended = diagram.simulate(0.25, step=0.1, progress=False)
    assert ended.final_state is None
    with pytest.raises(OptionError, match=r"^d\.start: found None; .*between two ticks, or an FMU"):
        diagram.simulate(0.5, step=0.1, start=ended.final_state, progress=False)


def test_a_state_that_was_stopped_stays_stopped_and_keeps_its_time():
    diagram = Diagram("d", StopCondition(name="stop")(Compare(">")(Integrator(name="i")(Constant(value=1.0)), 0.55)))
    first = diagram.simulate(1.0, step=0.1, progress=False)
    again = diagram.simulate(1.0, step=0.1, start=first.final_state, progress=False)
    assert again.stopped == first.stopped
    assert again.t.tolist() == [first.stopped.t]
    on = replaced(first.final_state, stopped=None)
    assert on.t == first.stopped.t


@pytest.mark.parametrize("solver", ["auto", "RK45", "Radau"])
def test_the_step_that_the_solver_would_take_next_is_saved(solver):
    """Many steps from tick to tick: a solver that had to guess its first one would take others."""
    lag = Lag(name="lag", k=20.0)
    diagram = Diagram("d", lag(Sine(frequency=3.0)), counting(1.0)().named("n"))
    assert_same_bits(diagram, 2.0, 2.0, solver=solver, rtol=1e-4)


@pytest.mark.parametrize(
    "module",
    ["loopwright.diagrams._state", "loopwright.blocks._algebra", "loopwright.fmus.gantry", "loopwright.diagrams.fig3"],
)
def test_a_pickle_from_before_the_files_moved_says_the_version(module):
    with pytest.raises(ModuleNotFoundError, match=f"found {re.escape(module)}, .* before 0\\.2\\.0.* make it again"):
        pickle.loads(f"c{module}\nAnything\n.".encode())


def test_a_module_that_never_was_is_not_explained():
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'loopwright\.diagrams\.nothing'"):
        pickle.loads(b"cloopwright.diagrams.nothing\nAnything\n.")


def test_a_state_of_another_version_says_both_versions():
    diagram = Diagram("ramp", Integrator()(Constant(value=1.0)).named("y"))
    state = replaced(diagram.simulate(0.5, step=0.25, progress=False).final_state, version=1, made_by="0.1.0")
    with pytest.raises(
        OptionError, match=r"state of version 1, made by loopwright 0\.1\.0; this loopwright 0\.2\.0 reads version 3"
    ):
        diagram.simulate(0.5, step=0.25, start=state, progress=False)
