"""Runs with continuous states in C: closed forms and matrix exponentials, in both forms of a diagram's functions."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    Function,
    Gain,
    GuardError,
    Integrator,
    PulseTrain,
    Requirement,
    SimulationError,
    Sine,
    StopCondition,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Interrupted, Run, subsystem
from loopwright.fmus import Fmu, FmuRuntimeError, dc_motor
from support.zoo import zoo_fmu

QUIET = {"progress": False}
T = 1e-3


def compiled(made, duration, **options):
    """Run a diagram in C, and see that it did."""
    run = made.simulate(duration, compile=True, **QUIET, **options)
    assert not any(message.startswith("Interpreted") for message in run.messages)
    return run


def loop_with_lags():
    """A PI controller at 1 kHz around two lags."""

    @subsystem(sample_time=T, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 2.0 * error + 5.0 * memory(memory.y + T * error)

    first = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="first")
    second = TransferFunction(numerator=1.0, denominator=[0.02, 1.0], name="second")
    return Diagram("loop", second(first(controller(second.y))).named("y"))


def exact_lags(n):
    """The output of that loop at n ticks after the start, by the exponential of a matrix."""
    A = np.array([[-20.0, 0.0], [50.0, -50.0]])
    step = expm(T * np.vstack([np.hstack([A, [[20.0], [0.0]]]), np.zeros((1, 3))]))
    x, integral, found = np.zeros(2), 0.0, []
    for _ in range(n + 1):
        found.append(x[1])
        error = 1.0 - x[1]
        x, integral = step[:2, :2] @ x + step[:2, 2] * (2.0 * error + 5.0 * integral), integral + T * error
    return np.array(found)


@pytest.mark.parametrize(
    ("solver", "bound"),
    [("euler", 8e-3), ("heun", 2e-4), ("rk4", 3e-8), ("RK23", 1e-6), ("RK45", 1e-10), ("DOP853", 1e-13)],
)
@pytest.mark.drawn(3)
def test_a_controller_around_two_lags_is_that_of_the_matrix_exponential(solver, bound):
    run = compiled(loop_with_lags(), 0.5, solver=solver)
    assert np.max(np.abs(run["y"] - exact_lags(500))) < bound
    interpreted = loop_with_lags().simulate(0.5, solver=solver, **QUIET)
    assert run.t.tobytes() == interpreted.t.tobytes()
    assert np.max(np.abs(run.data - interpreted.data)) < 1e-13


def oscillator(omega=5.0):
    x = Integrator(name="x", initial_value=1.0)
    v = Integrator(name="v")
    return Diagram("oscillator", x(v(Gain(gain=-(omega**2))(x.y))))


@pytest.mark.drawn
@pytest.mark.parametrize("solver", ["RK23", "RK45", "DOP853"])
@pytest.mark.parametrize("rtol", [1e-4, 1e-7, 1e-10])
def test_samples_between_steps_are_those_of_the_closed_form(solver, rtol):
    run = compiled(oscillator(), 4.0, solver=solver, rtol=rtol, atol=rtol)
    interpreted = oscillator().simulate(4.0, solver=solver, rtol=rtol, atol=rtol, **QUIET)
    error, usual = (np.max(np.abs(r["x.y"] - np.cos(5.0 * r.t))) for r in (run, interpreted))
    assert len(run.t) == 1001
    assert error < 1.05 * usual + 1e-13
    assert error < 2e3 * rtol


def test_pulses_are_landed_on_from_the_left_and_go_on_from_the_right():
    made = Diagram("pulses", Integrator(name="sum")(PulseTrain(period=0.1, duty=0.3, name="source")))
    run = compiled(made, 1.0, solver="RK45")
    whole, part = np.divmod(run.t + 1e-12, 0.1)
    assert np.max(np.abs(run["sum.y"] - (0.03 * whole + np.minimum(part, 0.03)))) < 1e-11
    assert np.array_equal(run["source.y"], made.simulate(1.0, solver="RK45", **QUIET)["source.y"])


def test_several_rates_hold_their_outputs_between_their_ticks():
    @subsystem(sample_time=0.02, name="slow")
    def slow(u):
        return Gain(gain=-1.0)(u)

    @subsystem(sample_time=0.03, offset=0.01, name="fast")
    def fast(u):
        return Gain(gain=-2.0)(u)

    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("rates", x(slow(x.y) + fast(x.y)))
    run = compiled(made, 1.0, solver="rk4", step=0.005)
    value, held, expected = 1.0, [-1.0, -2.0], []
    for k in range(201):
        held = [-value if k % 4 == 0 else held[0], -2.0 * value if k >= 2 and (k - 2) % 6 == 0 else held[1]]
        expected.append(value)
        value += 0.005 * sum(held)
    assert np.max(np.abs(run["x.y"] - expected)) < 1e-13


def test_an_fmu_steps_at_ticks_beside_continuous_states():
    @subsystem(sample_time=T, name="controller")
    def controller(speed):
        return 0.05 * (10.0 - speed)

    plant = Fmu(dc_motor.build(), name="plant")
    lag = TransferFunction(numerator=1.0, denominator=[0.01, 1.0], name="lag")
    made = Diagram("loop", plant(voltage=lag(controller(plant.speed)), load_torque=0.02))
    run, interpreted = compiled(made, 0.3, solver="RK45"), made.simulate(0.3, solver="RK45", **QUIET)
    R, L, K, J, b = 1.2, 2e-3, 0.05, 2e-5, 1e-5
    motor = np.array([[-R / L, -K / L, 1.0 / L, 0.0], [K / J, -b / J, 0.0, -1.0 / J], [0.0] * 4, [0.0] * 4])
    step, decay, x, held, expected = expm(T * motor), np.exp(-T / 0.01), np.zeros(2), 0.0, []
    for _ in range(301):
        expected.append((x[1], held))
        x, held = (step @ [*x, held, 0.02])[:2], decay * held + (1.0 - decay) * 0.05 * (10.0 - x[1])
    for found in (run, interpreted):
        assert np.max(np.abs(found["plant.speed"] - [speed for speed, _ in expected])) < 1e-5  # the FMU's own steps
        assert np.max(np.abs(found["lag.y"] - [voltage for _, voltage in expected])) < 1e-6
    assert run.t.tobytes() == interpreted.t.tobytes()
    assert np.max(np.abs(run.data - interpreted.data)) < 1e-12 * np.max(np.abs(interpreted.data))


def test_a_stop_condition_ends_it_at_a_sample_between_steps():
    made = Diagram("d", StopCondition(name="stop")(Compare(">")(Integrator(name="x")(Sine(frequency=0.2)), 0.5)))
    w = 0.4 * np.pi
    end = np.arccos(1.0 - 0.5 * w) / w  # of x = (1 − cos w t) / w
    for form in (False, True):
        run = made.simulate(3.0, solver="rk4", step=0.01, compile=form, **QUIET)
        assert run.stopped.t == run.t[-1] == pytest.approx(end, abs=1e-9)
        assert np.max(np.abs(run["x.y"] - (1.0 - np.cos(w * run.t)) / w)) < 1e-9


def test_a_run_goes_on_is_saved_and_branches_between_both_forms():
    made = loop_with_lags()
    whole = made.simulate(0.4, **QUIET)
    assert np.max(np.abs(whole["y"] - exact_lags(400))) < 1e-9
    with made.simulation(compile=True) as simulation:
        simulation.advance(0.1)
        simulation.advance(0.1)
        half = simulation.save()
        simulation.advance(0.2)
        assert np.max(np.abs(simulation.run().data - whole.data)) < 1e-13
        simulation.restore(half)
        simulation.advance(0.2)
        assert np.max(np.abs(simulation.run().data - whole.data[200:])) < 1e-13
    assert np.max(np.abs(made.simulate(0.2, start=half, **QUIET).data - whole.data[200:])) < 1e-13


def test_what_is_recorded_does_not_depend_on_chunks(monkeypatch):
    whole = compiled(oscillator(), 4.0, solver="RK45")
    monkeypatch.setattr("loopwright.diagrams.simulation.ticks_in_c.FIRST", 7)
    parts = compiled(oscillator(), 4.0, solver="RK45")
    assert whole.data.tobytes() == parts.data.tobytes()
    every = compiled(oscillator(), 4.0, solver="RK45", every=7)
    assert np.array_equal(every.data[:-1], whole.data[::7][: len(every.t) - 1])


def test_the_run_says_which_solver_ran():
    assert [m for m in compiled(oscillator(), 1.0).messages if "Dormand-Prince 5(4) (RK45)" in m and "Radau" in m]


def test_growth_beyond_all_bounds_says_the_same_and_keeps_the_same():
    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(Function(lambda x: x**2, name="square")(x.y)))
    runs = []
    for form in (False, True):
        with pytest.raises(SimulationError) as caught:
            made.simulate(2.0, solver="RK45", compile=form, **QUIET)
        runs.append((caught.value.block, caught.value.run))
    assert runs[0][0] == runs[1][0]
    assert np.allclose(runs[1][1]["x.y"][:-1], 1.0 / (1.0 - runs[1][1].t[:-1]), rtol=1e-3)
    assert abs(len(runs[0][1].t) - len(runs[1][1].t)) <= 1


def test_a_clock_is_integrated():
    run = compiled(Diagram("d", Integrator(name="x")(Clock())), 2.0, solver="DOP853")
    assert np.max(np.abs(run["x.y"] - 0.5 * run.t**2)) < 1e-12


def failing(error, made, duration, **options):
    """Return the errors of an interpreted and of a compiled run."""
    caught = []
    for form in (False, True):
        with pytest.raises(error) as one:
            made.simulate(duration, compile=form, **QUIET, **options)
        caught.append(one.value)
    assert caught[0].block == caught[1].block
    assert caught[1].t == pytest.approx(caught[0].t, rel=1e-6)
    assert np.max(np.abs(caught[0].run.data - caught[1].run.data)) < 1e-9
    assert caught[0].run.t.tobytes() == caught[1].run.t.tobytes()
    return caught


def test_a_guard_that_fails_between_ticks_says_the_same_and_keeps_the_same():
    x = Integrator(name="x", initial_value=1.0)
    ramp = Integrator(name="ramp")(x(0.0 * Clock()))
    made = Diagram("d", Requirement(requirement="below 0.5533", name="limit")(Compare("<")(ramp, 0.5533)))
    first, second = failing(GuardError, made, 1.0, step=0.01)
    assert str(first).partition("t =")[0] == str(second).partition("t =")[0]
    assert second.t == pytest.approx(0.5533, abs=1e-6)


def test_a_root_that_leaves_its_domain_says_the_same_and_keeps_the_same():
    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(Function(lambda x: -1.0 - np.sqrt(x), name="root")(x.y)))
    first, second = failing(SimulationError, made, 2.0, step=0.01)
    assert second.block == first.block == "root"


@pytest.mark.parametrize("fault", ["step discard 0.05", "set error 0.05", "get error 0.05"])
def test_an_fmu_that_fails_beside_continuous_states_says_the_same_and_keeps_the_same(fault, tmp_path):
    plant = Fmu(zoo_fmu(tmp_path, 3, fault), isolate=False, name="plant")
    made = Diagram("d", plant(u=Integrator(name="x")(Constant(value=1.0))))
    first, second = failing(FmuRuntimeError, made, 1.0, step=0.01)
    assert str(first) == str(second)


def test_ctrl_c_keeps_what_was_recorded():
    def interrupt(t):
        if t > 5.0:
            raise KeyboardInterrupt

    with oscillator().simulation(step=0.001, compile=True) as simulation, pytest.raises(Interrupted) as caught:
        simulation.advance(1e6, progress=interrupt)
    run = caught.value.run
    assert 5.0 < run.t[-1] < 1e5
    assert np.max(np.abs(run["x.y"] - np.cos(5.0 * run.t))) < 1e-4 * run.t[-1]


def test_a_run_to_disk_is_the_same(tmp_path):
    whole = compiled(loop_with_lags(), 2.0, every=3)
    compiled(loop_with_lags(), 2.0, every=3, to=tmp_path / "run")
    assert np.array_equal(Run.open(tmp_path / "run").data, whole.data)


def test_a_run_without_a_compiler_is_interpreted_and_says_so(monkeypatch):
    from loopwright.diagrams.compiled import compiled_libraries

    monkeypatch.setenv("LOOPWRIGHT_CC", "no-such-compiler")
    compiled_libraries.load_compiled.cache_clear()
    compiled_libraries.load_runtime.cache_clear()
    run = oscillator(omega=3.0).simulate(1.0, compile=True, **QUIET)
    assert [m for m in run.messages if "no-such-compiler" in m]
    assert np.max(np.abs(run["x.y"] - np.cos(3.0 * run.t))) < 1e-4
