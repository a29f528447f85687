"""Transport delays in C's loop: the method of steps in closed form, in both forms."""

from math import factorial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import (
    Gain,
    Integrator,
    PulseTrain,
    PythonFunction,
    Relay,
    Sine,
    TransferFunction,
    TransportDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, bouncing_ball, mass_spring_damper

QUIET = {"progress": False}
pytestmark = pytest.mark.one_tier


def forms(made, duration, **options):
    """Return the runs by the virtual machine, by that under "auto", and by generated code."""
    runs = [made.simulate(duration, compile=form, **options, **QUIET) for form in (False, "auto", True)]
    assert not [m for m in runs[2].messages if m.startswith("Interpreted")]
    return runs


def delayed_feedback(delay=1.0):
    x = Integrator(name="x", initial_value=1.0)
    late = TransportDelay(delay=delay, initial_value=1.0, name="late")
    return Diagram("d", x(-1.0 * late(x.y)))


def by_steps(t, delay=1.0):
    """The solution of x'(t) = −x(t − τ) with x = 1 before: Σ (−1)ᵏ (t − (k − 1) τ)ᵏ / k! as long as that is positive."""
    terms = range(int(np.max(t) / delay) + 2)
    return sum((-1) ** k * np.clip(t - (k - 1) * delay, 0.0, None) ** k / factorial(k) for k in terms)


@pytest.mark.parametrize(
    "solver", ["auto", "RK23", "DOP853", "Radau", "BDF", "LSODA", "CVODE_BDF", "CVODE_Adams", "rk4"]
)
@pytest.mark.drawn(2)
def test_delayed_feedback_is_the_method_of_steps(solver):
    slow, machine, code = forms(delayed_feedback(), 6.0, step=0.01, solver=solver, rtol=1e-7, atol=1e-9)
    for run in (machine, code):
        assert np.max(np.abs(run["x.y"] - by_steps(run.t))) < 2e-5
        np.testing.assert_allclose(run.data, slow.data, rtol=0.0, atol=1e-12 if solver != "Radau" else 1e-6)
    assert machine.data.tobytes() == code.data.tobytes()


def test_the_past_is_kept_as_long_as_a_delay_needs_it():
    """Some 6000 steps, of which the delay spans 600: memory is used again, and there is enough of it."""
    run = delayed_feedback(0.3).simulate(3.0, step=5e-4, solver="rk4", compile=True, **QUIET)
    assert np.max(np.abs(run["x.y"] - by_steps(run.t, 0.3))) < 1e-10
    with delayed_feedback(0.3).simulation(step=5e-4, solver="rk4", compile=True) as simulation:
        simulation.advance(3.0)
        past = simulation._engine.continuous.delays
        assert past.count < 3200
        assert past.pieces[0, 0] < 2.7


def test_pulses_keep_their_edges_through_two_delays():
    first, second = TransportDelay(delay=0.13, name="first"), TransportDelay(delay=0.31, name="second")
    made = Diagram("d", Integrator(name="i")(second(first(PulseTrain(period=0.5, duty=0.2, delay=0.1)))))
    for run in forms(made, 3.0, step=0.02, solver="heun"):
        expected = sum(np.clip(run.t - (0.54 + 0.5 * k), 0, 0.1) for k in range(6))
        assert np.max(np.abs(run["i.y"] - expected)) < 1e-12


def test_a_relay_behind_a_delay_switches_at_the_times_of_its_exponentials():
    """A lag of 0.5 s is switched at 0.3 and 0.7, 0.2 s late: times of a way follow from its overshoot."""
    lag = TransferFunction(numerator=1.0, denominator=[0.5, 1.0], name="lag")
    relay = Relay(on_point=0.7, off_point=0.3, name="relay")
    late = TransportDelay(delay=0.2, name="late")(lag.y)
    made = Diagram("d", lag(1.0 - relay(late)))
    late_factor = np.exp(-0.2 / 0.5)
    peak = 1.0 - 0.3 * late_factor
    way = 0.5 * np.log(peak / 0.3)  # from a switch seen at the peak down to 0.3, and the delay, in total
    for run in forms(made, 6.0, step=0.01, rtol=1e-8, atol=1e-10):
        times = np.array([e.t for e in run.events])
        first = 0.5 * np.log(1.0 / 0.3) + 0.2
        expected = first + (way + 0.2) * np.arange(len(times))
        assert len(times) == 1 + int((6.0 - first) / (way + 0.2))
        assert np.max(np.abs(times - expected)) < 1e-6


def test_a_held_signal_jumps_at_the_output_when_its_tick_has_passed():
    @subsystem(sample_time=0.1, name="sampled")
    def sampled(u):
        return Gain(gain=2.0)(u)

    late = TransportDelay(delay=0.25, name="late")(sampled(Sine(frequency=0.3, name="source")))
    made = Diagram("d", Integrator(name="i")(late))
    held = 2.0 * np.sin(0.6 * np.pi * 0.1 * np.arange(25))
    for run in forms(made, 2.0, step=0.01, solver="RK45"):
        expected = [sum(held[k] * np.clip(t - 0.25 - 0.1 * k, 0.0, 0.1) for k in range(25)) for t in run.t]
        assert np.max(np.abs(run["i.y"] - expected)) < 1e-11


def test_a_run_goes_on_is_saved_and_branches():
    made, options = delayed_feedback(), {"step": 0.01, "solver": "RK45", "rtol": 1e-9, "atol": 1e-11}
    with made.simulation(compile=True, **options) as simulation:
        simulation.advance(1.7)
        half = simulation.save()
        simulation.advance(2.3)
        whole = simulation.run()
        simulation.restore(half)
        simulation.advance(2.3)
        again = simulation.run()
    assert again.data[-230:].tobytes() == whole.data[-230:].tobytes()
    assert np.max(np.abs(whole["x.y"] - by_steps(whole.t))) < 1e-7
    branch = made.simulate(2.3, start=half, compile=False, **options, **QUIET)
    np.testing.assert_allclose(branch["x.y"], whole["x.y"][170:], rtol=0.0, atol=1e-11)


def test_beside_a_block_of_python_and_in_a_diagram_of_many_blocks(monkeypatch):
    x = Integrator(name="x", initial_value=1.0)
    late = TransportDelay(delay=1.0, initial_value=1.0, name="late")
    minus = PythonFunction(lambda u: -u, results={"y": ()}, name="minus")
    for made in (Diagram("d", x(minus(late(x.y)))), delayed_feedback()):
        monkeypatch.setattr("loopwright.diagrams.flat.flat_diagram.LARGEST", 0)
        for run in forms(made, 3.0, step=0.01, solver="RK45", rtol=1e-9, atol=1e-11):
            assert np.max(np.abs(run["x.y"] - by_steps(run.t))) < 1e-7


# --- beside FMUs in model exchange -----------------------------------------------------------------------------------

A, B = np.array([[0.0, 1.0], [-100.0, -1.0]]), np.array([0.0, 1.0])  # the mass's default parameters
START = np.array([0.1, 0.0])


def exchanged(model, isolate):
    return Fmu(model.build(), interface="model_exchange", name="plant", isolate=isolate)


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("solver", ["RK45", "Radau", "BDF", "rk4"])
@pytest.mark.drawn(1)
def test_a_mass_of_another_tool_is_damped_late(solver, isolate):
    """F = −3 N s/m of the velocity 0.15 s ago: SciPy from delay to delay; its late acceleration is integrated."""
    delay, k, plant = 0.15, 3.0, exchanged(mass_spring_damper, isolate)
    late = TransportDelay(delay=delay, initial_value=0.0, name="late")
    after = TransportDelay(delay=delay, initial_value=0.0, name="after")
    total = Integrator(name="total")
    made = Diagram("d", plant(force=-k * late(plant.velocity)), total(after(plant.acceleration)))
    pieces = [lambda t: np.zeros_like(t)]  # the velocity from one multiple of the delay to the next
    x, expected, grid = START, [], np.arange(101) * 0.01
    for n in range(7):
        begin = n * delay
        found = solve_ivp(
            lambda t, x, of=pieces[-1]: A @ x - B * k * of(t - delay),
            (begin, begin + delay),
            x,
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
            dense_output=True,
        )
        pieces.append(lambda t, of=found.sol: of(t)[1])
        mine = grid[(grid >= begin) & (grid < begin + delay)]
        expected += [*found.sol(mine).T]
        x = found.y[:, -1]
    expected = np.array(expected)[: grid.size]
    for run in forms(made, 1.0, step=0.01, solver=solver, rtol=1e-8, atol=1e-11):
        assert np.max(np.abs(run["plant.position"] - expected[:, 0])) < (1e-6 if solver != "rk4" else 2e-5)
        assert np.max(np.abs(run["plant.velocity"] - expected[:, 1])) < (1e-5 if solver != "rk4" else 2e-4)
        late_velocity = np.concatenate([np.zeros(15), expected[: grid.size - 15, 1]])
        assert np.max(np.abs(run["total.y"] - late_velocity)) < (1e-5 if solver != "rk4" else 2e-4)


@pytest.mark.parametrize("isolate", [False, True])
def test_late_edges_reach_an_fmu_in_model_exchange(isolate):
    """A pulse from 0.1 s to 0.2 s, 0.13 s late: the exponential of the matrix."""
    plant = exchanged(mass_spring_damper, isolate)
    source = PulseTrain(period=10.0, duty=0.01, delay=0.1, amplitude=20.0)
    made = Diagram("d", plant(force=TransportDelay(delay=0.13, initial_value=0.0, name="late")(source)))

    def pushed(t):  # by a step of 20 N at t = 0
        return np.linalg.solve(A, (expm(A * max(t, 0.0)) - np.eye(2)) @ B * 20.0)

    for run in forms(made, 0.6, step=0.01, solver="DOP853", rtol=1e-10, atol=1e-12):
        expected = [expm(A * t) @ START + pushed(t - 0.23) - pushed(t - 0.33) for t in run.t]
        assert np.max(np.abs(run["plant.position"] - np.array(expected)[:, 0])) < 1e-9


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(1)
def test_what_jumps_at_an_impact_comes_out_late_with_its_jump(isolate):
    """The velocity of a ball that falls from 1 m and keeps 0.7 of it, 0.2 s late, and its integral."""
    plant = exchanged(bouncing_ball, isolate)
    late = TransportDelay(delay=0.2, initial_value=0.0, name="late")
    made = Diagram("d", Integrator(name="way", initial_value=1.0)(late(plant.velocity)))
    fall = np.sqrt(2.0 / 9.81)

    def height(t):
        begin, v = -fall, 9.81 * fall
        while t >= begin + 2.0 * v / 9.81:
            begin, v = begin + 2.0 * v / 9.81, 0.7 * v
        return v * (t - begin) - 4.905 * (t - begin) ** 2, v - 9.81 * (t - begin)

    for run in forms(made, 1.6, step=0.01, solver="heun"):  # exact for what falls, if it ends where a jump comes out
        late_ones = np.array([height(t - 0.2) if t >= 0.2 else (1.0, 0.0) for t in run.t])
        assert np.max(np.abs(run["way.y"] - late_ones[:, 0])) < 1e-8
        assert np.max(np.abs(run["late.y"] - late_ones[:, 1])) < 1e-8
