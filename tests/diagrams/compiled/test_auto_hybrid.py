"""compile="auto" with continuous states: generated code takes over from the virtual machine within a run."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Compare,
    Constant,
    Integrator,
    Relay,
    Sine,
    State,
    StopCondition,
    Sum,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Run, subsystem
from loopwright.diagrams.compiled import background, compiled_libraries
from loopwright.diagrams.simulation import change_over
from loopwright.fmus import Fmu, dc_motor
from support.both_forms import assert_same_bits

pytestmark = pytest.mark.one_tier  # see `test_machine_runs.py`, too
QUIET = {"progress": False}
T = 1e-3


def controlled():
    """A PI controller at 1 kHz around two lags."""

    @subsystem(sample_time=T, name="controller")
    def controller(r, y):
        integral, e = UnitDelay(initial_value=0.0, name="integral"), r - y
        integral(integral.y + 3.0 * T * e)
        return 2.0 * e + integral.y

    first = TransferFunction(numerator=1.0, denominator=[0.1, 1.0], name="first")
    second = TransferFunction(numerator=1.0, denominator=[0.3, 1.0], name="second")
    return Diagram("pi", second(first(controller(Constant(value=1.0, name="r"), second.y))))


def thermostat(*more):
    """Temperature y' = u − y; the heating u switches between 2 and 0 at 0.9 and 1.1."""
    lag = TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name="room")
    heating = Relay(on_point=-0.9, off_point=-1.1, on_value=2.0, off_value=0.0, name="heating")
    heated = lag(heating(Sum(signs="-", name="minus")(lag.y)))
    return Diagram("thermostat", heated, *(make(lag.y) for make in more))


@pytest.fixture
def eager(monkeypatch):
    """Generated code is there at the first look at a run, without a thread."""

    class AtOnce:
        def __init__(self, target, args, **_):
            self.start = lambda: target(*args)

    monkeypatch.setattr(change_over, "_PATIENCE", -1.0)
    for name in ("_WRITING", "_COMPILING"):
        monkeypatch.setattr(background, name, 0.0)
    monkeypatch.setattr(background, "_LEAST", -1.0)
    monkeypatch.setattr(background, "Thread", AtOnce)
    monkeypatch.setattr(change_over, "_REPORTED", [])


def test_many_ticks_are_those_of_the_matrix_exponential(eager):
    run = controlled().simulate(20.0, rtol=1e-8, atol=1e-10, **QUIET)
    assert run.tier == "both"
    assert run.messages == ()
    a, b = np.array([[-10.0, 0.0], [1 / 0.3, -1 / 0.3]]), np.array([10.0, 0.0])
    whole = expm(np.block([[a, b[:, None]], [np.zeros((1, 3))]]) * T)
    x, integral = np.zeros(2), 0.0
    for k in range(2000):
        assert abs(run["second.y"][k] - x[1]) < 1e-6
        e = 1.0 - x[1]
        u = 2.0 * e + integral
        integral += 3.0 * T * e
        x = whole[:2, :2] @ x + whole[:2, 2] * u


def test_code_takes_over_where_events_are_many(eager):
    run = thermostat().simulate(20.0, step=0.05, rtol=1e-9, atol=1e-11, **QUIET)
    assert run.tier == "both"
    assert len(run.t) == 401
    assert np.array_equal(run.t, np.arange(401) / 20)
    first = -np.log(1.0 - 1.1 / 2.0)
    down, up = np.log(1.1 / 0.9), np.log((2.0 - 0.9) / (2.0 - 1.1))
    times = first + np.cumsum([0.0, *([down, up] * 60)])
    expected = times[times < 20.0]
    assert [e.t for e in run.events] == pytest.approx(expected, abs=1e-7)
    last = expected[-1]
    at_end = 1.1 * np.exp(last - 20.0) if len(expected) % 2 else 2.0 - 1.1 * np.exp(last - 20.0)
    assert run["room.y"][-1] == pytest.approx(at_end, abs=1e-7)


def test_changes_of_the_method_that_are_left_out_are_told_once():
    class VanDerPol(Block):
        """Van der Pol's oscillator: x' = v, v' = 200 (1 - x²) v - x."""

        x = State(start=1.0, output=True)
        v = State()

        def derivative(self, t, x, u):
            return x.v, 200.0 * (1.0 - x.x**2) * x.v - x.x

    run = Diagram("oscillator", VanDerPol()).simulate(3000.0, compile=True, **QUIET)
    changes = [message for message in run.messages if "→" in message]
    assert len(changes) == 10
    assert run.messages.count("… and more such changes") == 1


def test_the_instant_of_the_change_depends_on_no_cache(eager):
    bits = {thermostat().simulate(5.0, step=0.05, **QUIET).data.tobytes() for _ in range(2)}
    compiled_libraries.load_compiled.cache_clear()
    bits.add(thermostat().simulate(5.0, step=0.05, **QUIET).data.tobytes())
    assert len(bits) == 1


def test_code_takes_over_beside_an_fmu(eager):
    plant = Fmu(dc_motor.build(), name="plant")
    lag = TransferFunction(numerator=1.0, denominator=[0.01, 1.0], name="lag")
    made = Diagram("loop", plant(voltage=lag(Sine(frequency=2.0, name="source")), load_torque=0.0))
    run = made.simulate(0.4, step=T, **QUIET)
    assert run.tier == "both"
    R, L, K, J, b, w = 1.2, 2e-3, 0.05, 2e-5, 1e-5, 4.0 * np.pi
    step = expm(T * np.array([[-R / L, -K / L, 1.0 / L], [K / J, -b / J, 0.0], [0.0, 0.0, 0.0]]))[:2]
    lagged = expm(T * np.array([[-100.0, 100.0, 0.0], [0.0, 0.0, w], [0.0, -w, 0.0]]))  # of the lag, sine and cosine
    x, voltage, expected = np.zeros(2), np.array([0.0, 0.0, 1.0]), []
    for _ in range(401):
        expected.append(x[1])
        x, voltage = step @ [*x, voltage[0]], lagged @ voltage
    assert np.max(np.abs(run["plant.speed"] - expected)) < 1e-5  # the FMU's own steps of 0.1 ms
    interpreted = made.simulate(0.4, step=T, compile=False, **QUIET)
    assert np.array_equal(run.t, interpreted.t)
    assert np.max(np.abs(run["plant.speed"] - interpreted["plant.speed"])) < 1e-9


def test_pieces_disk_saved_states_and_every_nth_sample(eager, tmp_path):
    made = thermostat()
    interpreted = made.simulate(10.0, step=0.05, compile=False, every=3, **QUIET)
    stored = made.simulate(10.0, step=0.05, every=3, to=tmp_path / "run", **QUIET)
    assert Run.open(tmp_path / "run").tier == "both"
    with made.simulation(step=0.05, every=3) as simulation:
        simulation.advance(4.0)
        state = simulation.save()
        simulation.advance(6.0)
        pieces = simulation.run()
    again = made.simulate(6.0, step=0.05, start=state, compile=False, **QUIET)
    for run in (stored, pieces):
        assert np.array_equal(run.t, interpreted.t)
        assert len(run.events) == len(interpreted.events)
        assert np.max(np.abs(run.data - interpreted.data)) < 1e-5
    assert again["room.y"][-1] == pytest.approx(interpreted["room.y"][-1], abs=1e-5)


def test_a_stop_condition_ends_it_in_c_at_its_event(eager):
    def counted(y):
        total = Integrator(name="total")(y)
        return StopCondition(name="stop")(Compare(">", name="full")(total, 5.0))

    run = thermostat(counted).simulate(20.0, step=0.05, rtol=1e-9, atol=1e-11, **QUIET)
    assert run.tier == "both"
    assert run.stopped.block == "stop"
    assert run["total.y"][-1] == pytest.approx(5.0, abs=1e-7)


def test_without_a_compiler_the_virtual_machine_goes_on(eager, monkeypatch):
    from loopwright.diagrams.compiled import diagram_code

    monkeypatch.setattr(diagram_code, "load_compiled", _fail)
    runs = [thermostat().simulate(10.0, step=0.05, **QUIET) for _ in range(2)]
    assert [len(run.messages) for run in runs] == [1, 0]
    assert "no such compiler" in runs[0].messages[0]
    assert_same_bits(thermostat().simulate(10.0, step=0.05, compile=False, **QUIET), runs[0])


def _fail(*_):
    from loopwright.blocks.core import CompilerError

    raise CompilerError("no such compiler.")


def test_samples_of_a_sweep_have_the_bits_of_single_runs_whatever_ran_before(eager):
    made, gains = thermostat(), [1.0, 0.8, 1.2]
    options = {"step": 0.05, "compile": "auto", **QUIET}
    found = made.sweep({"room.numerator": gains}, duration=8.0, signals=["room.y"], workers=1, **options)
    for i, gain in enumerate(gains):
        single = made.replace({"room.numerator": gain}).simulate(8.0, **options)
        assert single.tier == "both"
        assert np.array_equal(found["room.y"][i], single["room.y"])


def test_an_end_between_two_ticks_is_reached(eager):
    run = thermostat().simulate(0.9, step=0.75, **QUIET)  # the first event is at 0.7985 s
    assert run.stopped is None
    assert run.t.tolist() == [0.0, 0.75, 0.9]
    assert len(run.events) == 1
