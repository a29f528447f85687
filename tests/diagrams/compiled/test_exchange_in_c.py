"""FMUs in model exchange in compiled runs: closed forms, matrix exponentials, and the numbers of interpreted runs."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Gain,
    Sine,
    Step,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, bouncing_ball, mass_spring_damper

T = 1e-3
M = mass_spring_damper.nominal
A = np.array([[0.0, 1.0], [-M.stiffness / M.mass, -M.damping / M.mass]])
B = np.array([[0.0], [1.0 / M.mass]])
START = 0.1


@pytest.fixture(scope="module")
def files(cache, tmp_path_factory):
    """FMUs of the library by model and version of FMI."""
    folder = tmp_path_factory.mktemp("exchange")
    return {
        (model, fmi): model.build(out=folder / f"{model.__name__.rpartition('.')[2]}{fmi}.fmu", fmi=fmi)
        for model in (mass_spring_damper, bouncing_ball)
        for fmi in (2, 3)
    }


def mass(files, fmi=3, name="plant", **options):
    return Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name=name, isolate=False, **options)


def both(make, duration, **options):
    """Run a diagram in both tiers, and see that C was there."""
    options = {"progress": False, "rtol": 1e-8, "atol": 1e-10, **options}
    interpreted = make().simulate(duration, compile=False, **options)
    compiled = make().simulate(duration, compile=True, **options)
    assert compiled.tier == "compiled", compiled.messages
    return interpreted, compiled


def same(interpreted, compiled, rtol=1e-8, atol=1e-10):
    """Hold the numbers of both tiers against each other, by the tolerances, and their events."""
    np.testing.assert_array_equal(interpreted.t, compiled.t)
    size = np.abs(interpreted.data).max(axis=0)
    assert (np.abs(compiled.data - interpreted.data) <= 100 * (rtol * size + atol)).all()
    told = [[(e.block, e.event) for e in run.events] for run in (interpreted, compiled)]
    assert told[0] == told[1]
    np.testing.assert_allclose([e.t for e in interpreted.events], [e.t for e in compiled.events], rtol=1e-7, atol=1e-9)


def pi_loop(plant):
    """A PI controller at 1 kHz around an FMU."""

    @subsystem(sample_time=T, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 20.0 * error + 50.0 * memory(memory.y + T * error)

    return Diagram("loop", plant(force=controller(plant.position)))


def exact_loop(n):
    """Positions in that loop at n ticks, by the exponential of a matrix."""
    step = expm(T * np.block([[A, B], [np.zeros((1, 3))]]))[:2]
    x, integral, found = np.array([START, 0.0]), 0.0, []
    for _ in range(n):
        found.append(x[0])
        error = 1.0 - x[0]
        force, integral = 20.0 * error + 50.0 * integral, integral + T * error
        x = step @ [*x, force]
    return np.array(found)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("solver", ["auto", "RK23", "DOP853", "Radau", "rk4"])
def test_a_plant_under_a_sampled_controller_is_that_of_the_matrix_exponential(files, fmi, solver):
    run = pi_loop(mass(files, fmi)).simulate(
        0.3, compile=True, solver=solver, step=T if solver == "rk4" else None, rtol=1e-9, atol=1e-12, progress=False
    )
    assert run.tier == "compiled", run.messages
    np.testing.assert_allclose(run["plant.position"], exact_loop(len(run.t)), rtol=0.0, atol=1e-9)


def test_events_of_inputs_at_every_tick_are_those_of_an_interpreted_run(files):
    same(*both(lambda: pi_loop(mass(files)), 0.05))


def test_euler_and_heun_have_their_order(files):
    def error(solver, step):
        wave = Sine(frequency=0.5, name="wave")
        made = Diagram("driven", mass(files)(force=wave)).simulate(
            1.0, step=step, solver=solver, compile=True, progress=False
        )
        assert made.tier == "compiled"
        fine = Diagram("driven", mass(files)(force=wave)).simulate(1.0, step=0.1, rtol=1e-10, progress=False)
        return abs(made["plant.position"][-1] - fine["plant.position"][-1])

    for solver, order in (("euler", 1), ("heun", 2)):
        assert np.log2(error(solver, 0.002) / error(solver, 0.001)) == pytest.approx(order, abs=0.2)


def test_feedback_in_continuous_time_through_the_fmu(files):
    def make():
        plant = mass(files)
        return Diagram("loop", plant(force=Gain(gain=-5.0, name="feedback")(plant.position)))

    interpreted, compiled = both(make, 1.0, step=0.1)
    closed = np.array([[0.0, 1.0], [-(M.stiffness + 5.0) / M.mass, -M.damping / M.mass]])
    exact = [(expm(closed * t) @ [START, 0.0])[0] for t in compiled.t]
    np.testing.assert_allclose(compiled["plant.position"], exact, atol=1e-7)
    same(interpreted, compiled)


@pytest.mark.parametrize("solver", ["RK45", "Radau"])
def test_two_fmus_in_a_chain_with_a_lag_between_them(files, solver):
    def make():
        first, second = mass(files, 3, "first"), mass(files, 2, "second", start={"position": 0.0})
        lag = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="lag")
        return Diagram("chain", second(force=lag(first(force=Step(times=0.25, values=1.0, name="step")).position)))

    interpreted, compiled = both(make, 1.0, step=0.05, solver=solver)
    same(interpreted, compiled)
    F = np.zeros((6, 6))  # two masses, a lag, the input
    F[:2, :2] = F[3:5, 3:5] = A
    F[1, 5], F[2, 0], F[2, 2], F[4, 2] = B[1, 0], 20.0, -20.0, B[1, 0]
    x = expm(0.25 * F) @ [START, 0, 0, 0, 0, 0]
    x = expm(0.75 * F) @ [*x[:5], 1.0]
    assert compiled["second.position"][-1] == pytest.approx(x[3], abs=1e-7)


def test_impacts_fall_at_the_times_of_the_closed_form(files):
    start = {"height": 1.0, "restitution": 0.8}

    def make():
        return Diagram(
            "ball", Fmu(files[bouncing_ball, 3], interface="model_exchange", name="ball", isolate=False, start=start)()
        )

    interpreted, compiled = both(make, 3.0, step=0.01)
    same(interpreted, compiled)
    g, t, found = bouncing_ball.nominal.gravity, np.sqrt(2.0 / bouncing_ball.nominal.gravity), []
    v = g * t
    while t < 3.0:
        found.append(t)
        v *= 0.8
        t += 2.0 * v / g
    impacts = [event.t for event in compiled.events][::2]  # its indicator is crossed on the way down and up
    np.testing.assert_allclose(impacts, found, atol=1e-8)
