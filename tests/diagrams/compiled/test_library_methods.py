"""Steps of SciPy's and SUNDIALS' methods within C's loop: SciPy's own runs, closed forms."""

import signal

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import (
    Function,
    Gain,
    Integrator,
    PulseTrain,
    PythonFunction,
    Relay,
    SimulationError,
    Sine,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Interrupted, subsystem

METHODS = ["BDF", "LSODA", "CVODE_BDF", "CVODE_Adams"]
QUIET = {"progress": False}
T = 0.01
pytestmark = pytest.mark.one_tier


def forms(made, duration, **options):
    """Return the runs by the virtual machine, by that under "auto", and by generated code."""
    runs = [made.simulate(duration, compile=form, **options, **QUIET) for form in (False, "auto", True)]
    assert not [m for m in runs[2].messages if m.startswith("Interpreted")]
    return runs


def driven_lags():
    """Two lags in a row, of 0.2 s and 0.02 s, behind a sine of 2 rad/s."""
    first = TransferFunction(numerator=1.0, denominator=[0.2, 1.0], name="first")
    second = TransferFunction(numerator=1.0, denominator=[0.02, 1.0], name="second")
    return Diagram("lags", second(first(Sine(frequency=1.0 / np.pi, name="source"))).named("y"))


def exact_lags(t):
    """The output of the second lag, from zero."""
    A = np.array([[-5.0, 0.0, 5.0, 0.0], [50.0, -50.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -4.0, 0.0]])
    return np.array([(expm(A * time) @ [0.0, 0.0, 0.0, 2.0])[1] for time in t])


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.parametrize("rtol", [1e-5, 1e-9])
@pytest.mark.drawn
def test_lags_behind_a_sine_are_those_of_the_matrix_exponential(solver, rtol):
    slow, machine, code = forms(driven_lags(), 3.0, step=0.01, solver=solver, rtol=rtol, atol=rtol)
    for run in (machine, code):
        assert np.max(np.abs(run["y"] - exact_lags(run.t))) < 1e3 * rtol
        np.testing.assert_allclose(run.data, slow.data, rtol=0.0, atol=1e-12)  # the same steps, from the same rates
    assert machine.data.tobytes() == code.data.tobytes()


@pytest.mark.parametrize("solver", ["BDF", "LSODA"])
def test_samples_between_steps_are_those_of_scipy(solver):
    """The interpolants of its solvers, of which C has the coefficients: a nonlinear oscillator with long steps."""
    x, v = Integrator(name="x", initial_value=2.0), Integrator(name="v")
    force = Function(lambda x, v: (1.0 - x * x) * v - x, name="force")
    made = Diagram("van_der_pol", x(v(force(x.y, v.y))))

    def rates(t, states):
        x, v = states[order]
        return np.array([v, (1.0 - x * x) * v - x])[order]

    def slope(t, states):
        x, v = states[order]
        return np.array([[0.0, 1.0], [-2.0 * x * v - 1.0, 1.0 - x * x]])[np.ix_(order, order)]

    order = np.array([1, 0])  # states are taken by path: v, then x
    run = made.simulate(6.0, step=1e-2, solver=solver, rtol=1e-6, atol=1e-9, compile=True, **QUIET)
    own = solve_ivp(rates, (0.0, 6.0), [0.0, 2.0], solver, run.t, jac=slope, rtol=1e-6, atol=1e-9)
    assert own.nfev < len(run.t)  # so most samples lie between steps
    np.testing.assert_allclose([run["v.y"], run["x.y"]], own.y, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.drawn(1)
def test_a_controller_that_restarts_them_at_every_tick_is_that_of_the_matrix_exponential(solver):
    @subsystem(sample_time=T, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 2.0 * error + 5.0 * memory(memory.y + T * error)

    lag = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="lag")
    made = Diagram("loop", lag(controller(lag.y)).named("y"))
    runs = forms(made, 0.5, solver=solver, rtol=1e-8, atol=1e-10)
    decay, y, integral, expected = np.exp(-T / 0.05), 0.0, 0.0, []
    for _ in range(51):
        expected.append(y)
        error = 1.0 - y
        u = 2.0 * error + 5.0 * integral
        y, integral = decay * y + (1.0 - decay) * u, integral + T * error
    for run in runs:
        np.testing.assert_allclose(run["y"], expected, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(runs[1].data, runs[0].data, rtol=0.0, atol=1e-12)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.parametrize("rtol", [1e-5, 1e-8])
def test_a_relay_switches_at_the_instants_of_the_closed_form(solver, rtol):
    """A lag of 0.2 s between 0 and 1 is switched at 0.3 and 0.7: each way takes 0.2 s · log(7/3)."""
    relay = Relay(on_point=0.7, off_point=0.3, name="relay")
    lag = TransferFunction(numerator=1.0, denominator=[0.2, 1.0], name="lag")
    made = Diagram("d", lag(1.0 - relay(lag.y)))
    way = 0.2 * np.log(7.0 / 3.0)
    for run in forms(made, 5.0, step=0.01, solver=solver, rtol=rtol, atol=rtol):
        times = np.array([e.t for e in run.events])
        expected = 0.2 * np.log(1.0 / 0.3) + way * np.arange(len(times))
        assert len(times) == 1 + int((5.0 - expected[0]) / way)
        assert [e.event for e in run.events] == (["rise", "fall"] * len(times))[: len(times)]
        assert np.max(np.abs(times - expected)) < 1e3 * rtol


@pytest.mark.parametrize("solver", METHODS)
def test_pulses_are_landed_on_from_the_left_and_go_on_from_the_right(solver):
    made = Diagram("pulses", Integrator(name="sum")(PulseTrain(period=0.1, duty=0.3, name="source")))
    run = made.simulate(1.0, solver=solver, step=0.01, compile=True, **QUIET)
    whole, part = np.divmod(run.t + 1e-12, 0.1)
    assert np.max(np.abs(run["sum.y"] - (0.03 * whole + np.minimum(part, 0.03)))) < 1e-11


@pytest.mark.drawn(2)
@pytest.mark.parametrize("solver", METHODS)
def test_a_second_run_of_the_same_simulation_has_the_same_bits(solver):
    made = driven_lags()
    first = made.simulate(1.0, step=0.01, solver=solver, compile=True, **QUIET)
    with made.simulation(step=0.01, solver=solver, compile=True) as simulation:
        simulation.advance(0.4)
        half = simulation.save()
        simulation.advance(0.6)
        whole = simulation.run().data
        simulation.restore(half)
        simulation.advance(0.6)
        assert simulation.run().data.tobytes() == whole[40:].tobytes()
    assert np.max(np.abs(whole - first.data)) < 1e-5  # it has begun again at 0.4 s


def failures(made, duration, **options):
    """Return the errors of a run in all forms, which say the same and keep the same."""
    caught = []
    for form in (False, "auto", True):
        with pytest.raises(SimulationError) as one:
            made.simulate(duration, compile=form, **options, **QUIET)
        caught.append(one.value)
    slow = caught[0]
    for error in caught[1:]:
        assert str(error) == str(slow)
        assert (error.block, error.t) == (slow.block, slow.t)
        assert error.run.t.tobytes() == slow.run.t.tobytes()
        np.testing.assert_allclose(error.run.data, slow.run.data, rtol=1e-9, atol=1e-12)
    return slow


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.slow
def test_growth_beyond_all_bounds_says_the_same_and_keeps_the_same(solver):
    x = Integrator(name="x", initial_value=1.0)
    error = failures(Diagram("d", x(Function(lambda x: x**2, name="square")(x.y))), 2.0, step=0.01, solver=solver)
    assert error.t == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(error.run["x.y"][:-1], 1.0 / (1.0 - error.run.t[:-1]), rtol=1e-2)


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.drawn(1)
def test_a_root_that_leaves_its_domain_names_the_block_that_took_it(solver):
    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(Function(lambda x: -1.0 - np.sqrt(x), name="root")(x.y)))
    assert failures(made, 2.0, step=0.01, solver=solver).block == "root"


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.drawn(1)
def test_an_error_of_a_python_function_is_that_of_the_run(solver):
    def rate(x):
        if x > 1.5:
            raise ValueError("too far")
        return 1.0

    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(PythonFunction(rate, results={"y": ()}, name="rate")(x.y)))
    with pytest.raises(SimulationError, match="too far") as caught:
        made.simulate(2.0, step=0.01, solver=solver, **QUIET)
    assert caught.value.block == "rate"
    assert 0.3 < caught.value.run.t[-1] < 0.51


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.parametrize("place", ["rates", "between"])
@pytest.mark.drawn(1)
def test_ctrl_c_ends_it_and_keeps_what_was_recorded(solver, place):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    seen = []

    def rate(t):
        seen.append(t)
        if place == "rates" and len(seen) == 2000:
            signal.raise_signal(signal.SIGINT)
        return np.cos(5.0 * t)

    def interrupt(t):
        if place == "between" and t > 20.0:
            signal.raise_signal(signal.SIGINT)

    x = Integrator(name="x")
    clock = Integrator(name="clock")(1.0 + 0.0 * x.y)
    made = Diagram("d", x(PythonFunction(rate, results={"y": ()}, name="rate")(clock)))
    try:
        with made.simulation(step=0.01, solver=solver) as simulation, pytest.raises(Interrupted) as caught:
            simulation.advance(1e4, progress=interrupt)
    finally:
        signal.signal(signal.SIGINT, before)
    run = caught.value.run
    assert 5.0 < run.t[-1] < 1e3
    assert len(seen) < 2100 or place == "between"
    assert np.max(np.abs(run["x.y"] - np.sin(5.0 * run.t) / 5.0)) < 1e-4 * run.t[-1]


def test_the_run_says_who_takes_the_steps():
    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(Gain(gain=-1.0)(x.y)))
    for solver, library in (("BDF", "SciPy"), ("CVODE_Adams", "SUNDIALS")):
        run = made.simulate(0.1, solver=solver, compile=True, **QUIET)
        assert run.tier == "compiled"
        assert [m for m in run.messages if m.startswith(f"Compiled: {library} takes steps of {solver}")]
