"""FMUs in processes of their own under a loop in C, whose steps C asks for in both forms. The zoo's is y' = u."""

import os
import re
import signal

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Block, Compare, Integrator, Output, Sine, StopCondition
from loopwright.diagrams import Diagram, Interrupted, subsystem
from loopwright.fmus import Fmu, FmuProcessError, FmuRuntimeError, Isolation, build_fmu
from loopwright.fmus.isolation import count_processes, end_idle
from loopwright.types import FmuEnd
from support.exported import D, K, M, mass_spring_damper
from support.typed_fmus import typed_fmu
from support.waiting import Interruption
from support.zoo import zoo_fmu

SHORT = Isolation(step_time=1.0)
"""For calls that never end; no other test has a limit that a busy machine reaches."""
QUIET = {"progress": False}
ROUNDED = 1e-12  # of sums of some thousand steps
pytestmark = pytest.mark.usefixtures("no_process_left")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("zoo")


def zoo(file, name="plant", isolate=True, **options):
    return Fmu(file, name=name, isolate=isolate, **options)


def loop(*plants, period=0.01):
    """Each plant under a proportional controller: y is multiplied by 1 − 2·period at each tick."""

    def controlled(plant):
        @subsystem(sample_time=period, name=f"{plant.name}_controller")
        def controller(y):
            return 2.0 * (1.0 - y)

        return plant(u=controller(plant.y))

    return Diagram("loop", *map(controlled, plants))


def simulate(made, duration, in_c, **options):
    run = made.simulate(duration, compile=in_c, **QUIET, **options)
    assert run.tier == ("compiled" if in_c else "interpreted"), run.messages
    return run


def both(made, duration, **options):
    return (simulate(made, duration, c, **options) for c in (False, True))


def assert_same_bits(first, second):
    assert first.t.tobytes() == second.t.tobytes()
    assert first.data.tobytes() == second.data.tobytes()
    assert first.stopped == second.stopped


def pushed(t, frequency):
    """Positions of the exported mass at equal times, pushed by a sine in N that is held over each step."""
    step = expm((t[1] - t[0]) * np.array([[0.0, 1.0, 0.0], [-K / M, -D / M, 1.0 / M], [0.0, 0.0, 0.0]]))[:2]
    x, found = np.array([0.1, 0.0]), []
    for at in t:
        found.append(x[0])
        x = step @ [*x, np.sin(2.0 * np.pi * frequency * at)]
    return np.array(found)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_loop_with_an_isolated_fmu_is_compiled(folder, fmi):
    """1 − y is multiplied by 1 − 2·0.01 in each step, as the input is held over it."""
    one, two = both(loop(zoo(zoo_fmu(folder, fmi))), 5.0)
    assert_same_bits(one, two)
    assert np.allclose(1.0 - two["plant.y"], 0.98 ** np.arange(501), atol=ROUNDED)


@pytest.mark.slow
def test_several_fmus_here_and_there_share_their_ticks(folder, cache):
    file = zoo_fmu(folder, 3)
    plants = [zoo(file, "a"), zoo(file, "b", False), zoo(file, "c"), zoo(file, "d", False)]
    one, two = both(loop(*plants), 1.0)
    assert_same_bits(one, two)
    for name in "abcd":
        assert np.allclose(1.0 - two[f"{name}.y"], 0.98 ** np.arange(101), atol=ROUNDED)
    mass = Fmu(build_fmu(mass_spring_damper()), name="mass", isolate=True)
    one, two = both(Diagram("d", mass(force=Sine(name="s", frequency=3.0))), 0.5, step=1e-3)
    assert_same_bits(one, two)
    assert np.max(np.abs(two["mass.position"] - pushed(two.t, 3.0))) < 1e-9


def test_they_step_at_the_same_time(folder, meeting):
    """Each step waits until the other FMU is in its own."""
    file = zoo_fmu(folder, 3, "step meet")
    with loop(zoo(file, "a"), zoo(file, "b")).simulation(compile=True) as s:
        s.advance(0.1)
        assert s.run().tier == "compiled"
    assert meeting.count == 20


def test_it_works_where_memory_is_not_written_in_order(folder, monkeypatch):
    """There every request and reply is announced by a byte in a pipe; so it is for replies that Python takes."""
    end_idle()
    monkeypatch.setattr("loopwright.fmus.isolation.shared_memory.ORDERED", False)
    run = simulate(loop(zoo(zoo_fmu(folder, 3))), 1.0, True)
    assert np.allclose(1.0 - run["plant.y"], 0.98 ** np.arange(101), atol=ROUNDED)
    warned = simulate(loop(zoo(zoo_fmu(folder, 3, "step warning 0.5"))), 1.0, True)
    assert warned.data.tobytes() == run.data.tobytes()
    with pytest.raises(FmuProcessError, match="SIGSEGV"):
        simulate(loop(zoo(zoo_fmu(folder, 3, "step segfault 0.05"))), 1.0, True)


FAULTS = [
    "step segfault",
    "step divide_trapped",
    "step exit0",
    "step deaf_hang",
    "get segfault",
    "step log_hang",
    "step error",
    "step discard",
    "step fatal",
    "step minus",
    "step no_memory",
]


@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.drawn(1)
def test_a_fault_is_told_as_in_an_interpreted_run(folder, fault, fmi, beside):
    file = zoo_fmu(folder, fmi, f"{fault} 0.05")
    isolate = SHORT if "hang" in fault else Isolation(memory=200e6) if "memory" in fault else True
    others = [zoo(zoo_fmu(folder, fmi), "other")] if beside else []
    found = []
    for in_c in (False, True):
        with pytest.raises((FmuProcessError, FmuRuntimeError)) as caught:
            loop(zoo(file, isolate=isolate), *others).simulate(0.2, compile=in_c, **QUIET)
        found.append(caught.value)
    one, two = found
    assert type(one) is type(two)
    texts = [re.sub(r"has [\d.]+ of", "has … of", str(error)) for error in found]  # memory of the process, to the page
    assert (texts[0], one.block, one.t) == (texts[1], two.block, two.t)
    assert getattr(one, "cause", None) is getattr(two, "cause", None)
    assert_same_bits(one.run, two.run)
    assert two.run.tier == "compiled"
    assert np.allclose(1.0 - two.run["plant.y"], 0.98 ** np.arange(len(two.run.t)), atol=ROUNDED)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("fault", ["warning", "print", "slow", "rounding", "thread", "fork_on", "odd_log", "leak"])
@pytest.mark.drawn(3)
def test_an_odd_fmu_runs_on_in_c_and_its_words_are_told_once(folder, fault, fmi):
    made = loop(zoo(zoo_fmu(folder, fmi, f"step {fault} 0.05")))
    one, two = both(made, 0.2)
    assert_same_bits(one, two)
    told = [[m for m in run.messages if "t =" in m or "warning" in m or "printed" in m] for run in (one, two)]
    assert told[0] == told[1]
    if fault == "warning":
        assert len([m for m in told[1] if "a step" in m]) == 1


class Late(Block):
    """A value from 20 ms on, 1 before it."""

    value: float
    y = Output()

    def output(self, t, x, u):
        return np.where(t < 0.0195, 1.0, self.value)


LAST = {
    "Float64": 0.1,
    "Float32": 0.1,
    "Int8": -128,
    "UInt8": 200,
    "Int16": -32768,
    "UInt16": 65535,
    "Int32": -(2**31),
    "UInt32": 2**32 - 1,
    "Int64": -(2**53),
    "UInt64": 2**53,
    "Boolean": 0,
    "Real": -1e300,
    "Integer": 2**31 - 1,
}


def typed(folder, fmi, isolate=None, **values):
    """An FMU with ports of many types, each with a value of its own from 20 ms on; the outputs repeat the inputs."""
    whole = Fmu(typed_fmu(folder, fmi), name="plant", isolate=isolate)
    names = [name for name in whole.inputs if name[2:] in LAST]
    plant = whole.replace(ports=[*names, *("y" + name[1:] for name in names)])
    given = {name: values.get(name, LAST[name[2:]]) for name in names}
    return Diagram("d", plant(**{name: Late(name=f"of_{name}", value=float(v)) for name, v in given.items()})), given


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_numbers_of_every_type_pass_through(folder, fmi):
    made, given = typed(folder, fmi)
    one, two = both(made, 0.05, step=0.01)
    assert_same_bits(one, two)
    for name, value in given.items():
        held = np.float32(value) if name == "u_Float32" else value
        assert two[f"plant.y{name[1:]}"].tolist() == [1.0, 1.0, 1.0, held, held, held]


@pytest.mark.parametrize(
    ("port", "value"),
    [
        ("u_Int8", 0.5),
        ("u_Int8", 128.0),
        ("u_Int64", 2.0**53 + 2.0),
        ("u_Boolean", 2.0),
        ("u_Float32", 1e39),
        ("u_UInt16", -1.0),
    ],
)
@pytest.mark.drawn(1)
def test_an_input_that_does_not_fit_is_told_as_in_an_interpreted_run(folder, port, value):
    made, _ = typed(folder, 3, **{port: value})
    found = []
    for in_c in (False, True):
        with pytest.raises(FmuRuntimeError, match=rf"^plant\.{port}, t = 0\.02 s: found ") as caught:
            made.simulate(0.05, step=0.01, compile=in_c, **QUIET)
        found.append(caught.value)
    assert str(found[0]) == str(found[1])
    assert_same_bits(found[0].run, found[1].run)


def test_calls_are_made_in_c_or_python_with_the_same_bits(folder, monkeypatch):
    """Without the library of the other side, as with an FMU that has taken all descriptors, Python makes the calls."""
    end_idle()
    one = simulate(loop(zoo(zoo_fmu(folder, 3))), 1.0, True)
    end_idle()
    monkeypatch.setattr("loopwright.diagrams.compiled.plants_called_back.compile_other_side", lambda: None)
    two = simulate(loop(zoo(zoo_fmu(folder, 3))), 1.0, True)
    assert_same_bits(one, two)
    end_idle()
    monkeypatch.setattr("loopwright.diagrams.compiled.plants_called_back.compile_other_side", lambda: "/no/library.so")
    assert_same_bits(one, simulate(loop(zoo(zoo_fmu(folder, 3))), 1.0, True))
    assert count_processes() == (1, 1)  # it is kept


@pytest.mark.parametrize("in_c", [False, True])
def test_a_crash_between_two_advances_is_told(folder, in_c):
    with loop(zoo(zoo_fmu(folder, 3))).simulation(compile=in_c) as s:
        s.advance(0.5)
        os.kill(s._engine.plants["plant"].fmi.process.pid, signal.SIGKILL)
        with pytest.raises(FmuProcessError, match="SIGKILL") as caught:
            s.advance(0.5)
        assert caught.value.cause is FmuEnd.KILLED
        assert "memory is short" in str(caught.value)
        assert "makers" not in str(caught.value)
        assert caught.value.t == pytest.approx(0.5)


def test_states_go_between_the_forms(cache):
    """Saved compiled, restored interpreted, and the other way; two branches from one state."""
    force = Sine(name="force", frequency=3.0)
    made = Diagram("d", Fmu(build_fmu(mass_spring_damper()), name="mass", isolate=True)(force=force))
    whole = simulate(made, 1.0, True, step=0.01)
    assert np.max(np.abs(whole["mass.position"] - pushed(whole.t, 3.0))) < 1e-7
    for first, second in ((True, False), (False, True)):
        with made.simulation(compile=first, step=0.01) as s:
            s.advance(0.5)
            state = s.save()
            s.advance(0.5)
            assert s.run().data.tobytes() == whole.data.tobytes()
            s.restore(state)
            s.advance(0.5)
            assert s.run().data.tobytes() == whole.data[50:].tobytes()
        with made.simulation(compile=second, step=0.01, start=state) as s:
            s.advance(0.5)
            assert s.run().data.tobytes() == whole.data[50:].tobytes()


def test_the_change_over_makes_no_difference(folder, monkeypatch):
    monkeypatch.setattr("loopwright.diagrams.compiled.background._LEAST", 0.0)
    monkeypatch.setattr("loopwright.diagrams.simulation.change_over._PATIENCE", 0.0)
    made = loop(zoo(zoo_fmu(folder, 3)), period=1e-3)
    one, two = both(made, 5.0)
    auto = made.simulate(5.0, compile="auto", **QUIET)  # its code is there
    assert auto.tier == "both"
    assert auto.data.tobytes() == one.data.tobytes() == two.data.tobytes()


def test_a_run_is_streamed_and_stopped(folder, tmp_path):
    made = loop(zoo(zoo_fmu(folder, 3)))
    y = zoo(zoo_fmu(folder, 3))(u=1.0)
    stopping = Diagram("stop", y, StopCondition(name="end")(Compare(name="c")(y, 0.255)))
    one, two = both(stopping, 1.0, step=0.01)
    assert_same_bits(one, two)
    assert two.t[-1] == pytest.approx(0.26)
    whole = simulate(made, 1.0, True)
    streamed = simulate(made, 1.0, True, to=tmp_path / "run")
    assert streamed.data.tobytes() == whole.data.tobytes()


@pytest.mark.parametrize("fault", ["count", "slow", "deaf_hang 0.1"])
@pytest.mark.drawn(1)
def test_ctrl_c_ends_a_run_soon(folder, meeting, fault):
    """Long before its end, and before the limit of a step."""
    limits, period = Isolation(step_time=1e4), 1e-3 if fault == "count" else 0.01
    made = loop(zoo(zoo_fmu(folder, 3, f"step {fault}"), isolate=limits), period=period)
    simulate(made, 0.05, True)
    before = meeting.count
    with Interruption(lambda: meeting.count > before), pytest.raises(Interrupted) as caught:
        made.simulate(1e5, compile=True, record=["plant.y"], every=100, **QUIET)
    assert len(caught.value.run.t) > 0


def test_what_c_does_not_step_python_does_for_it(folder):
    """Ports of other types in this process, and enumerations with gaps: each step is Python's, the ticks are C's."""
    plants = [typed(folder, 3, isolate=False)[0], Fmu(typed_fmu(folder, 2), name="plant")]
    for plant in plants:
        if isinstance(plant, Fmu):
            plant = plant(**{name: np.ones(port.shape) if port.shape else 1.0 for name, port in plant.inputs.items()})
        made = plant if isinstance(plant, Diagram) else Diagram("d", plant)
        one, two = both(made, 0.05, step=0.01)
        assert_same_bits(one, two)
        for name in ("Float64", "Int32") if plant is plants[0] else ("Real",):
            last = LAST[name] if plant is plants[0] else 1.0
            assert two[f"plant.y_{name}"].tolist() == [1.0, 1.0, 1.0, last, last, last]


def beside(folder, fault="", isolate=True):
    """x' = −x, and plants that integrate it: y = 1 − x but for the inputs that are held over each step."""
    x = Integrator(name="x", initial_value=1.0)
    files = [zoo_fmu(folder, 3, fault), zoo_fmu(folder, 3)]
    plants = [zoo(file, name, isolate)(u=x.y) for name, file in zip("ab", files, strict=True)]
    return Diagram("d", x(-1.0 * x.y), *plants)


@pytest.mark.parametrize("solver", ["rk4", "RK45"])
@pytest.mark.drawn(1)
def test_fmus_stand_beside_continuous_states(folder, solver):
    one, two = both(beside(folder), 1.0, step=0.01, solver=solver)
    if solver == "rk4":
        assert_same_bits(one, two)
    held = 0.01 * np.concatenate([[0.0], np.cumsum(np.exp(-two.t[:-1]))])
    assert np.allclose(two["a.y"], held, atol=1e-9 if solver == "rk4" else 1e-5)
    assert np.allclose(two["b.y"], two["a.y"], atol=0)


@pytest.mark.parametrize("fault", ["warning", "slow", "segfault", "error", "deaf_hang"])
@pytest.mark.drawn(1)
def test_faults_beside_continuous_states_are_told_as_in_an_interpreted_run(folder, fault):
    made, found = beside(folder, f"step {fault} 0.05", SHORT if "hang" in fault else True), []
    for in_c in (False, True):
        options = {"step": 0.01, "solver": "rk4", "compile": in_c, **QUIET}
        if fault in ("warning", "slow"):
            run, text = made.simulate(0.1, **options), ""
            text = [m for m in run.messages if "warning" in m]
        else:
            with pytest.raises((FmuProcessError, FmuRuntimeError)) as caught:
                made.simulate(0.1, **options)
            run, text = caught.value.run, str(caught.value)
        assert run.tier == ("compiled" if in_c else "interpreted")
        found.append((run, text))
    assert_same_bits(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]


def test_a_fused_run_asks_isolated_fmus_as_well(folder):
    made = loop(zoo(zoo_fmu(folder, 3)))
    run = made.simulate(1.0, fuse=True, **QUIET)
    assert run.tier == "compiled"
    assert np.allclose(1.0 - run["plant.y"], 0.98 ** np.arange(101), atol=ROUNDED)


def test_two_runs_take_turns_at_their_processes(folder):
    made = loop(zoo(zoo_fmu(folder, 3)))
    whole = simulate(made, 1.0, True)
    with made.simulation(compile=True) as one, made.simulation(compile=True) as two:
        for _ in range(4):
            one.advance(0.25)
            two.advance(0.25)
        for s in (one, two):
            assert s.run().data.tobytes() == whole.data.tobytes()
    assert count_processes() == (2, 2)
