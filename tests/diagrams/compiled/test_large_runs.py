"""Large diagrams in C's loop without a compiler: programs of the virtual machine for each kind of block."""

import gc
import weakref

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Compare,
    Gain,
    Integrator,
    Lookup1D,
    Product,
    PulseTrain,
    PythonFunction,
    Relay,
    SimulationError,
    Sine,
    StateSpace,
    Sum,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import background, bind_call, compile_code, grouped_functions
from loopwright.diagrams.flat import flat_diagram, kinds_of
from loopwright.diagrams.simulation import change_over
from support.both_forms import assert_same_bits

pytestmark = pytest.mark.one_tier
QUIET = {"progress": False}


@pytest.fixture(autouse=True)
def grouped(monkeypatch):
    """Every diagram is evaluated block by block."""
    monkeypatch.setattr(flat_diagram, "LARGEST", 0)


@pytest.fixture
def swapped(monkeypatch):
    """Generated code is there at the third look at a run, without a thread."""
    looks = []

    class Later:
        def __init__(self, target, args, **_):
            self.start = lambda: target(*args)

    look = background.BackgroundCode.look

    def counted(self, spent, rest):
        looks.append(spent)
        if len(looks) > 3:
            look(self, spent, 1e9)

    monkeypatch.setattr(background, "Thread", Later)
    monkeypatch.setattr(background.BackgroundCode, "look", counted)
    monkeypatch.setattr(change_over, "_PATIENCE", -1.0)


def sampled(inside, every=0.01):
    return Diagram("d", subsystem(sample_time=every, name="box")(inside)(Sine(frequency=3.0, name="source")))


def parallel(n):
    """(g u − 0.3) u for n gains g."""

    def inside(u):
        made = []
        for i in range(n):
            part = Gain(gain=1.0 + 0.37 * i, name=f"g{i}")(u)
            made.append(Product(name=f"p{i}")(Sum(signs="+-", name=f"s{i}")(part, 0.3), u))
        return made

    return sampled(inside)


def test_a_run_that_has_ended_is_not_kept_by_the_code_of_the_next_one():
    flat = parallel(3).flatten()
    code = compile_code(flat, kinds_of(flat, every=False))
    x = flat.x0.copy()
    results = [np.zeros(n) for n in (x.size, flat.plant_inputs.total, flat.log.total, 1)]
    call = bind_call(
        next(iter(code.ticks.values())), [np.zeros(1), x, np.zeros(flat.plant_outputs.total), flat.p], results
    )
    call()
    ended = weakref.ref(results[2])
    del call, results
    gc.collect()
    assert ended() is None


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 32, 35])
def test_blocks_that_are_evaluated_together_have_the_bits_of_numpy(all_in_c, n):
    run = parallel(n).simulate(2.0, **QUIET)
    u = run["source.y"]
    for i in range(n):
        assert np.array_equal(run[f"box.p{i}.y"], ((1.0 + 0.37 * i) * u - 0.3) * u)


def gated():
    """A triggered counter within an enabled subsystem of another rate, with a delay beside it."""

    @subsystem(sample_time=0.02, enabled="reset", name="outer")
    def outer(u):
        late = subsystem(sample_time=0.06, delay=1, name="late")(lambda v: Gain(gain=-2.0, name="g")(v))(u)

        @subsystem(name="inner", triggered="rising")
        def inner():
            memory = UnitDelay(initial_value=1.0, name="n")
            return memory(memory.y + 1.0)

        return inner(trigger=Compare(">")(u, 0.3)) + late

    return Diagram("d", outer(Sine(frequency=4.0), enable=PulseTrain(period=0.5, duty=0.6)).named("y"))


def with_table():
    def inside(u):
        table = Lookup1D(breakpoints=[-1.0, 0.0, 0.5, 1.0], values=[2.0, -1.0, 0.25, 3.0], name="table")
        return Gain(gain=2.0, name="g")(table(u)) + u

    return sampled(inside)


def with_python(function=lambda x, u: float(np.tanh(x) + u)):
    def inside(u):
        memory = UnitDelay(initial_value=0.5, name="memory")
        return memory(0.5 * PythonFunction(function, name="python")(memory.y, u))

    return sampled(inside)


@pytest.mark.parametrize("make", [gated, with_table, with_python, lambda: parallel(20)])
def test_programs_have_the_bits_of_generated_code(all_in_c, make):
    """What the bits are is held against NumPy above and below; here it is that both forms evaluate the same."""
    own = make().simulate(3.0, **QUIET)
    for form in (False, True):
        assert_same_bits(own, make().simulate(3.0, compile=form, **QUIET))


def test_subsystems_that_are_enabled_and_triggered_act_as_a_loop_by_hand(all_in_c):
    """Ticks of 0.02 s, of which 15 out of 25 are enabled; at every third the delay's value is put out."""
    run = gated().simulate(3.0, **QUIET)
    counts, shown, late, delayed, above, expected = 1.0, 1.0, 0.0, 0.0, False, []
    for k, u in enumerate(run["sine.y"]):
        if k % 25 < 15:
            if k % 25 == 0:
                counts, delayed = 1.0, 0.0
            if k % 3 == 0:
                late, delayed = delayed, -2.0 * u
            if u > 0.3 and not above:
                shown, counts = counts, counts + 1.0
            above = u > 0.3
        expected.append(shown + late)
    assert run["y"].tolist() == expected
    assert set(run["outer.inner.n.y"]) == {1.0, 2.0}


def test_a_table_is_interpolated_and_a_function_of_python_is_called(all_in_c):
    run = with_table().simulate(2.0, **QUIET)
    expected = 2.0 * np.interp(run["source.y"], [-1.0, 0.0, 0.5, 1.0], [2.0, -1.0, 0.25, 3.0])
    assert np.max(np.abs(run["box.g.y"] - expected)) < 1e-14
    run, x = with_python().simulate(2.0, **QUIET), 0.5
    for u, found in zip(run["source.y"], run["box.memory.y"], strict=True):
        assert found == x
        x = 0.5 * float(np.tanh(x) + u)


def ring(n, rate=5.0):
    """Lags x' = rate (u − x), each driven by 0.3 times the difference of two others; and their matrix."""
    lags = [
        StateSpace(A=[[-rate]], B=[rate], C=[1.0], D=0.0, initial_state=float(i == 0), name=f"x{i}") for i in range(n)
    ]
    calls, a = [], -np.eye(n)
    for i, lag in enumerate(lags):
        one, other = (i + 1) % n, (7 * i + 3) % n
        a[i, one] += 0.3
        a[i, other] -= 0.3
        calls.append(lag(Gain(gain=0.3, name=f"g{i}")(Sum(signs="+-", name=f"s{i}")(lags[one].y, lags[other].y))))
    return Diagram("ring", *calls), rate * a


@pytest.mark.parametrize("solver", ["rk4", "RK45", "DOP853", "Radau", "auto"])
def test_rates_and_their_derivative_give_the_matrix_exponential_with_the_bits_of_generated_code(all_in_c, solver):
    made, matrix = ring(20)
    options = {"step": 0.01, "solver": solver, "rtol": 1e-9, "atol": 1e-11, **QUIET}
    run = made.simulate(1.0, **options)
    start, end = ([run[f"x{i}.y"][k] for i in range(20)] for k in (0, -1))
    assert np.max(np.abs(np.array(end) - expm(matrix) @ start)) < 1e-7
    assert_same_bits(run, made.simulate(1.0, compile=True, **options))


def thermostats(n=5):
    """Rooms x' = u − x whose heating u switches between 2 and 0 at 0.9 and 1.1 + i / 10."""
    calls = []
    for i in range(n):
        room = TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name=f"room{i}")
        relay = Relay(on_point=-0.9, off_point=-1.1 - 0.1 * i, on_value=2.0, off_value=0.0, name=f"heating{i}")
        calls.append(room(relay(Sum(signs="-", name=f"minus{i}")(room.y))))
    return Diagram("thermostats", *calls)


def test_indicators_and_jumps_find_the_events_of_the_closed_form():
    run = thermostats().simulate(8.0, step=0.05, rtol=1e-9, atol=1e-11, **QUIET)
    for i in range(5):
        high = 1.1 + 0.1 * i
        down, up = np.log(high / 0.9), np.log((2.0 - 0.9) / (2.0 - high))
        times = np.log(2.0 / (2.0 - high)) + np.cumsum([0.0, *([down, up] * 20)])
        found = [event.t for event in run.events if event.block == f"heating{i}"]
        assert found == pytest.approx(times[times < 8.0], abs=1e-7)
    assert_same_bits(run, thermostats().simulate(8.0, step=0.05, rtol=1e-9, atol=1e-11, compile=True, **QUIET))


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (lambda: parallel(20), {}),
        (thermostats, {"step": 0.005}),
        (lambda: ring(20)[0], {"step": 0.002, "solver": "rk4"}),
        (lambda: ring(20)[0], {"step": 0.002, "solver": "Radau"}),
    ],
)
@pytest.mark.drawn(2)
def test_it_makes_no_difference_when_generated_code_takes_over(swapped, make, options):
    run = make().simulate(20.0, **options, **QUIET)
    assert run.tier == "both"
    whole = make().simulate(20.0, compile=True, **options, **QUIET)
    assert run.data.tobytes() == whole.data.tobytes()


def test_a_run_traces_no_function_of_the_whole_diagram(monkeypatch):
    """But it does in a small diagram, so that the count can tell."""
    traced = []
    for name in ("trace_tick", "trace_between"):
        trace = getattr(flat_diagram.flat_functions, name)
        told = lambda *a, of=trace, name=name, **more: (traced.append(name), of(*a, **more))[1]  # noqa: E731
        monkeypatch.setattr(flat_diagram.flat_functions, name, told)
    found = []
    for largest in (0, 10_000):
        monkeypatch.setattr(flat_diagram, "LARGEST", largest)
        parallel(20).simulate(2.0, **QUIET)
        ring(20)[0].simulate(1.0, step=0.01, solver="rk4", **QUIET)
        found.append(set(traced))
    assert found == [set(), {"trace_tick", "trace_between"}]


def test_an_error_of_a_block_of_python_is_raised_with_its_path_and_time():
    """sin(6π t) is below −0.5 at t = 0.2 s for the first time."""

    def fails(x, u):
        if u < -0.5:
            raise ValueError("too low")
        return x + u

    found = []
    for form in ("auto", False):
        with pytest.raises(SimulationError, match=r"box\.python, t = .* too low") as caught:
            with_python(fails).simulate(2.0, compile=form, **QUIET)
        found.append((str(caught.value), caught.value.run.data.tobytes()))
        assert caught.value.t == pytest.approx(0.2, abs=1e-12)
        assert caught.value.run.t[-1] == pytest.approx(0.19, abs=1e-12)
    assert found[0] == found[1]


def test_an_error_between_ticks_names_the_block_of_python():
    def fails(u):
        if u > 0.9:
            raise ValueError("too large")
        return u

    python = PythonFunction(fails, arguments={"u": ()}, results={"y": ()}, name="python")
    made = Diagram("failing", Integrator(name="sum")(python(Sine(frequency=1.0, name="source"))))
    with pytest.raises(SimulationError, match=r"python, t = 0\.178\d* s: its output failed: ValueError"):
        made.simulate(0.5, step=1e-3, **QUIET)


def test_an_error_of_casadi_within_a_table_is_raised_where_python_evaluates_it(monkeypatch):
    bind, fails = grouped_functions.bind_function, []

    def bound(*given):
        made = bind(*given)
        call = made.call

        def refuse():
            if fails:
                raise RuntimeError("no value")
            call()

        made.call = refuse
        return made

    monkeypatch.setattr(grouped_functions, "bind_function", bound)
    with with_table().simulation() as simulation:
        simulation.advance(1.5)
        fails.append(True)
        with pytest.raises(RuntimeError, match="no value"):
            simulation.advance(1.5)


def test_an_interrupt_in_a_block_of_python_ends_the_run():
    calls = []

    def interrupted(x, u):
        calls.append(1)
        if len(calls) == 160:
            raise KeyboardInterrupt
        return x + u

    with with_python(interrupted).simulation() as simulation, pytest.raises(KeyboardInterrupt) as caught:
        simulation.advance(5.0)
    assert 1.4 < caught.value.run.t[-1] < 1.6
