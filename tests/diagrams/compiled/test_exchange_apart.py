"""FMUs in model exchange that run in processes of their own, in compiled runs: bits and words, faults and interrupts."""

import os
import signal

import numpy as np
import pytest

from loopwright.blocks import Constant
from loopwright.diagrams import Diagram, Interrupted
from loopwright.fmus import Fmu, FmuProcessError, FmuRuntimeError, Isolation, mass_spring_damper
from loopwright.fmus.isolation import count_processes, end_idle
from support.controlled_mass import exact_loop, pi_loop
from support.eventful import eventful_fmu, exact
from support.waiting import Interruption

SHORT = Isolation(step_time=1.0)
"""For calls that never end; no other test has a limit that a busy machine reaches."""
EXACT = {"rtol": 1e-9, "atol": 1e-12, "progress": False}
pytestmark = pytest.mark.usefixtures("no_process_left")


@pytest.fixture(scope="module")
def mass(cache, tmp_path_factory):
    return mass_spring_damper.build(out=tmp_path_factory.mktemp("apart") / "mass.fmu")


def mass_loop(mass, isolate):
    return pi_loop(Fmu(mass, interface="model_exchange", name="plant", isolate=isolate))


def eventful(file, start=None, isolate=True):
    plant = Fmu(file, name="plant", isolate=isolate, start=start or {})
    return Diagram("d", plant(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))


def test_a_controlled_plant_is_that_of_the_matrix_exponential_with_the_bits_of_this_process(mass):
    runs = [mass_loop(mass, isolate).simulate(0.1, compile=True, **EXACT) for isolate in (True, False)]
    assert [run.tier for run in runs] == ["compiled", "compiled"]
    assert runs[0].data.tobytes() == runs[1].data.tobytes()
    np.testing.assert_allclose(runs[0]["plant.position"], exact_loop(101), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("fmi", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_events_of_every_kind_are_those_of_this_process(cache, tmp_path, fmi):
    """Armed, x falls to 0 after a step that ends above 1: with all that has fallen, it is the closed form."""
    file = eventful_fmu(tmp_path, fmi)
    for start in ({"armed": 1}, {"last": 3}):
        apart, here = (
            eventful(file, start, isolate).simulate(2.0, step=0.05, compile=True, progress=False)
            for isolate in (True, False)
        )
        assert apart.tier == "compiled"
        assert apart.data.tobytes() == here.data.tobytes()
        assert [(e.t, e.event) for e in apart.events] == [(e.t, e.event) for e in here.events]
        assert (apart.stopped is None) is ("armed" in start)
        timed = [e.t for e in apart.events if e.event == "time_event"]
        assert timed == [0.25 * (k + 1) for k in range(8 if "armed" in start else 3)]
        drops = [(e.before["x"], e.after["x"]) for e in apart.events if e.event == "step_event"]
        assert all(before > 1.0 and after == 0.0 for before, after in drops)
        assert len(drops) >= 3 if "armed" in start else not drops
        fallen = [sum(e.before["x"] for e in apart.events if e.event == "step_event" and e.t <= t) for t in apart.t]
        np.testing.assert_allclose(apart["plant.x"] + fallen, exact(apart.t, 0.5), rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_it_works_where_memory_is_not_written_in_order(mass, monkeypatch):
    end_idle()
    monkeypatch.setattr("loopwright.fmus.isolation.shared_memory.ORDERED", False)
    run = mass_loop(mass, True).simulate(0.1, compile=True, **EXACT)
    np.testing.assert_allclose(run["plant.position"], exact_loop(101), rtol=0.0, atol=1e-9)


FAULTS = {
    "error": "return 3;",
    "fatal": "return 4;",
    "crash": "volatile int *nowhere = 0; *nowhere = 1;",
    "hang": "for (;;) { volatile int never = 0; (void)never; }",
    "exit": "exit(0);",
}
QUICK = {("crash", 3)}


@pytest.mark.parametrize(
    ("fault", "fmi"),
    [
        pytest.param(fault, fmi, marks=[] if (fault, fmi) in QUICK else pytest.mark.slow)
        for fault in FAULTS
        for fmi in (2, 3)
    ],
)
def test_a_fault_within_an_evaluation_is_told_as_in_an_interpreted_run(cache, tmp_path, fault, fmi):
    file = eventful_fmu(tmp_path, fmi, fault=f"if (c->t > 0.3) {{ {FAULTS[fault]} }}")
    found = []
    for in_c in (False, True):
        with pytest.raises((FmuProcessError, FmuRuntimeError)) as caught:
            eventful(file, isolate=SHORT if fault == "hang" else True).simulate(
                1.0, step=0.1, compile=in_c, progress=False
            )
        found.append(caught.value)
    one, two = found
    assert type(one) is type(two)
    assert (str(one), one.block) == (str(two), two.block)
    assert one.t == pytest.approx(two.t, abs=1e-9)
    assert getattr(one, "cause", None) is getattr(two, "cause", None)
    assert two.run.tier == "compiled"
    for error in found:
        assert error.block == "plant"
        assert error.t == pytest.approx(0.3, abs=0.1)
        assert error.run.t.tolist() == [0.1 * k for k in range(len(error.run.t))]
        assert 0.2 <= error.run.t[-1] < 0.31
        np.testing.assert_allclose(error.run["plant.x"], exact(error.run.t, 0.5), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("place", ["EnterEventMode", "CompletedIntegratorStep"])
@pytest.mark.slow
def test_a_crash_in_an_event_or_behind_a_step_is_told_as_in_an_interpreted_run(cache, tmp_path, place):
    head = {
        "EnterEventMode": "instance *c = p; MODE(CONTINUOUS); c->mode = EVENT; return 0;",
        "CompletedIntegratorStep": "instance *c = p; MODE(CONTINUOUS);\n    c->steps++;",
    }[place]
    crash = head.replace("MODE(", f"if (c->t > 0.3) {{ {FAULTS['crash']} }} MODE(", 1)
    file = eventful_fmu(tmp_path, 3, changes=[(head, crash)])
    found = []
    for in_c in (False, True):
        with pytest.raises(FmuProcessError) as caught:
            eventful(file).simulate(1.0, step=0.1, compile=in_c, progress=False)
        found.append(caught.value)
    assert str(found[0]) == str(found[1])
    assert place in str(found[1])


def test_a_warning_within_an_evaluation_is_told_once_and_the_run_goes_on_in_c(cache, tmp_path):
    file = eventful_fmu(tmp_path, 3, fault="if (c->t > 0.3) { dx[0] = c->u + c->k; return 1; }")
    one, two = (eventful(file).simulate(1.0, step=0.1, compile=in_c, progress=False) for in_c in (False, True))
    assert two.tier == "compiled"
    told = [[m for m in run.messages if "Warning" in m] for run in (one, two)]
    assert told[0] == told[1]
    assert len(told[1]) == 1
    assert told[1][0].startswith("plant: computing the derivatives of its states gave fmi3Warning at t = 0.3")
    for run in (one, two):
        np.testing.assert_allclose(run["plant.x"], exact(run.t, 0.5), rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_evaluations_that_take_long_are_waited_for(cache, tmp_path):
    slow = "if (c->t > 0.3 && c->t < 0.5) { for (volatile long i = 0; i < 60000000; i++) continue; }"
    file = eventful_fmu(tmp_path, 3, fault=slow)
    diagram = eventful(file, isolate=True)
    run = diagram.simulate(0.6, step=0.1, compile=True, solver="heun", progress=False)
    (quick := tmp_path / "quick").mkdir()
    other = eventful(eventful_fmu(quick, 3)).simulate(0.6, step=0.1, compile=True, solver="heun", progress=False)
    assert run.tier == "compiled"
    assert run.data.tobytes() == other.data.tobytes()
    np.testing.assert_allclose(run["plant.x"], exact(run.t, 0.5), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("hangs", [False, True])
@pytest.mark.slow
def test_ctrl_c_ends_a_run_soon(cache, tmp_path, hangs):
    """Long before its end, and before the limit of a call. The FMU writes a file when it has come to t = 1 s."""
    there, forever = tmp_path / "there", "for (;;) { volatile int never = 0; (void)never; }" if hangs else ""
    tells = f'static FILE *told; if (c->t > 1.0) {{ if (!told) fclose(told = fopen("{there}", "w")); {forever} }}'
    diagram = eventful(eventful_fmu(tmp_path, 3, fault=tells), isolate=Isolation(step_time=1e4))
    diagram.simulate(0.05, step=0.05, compile=True, progress=False)
    with Interruption(there.exists), pytest.raises(Interrupted) as caught:
        diagram.simulate(1e6, step=0.05, compile=True, record=["plant.x"], every=100, progress=False)
    assert len(caught.value.run.t) > 0
    assert count_processes() in ((0, 0), (1, 1))[: 1 if hangs else 2]  # one that has answered is used again


def test_a_saved_state_tells_the_fmu_that_steps_may_be_taken_back_and_a_crash_between_two_advances_is_told(mass):
    with mass_loop(mass, True).simulation(compile=True) as simulation:
        plant = simulation._engine.exchanged.blocks["plant"]
        for saved in (False, True):
            if saved:
                simulation.save()
            simulation.advance(0.01)
            assert bool(plant._events.final.value) is not saved
        assert not plant.fmi.process.arrived
        os.kill(plant.fmi.process.pid, signal.SIGKILL)
        with pytest.raises(FmuProcessError) as caught:
            simulation.advance(0.01)
    assert caught.value.block == "plant"
    np.testing.assert_allclose(caught.value.run["plant.position"], exact_loop(21), rtol=0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.one_tier
def test_a_long_run_under_auto_is_that_of_the_matrix_exponential(mass):
    run = mass_loop(mass, True).simulate(4.0, record=["plant.position"], every=100, progress=False)
    assert run.tier in ("interpreted", "both")  # as fast as the machine is
    np.testing.assert_allclose(run["plant.position"], exact_loop(4001)[::100], rtol=0.0, atol=1e-6)


def test_python_asks_the_process_where_c_can_not_wait_for_it(mass, monkeypatch):
    monkeypatch.setattr("loopwright.fmus.isolation.fmu_process.ChildProcess.request_of", lambda self, sequence: None)
    run = mass_loop(mass, True).simulate(0.05, compile=True, progress=False)
    assert run.tier == "compiled"
    np.testing.assert_allclose(run["plant.position"], exact_loop(51), rtol=0.0, atol=1e-6)
