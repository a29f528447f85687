"""FMUs in model exchange in C's loop: closed forms, matrix exponentials and SciPy, in both forms of a diagram's functions.

Both forms go in one loop, so that their agreement says nothing of it: each test has an oracle beside it.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import (
    Block,
    Compare,
    Constant,
    Function,
    Gain,
    Input,
    LimitedIntegrator,
    Relay,
    SimulationError,
    Sine,
    State,
    Step,
    StopCondition,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Interrupted, subsystem
from loopwright.fmus import Fmu, bouncing_ball, build, mass_spring_damper
from support.controlled_mass import START, A, B, T, exact_loop, held, pi_loop
from support.eventful import eventful_fmu, exact


class Car(Block):
    """A car on one braked wheel with a friction of the slip that falls beyond its peak."""

    torque = Input()
    v = State(start=25.0, output=True)
    omega = State(start=25.0 / 0.3, output=True)

    def derivative(self, t, x, u):
        slip = (x.v - 0.3 * x.omega) / x.v
        force = 400.0 * 9.81 * 2 * 0.9 * 0.15 * slip / (0.15**2 + slip**2)
        return -force / 400.0, 0.3 * force - u.torque


@pytest.fixture(params=[False, pytest.param(True, marks=pytest.mark.slow)], ids=["here", "apart"])
def isolate(request):
    """Whether FMUs run in processes of their own."""
    return request.param


@pytest.fixture(scope="module")
def built(cache, tmp_path_factory):
    """FMUs of the library by model and version of FMI."""
    folder = tmp_path_factory.mktemp("exchange")
    return {
        (model, fmi): model.build(out=folder / f"{model.__name__.rpartition('.')[2]}{fmi}.fmu", fmi=fmi)
        for model in (mass_spring_damper, bouncing_ball)
        for fmi in (2, 3)
    }


@pytest.fixture
def files(built, isolate):
    return {**built, "isolate": isolate}


def mass(files, fmi=3, name="plant", **options):
    return Fmu(
        files[mass_spring_damper, fmi], interface="model_exchange", name=name, isolate=files["isolate"], **options
    )


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


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("solver", ["auto", "RK23", "DOP853", "Radau", "rk4"])
@pytest.mark.drawn(2)
def test_a_plant_under_a_sampled_controller_is_that_of_the_matrix_exponential(files, fmi, solver):
    run = pi_loop(mass(files, fmi)).simulate(
        0.3, compile=True, solver=solver, step=T if solver == "rk4" else None, rtol=1e-9, atol=1e-12, progress=False
    )
    assert run.tier == "compiled", run.messages
    np.testing.assert_allclose(run["plant.position"], exact_loop(len(run.t)), rtol=0.0, atol=1e-9)


def driven(frequency, amplitude=1.0):
    """The matrix of position and velocity, and of a sine as their force in N and its cosine, frequency in Hz."""
    w = 2.0 * np.pi * frequency
    return np.block([[A, amplitude * B, np.zeros((2, 1))], [np.zeros((2, 2)), np.array([[0.0, w], [-w, 0.0]])]])


FROM_START = [START, 0.0, 0.0, 1.0]


def test_euler_and_heun_have_their_order(files):
    def error(solver, step):
        wave = Sine(frequency=0.5, name="wave")
        made = Diagram("driven", mass(files)(force=wave)).simulate(
            1.0, step=step, solver=solver, compile=True, progress=False
        )
        assert made.tier == "compiled"
        return abs(made["plant.position"][-1] - (expm(driven(0.5)) @ FROM_START)[0])

    for solver, order in (("euler", 1), ("heun", 2)):
        assert np.log2(error(solver, 0.002) / error(solver, 0.001)) == pytest.approx(order, abs=0.2)


def test_feedback_in_continuous_time_through_the_fmu(files):
    def make():
        plant = mass(files)
        return Diagram("loop", plant(force=Gain(gain=-5.0, name="feedback")(plant.position)))

    interpreted, compiled = both(make, 1.0, step=0.1)
    closed = A - 5.0 * B @ [[1.0, 0.0]]
    expected = [(expm(closed * t) @ [START, 0.0])[0] for t in compiled.t]
    np.testing.assert_allclose(compiled["plant.position"], expected, atol=1e-7)
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
            "ball",
            Fmu(
                files[bouncing_ball, 3], interface="model_exchange", name="ball", isolate=files["isolate"], start=start
            )(),
        )

    interpreted, compiled = both(make, 3.0, step=0.01)
    same(interpreted, compiled)
    g, t, found = bouncing_ball.nominal.gravity, np.sqrt(2.0 / bouncing_ball.nominal.gravity), []
    v = g * t
    while t < 3.0:
        found.append(t)
        v *= 0.8
        t += 2.0 * v / g
    for run in (interpreted, compiled):
        np.testing.assert_allclose([event.t for event in run.events], found, atol=1e-8)


def relay_loop(files):
    relay = Relay(on_point=0.02, off_point=-0.02, on_value=-5.0, off_value=5.0, name="relay")
    plant = mass(files)
    return Diagram("limit_cycle", plant(force=relay(plant.position)))


@pytest.mark.parametrize("solver", ["RK45", "Radau", "rk4"])
@pytest.mark.drawn(1)
def test_events_of_other_blocks_whose_jumps_are_inputs_of_an_fmu(files, solver):
    """The force is −5 N from the start, as the mass is above 0.02 m, and 5 N below −0.02 m: matrix exponentials."""
    x, force, level, begun, switches, expected = np.array([START, 0.0]), -5.0, -0.02, 0.0, [], []
    grid = np.arange(51) * 0.02
    while begun < 1.0:
        looks = 0.005 * np.arange(1, 200)
        beyond = [np.sign(force) * ((held(s) @ [*x, force])[0] - level) > 0.0 for s in looks]
        end = looks[beyond.index(True)]
        length = brentq(lambda s, x=x, f=force, at=level: (held(s) @ [*x, f])[0] - at, end - 0.005, end, xtol=1e-14)
        here = grid[(grid >= begun) & (grid < begun + length)]
        expected += [(held(t - begun) @ [*x, force])[0] for t in here]
        begun, x, force, level = begun + length, held(length) @ [*x, force], -force, -level
        switches.append(begun)
    bound = 2e-5 if solver == "rk4" else 1e-7  # rk4: (10 · 0.02)⁵ / 120 of 0.1 m in each of 50 steps, at most
    for run in both(lambda: relay_loop(files), 1.0, step=0.02, solver=solver):
        assert len(run.events) == len(switches) - 1 >= 3
        assert [e.event for e in run.events] == ["fall", "rise", "fall", "rise"][: len(run.events)]
        np.testing.assert_allclose([e.t for e in run.events], switches[:-1], atol=10 * bound)
        np.testing.assert_allclose(run["plant.position"], expected, rtol=0.0, atol=bound)


def braked(end):
    """Times and names of the events of the anti-lock brake up to an end in s, and v there, by SciPy at tight tolerance."""
    torque, valve = 1e7, "rise"  # the rate of the torque in N m/s, and the event of the valve that is next

    def slip(x):
        return 1.0 - 0.3 * x[1] / x[0]

    def rates(t, x):
        s = slip(x)
        force = 400.0 * 9.81 * 2 * 0.9 * 0.15 * s / (0.15**2 + s**2)
        return [-force / 400.0, 0.3 * force - x[2], torque]

    def switches(t, x):
        return slip(x) - (0.1701 if valve == "rise" else 0.1699)

    def is_empty(t, x):
        return x[2] if torque < 0.0 else 1.0

    switches.terminal = is_empty.terminal = True
    t, x, told = 0.0, np.array([25.0, 25.0 / 0.3, 0.0]), []
    while True:
        switches.direction, is_empty.direction = (1.0 if valve == "rise" else -1.0), -1.0
        done = solve_ivp(rates, (t, end), x, "DOP853", events=[switches, is_empty], rtol=1e-12, atol=1e-12)
        t, x = done.t[-1], done.y[:, -1]
        if done.status == 0:
            return told, x[0]
        if len(done.t_events[1]):
            told.append((t, "torque", "reached"))
            x[2] = torque = 0.0
        elif valve == "rise":
            told.append((t, "valve", "rise"))
            torque, valve = -1e7, "fall"
        else:
            told.append((t, "valve", "fall"))
            told += [(t, "torque", "released")] if torque == 0.0 else []
            torque, valve = 1e7, "rise"


@pytest.mark.slow
def test_an_anti_lock_brake_whose_car_is_an_fmu(cache, tmp_path, isolate):
    """A valve switches thousands of times a second: the torque into the FMU has kinks there, and no jumps."""
    file = build(Car(name="car"), out=tmp_path / "car.fmu")

    def make():
        car, torque = (
            Fmu(file, interface="model_exchange", isolate=isolate, name="car"),
            LimitedIntegrator(lower=0.0, name="torque"),
        )
        valve = Relay(on_point=0.1701, off_point=0.1699, on_value=-1e7, off_value=1e7, name="valve")
        slip = Function(lambda v, omega: 1.0 - 0.3 * omega / v, name="slip")(car.v, car.omega)
        return Diagram("antilock", car(torque(valve(slip))))

    told, v = braked(0.03)
    assert len(told) > 50
    for run in both(make, 0.03, step=0.01, rtol=1e-10, atol=1e-12):
        assert [(e.block, e.event) for e in run.events] == [(block, event) for _, block, event in told]
        np.testing.assert_allclose([e.t for e in run.events], [t for t, _, _ in told], rtol=0.0, atol=1e-9)
        assert run["car.v"][-1] == pytest.approx(v, rel=1e-9)


def test_an_fmu_of_co_simulation_beside_one_of_model_exchange(files):
    def make():
        sampled = Fmu(files[mass_spring_damper, 3], name="sampled", isolate=files["isolate"], start={"position": 0.0})
        plant = mass(files)

        @subsystem(sample_time=T, name="controller")
        def controller(y):
            return Gain(gain=-20.0, name="gain")(y)

        @subsystem(sample_time=T, name="other")
        def other(y):
            return Gain(gain=2.0, name="gain")(y)

        return Diagram("two", plant(force=controller(sampled.position)), sampled(force=other(plant.position)))

    step, x, y, expected = held(T), np.array([START, 0.0]), np.zeros(2), []
    for _ in range(101):
        expected.append((x[0], y[0]))
        x, y = step @ [*x, -20.0 * y[0]], step @ [*y, 2.0 * x[0]]
    for run in both(make, 0.1):
        found = np.transpose([run["plant.position"], run["sampled.position"]])
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("place", ["continuous", "between ticks", "at a tick"])
@pytest.mark.drawn(2)
def test_stop_conditions_at_ticks_and_between_them(files, place):
    """The position reaches 0.15 m, under a force that is a sine, or a sine that is held over 0.01 s."""

    def make():
        plant = mass(files)
        force = Sine(frequency=1.0, amplitude=20.0, name="wave")

        def stop(y):
            return StopCondition(name="stop")(
                Compare(relation=">", name="above")(y, Constant(value=0.15, name="limit"))
            )

        @subsystem(sample_time=0.01, name="hold")
        def hold(u, y):
            if place == "at a tick":
                stop(y)
            return Gain(gain=1.0, name="gain")(u)

        driven_plant = plant(force=force if place == "continuous" else hold(force, plant.position))
        return Diagram("stops", driven_plant, *([] if place == "at a tick" else [stop(plant.position)]))

    def position(t):
        if place == "continuous":
            return (expm(driven(1.0, 20.0) * t) @ FROM_START)[0]
        x, ticks = np.array([START, 0.0]), int(t / 0.01 + 1e-9)
        forces = 20.0 * np.sin(0.02 * np.pi * np.arange(ticks + 1))
        for force in forces[:-1]:
            x = held(0.01) @ [*x, force]
        return (held(t - 0.01 * ticks) @ [*x, forces[-1]])[0]

    end = 0.01 * next(k for k in range(300) if position(0.01 * k) > 0.15)
    if place != "at a tick":
        end = brentq(lambda t: position(t) - 0.15, end - 0.01, end, xtol=1e-14)
    for run in both(make, 3.0, step=0.5 if place == "continuous" else 0.01):
        assert run.stopped.t == run.t[-1] == pytest.approx(end, abs=1e-8)
        assert run["plant.position"][-1] == pytest.approx(position(end), abs=1e-7)


def test_states_are_saved_in_one_tier_and_restored_in_the_other(files):
    options = {"rtol": 1e-8, "atol": 1e-10}
    for first, second in ((False, True), (True, False)):
        with pi_loop(mass(files)).simulation(compile=first, **options) as simulation:
            simulation.advance(0.05)
            saved = simulation.save()
        with pi_loop(mass(files)).simulation(compile=second, **options) as simulation:
            for _ in range(2):
                simulation.restore(saved)
                simulation.advance(0.05)
            rest = simulation.run()
        assert (rest.tier == "compiled") is second
        np.testing.assert_allclose(rest["plant.position"][-50:], exact_loop(101)[-50:], atol=1e-9)


def test_a_run_to_disk_and_an_interrupt(files, tmp_path):
    run = pi_loop(mass(files)).simulate(0.1, compile=True, to=tmp_path / "run", progress=False)
    np.testing.assert_allclose(np.asarray(run["plant.position"]), exact_loop(101), atol=1e-7)

    def interrupt(t):
        if t > 1.0:
            raise KeyboardInterrupt

    with pi_loop(mass(files)).simulation(compile=True) as simulation, pytest.raises(Interrupted) as caught:
        simulation.advance(1e5, progress=interrupt)
    run = caught.value.run
    assert run.tier == "compiled"
    assert 1.0 < run.t[-1] < 1e4
    np.testing.assert_allclose(run["plant.position"][:1000], exact_loop(1000), atol=1e-6)


def test_a_long_run_under_auto_is_that_of_the_matrix_exponential(files):
    run = pi_loop(mass(files)).simulate(10.0, record=["plant.position"], every=100, progress=False)
    assert run.tier in ("interpreted", "both")  # as fast as the machine is
    np.testing.assert_allclose(run["plant.position"], exact_loop(10_001)[::100], atol=1e-7)


@pytest.fixture(scope="module", params=[2, 3])
def eventful(request, cache, tmp_path_factory):
    return eventful_fmu(tmp_path_factory.mktemp("eventful"), request.param)


def test_an_input_that_jumps_at_every_tick_is_one_event_at_each(eventful, isolate):
    """u is k at tick k: it takes the FMU through Event Mode after the start's, and after its own at 0.25 s."""

    def make():
        @subsystem(sample_time=0.01, name="counter")
        def counter():
            memory = UnitDelay(initial_value=0.0, name="count")
            return memory(memory.y + 1.0)

        plant = Fmu(eventful, name="plant", isolate=isolate)
        return Diagram("counted", plant(u=counter(), n=Constant(value=0.0, name="n")))

    k = np.arange(31)
    for run in both(make, 0.3):
        np.testing.assert_array_equal(run["plant.events"], 1 + k + (k >= 25))
        np.testing.assert_allclose(run["plant.x"], 0.01 * k * (k - 1) / 2 + exact(run.t, 0.0), rtol=0.0, atol=1e-12)
        assert [(e.t, e.event) for e in run.events] == [(0.25, "time_event")]


def test_every_kind_of_event_of_an_fmu(eventful, isolate):
    """ẋ = u + k with k = ⌊4 t⌋; x falls to 0 after a step that ends above 1, and n is taken over in Event Mode."""

    def make(armed):
        plant = Fmu(eventful, name="plant", isolate=isolate, start={"armed": armed})
        wanted = Step(times=0.333, values=3.0, name="wanted")
        return Diagram("d", plant(u=Constant(value=1.0, name="u"), n=wanted))

    for run in both(lambda: make(0), 0.8, step=0.05):
        np.testing.assert_array_equal(run["plant.m"], np.where(run.t >= 0.333, 3.0, 0.0))
        assert [(e.t, e.event) for e in run.events] == [(t, "time_event") for t in (0.25, 0.5, 0.75)]
        np.testing.assert_allclose(run["plant.x"], exact(run.t, 1.0), rtol=0.0, atol=1e-12)
        assert run["plant.events"][-1] == 5.0  # at the start, and of n
    x, expected, falls = 0.0, [0.0], []
    for k in range(20):
        x += 0.05 * (1 + k // 5)
        if x > 1.0:
            falls.append(0.05 * (k + 1))
            x = 0.0
        expected.append(x)
    for run in both(lambda: make(1), 1.0, step=0.05, solver="rk4"):
        assert [e.t for e in run.events if e.event == "step_event"] == pytest.approx(falls, abs=1e-12)
        assert [e.t for e in run.events if e.event == "time_event"] == [0.25, 0.5, 0.75, 1.0]
        np.testing.assert_allclose(run["plant.x"], expected, rtol=0.0, atol=1e-12)


def test_an_fmu_ends_a_compiled_run(eventful, isolate):
    plant = Fmu(eventful, name="plant", isolate=isolate, start={"last": 3})
    diagram = Diagram("d", plant(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(2.0, step=0.1, compile=True, progress=False)
    assert run.tier == "compiled"
    assert (run.stopped.t, run.stopped.block, run.t[-1]) == (0.75, "plant", 0.75)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("return 3;", "computing the derivatives of its states failed with fmi3Error at t = 0.3"),
        ("return 2;", "The FMU discards what the solver tries: computing the derivatives of its states at t = 0"),
        ("dx[0] = 0.0 / 0.0; return 0;", "the rate of plant.x = 0.2 is 1.5 there and is not finite just beyond"),
    ],
    ids=["error", "discard", "nan"],
)
def test_a_failure_in_c_is_told_as_interpreted(cache, tmp_path, fault, told, isolate):
    file = eventful_fmu(tmp_path, 3, fault=f"if (c->t > 0.3) {{ {fault} }}")
    plant = Fmu(file, name="plant", isolate=isolate)
    diagram = Diagram("d", plant(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    with pytest.raises(SimulationError, match=told) as error:
        diagram.simulate(1.0, step=0.1, compile=True, progress=False)
    assert error.value.block == "plant"
    assert error.value.t == pytest.approx(0.3, abs=0.1)
    assert error.value.run.t[-1] >= 0.2
    np.testing.assert_allclose(error.value.run["plant.x"], exact(error.value.run.t, 0.5), rtol=0.0, atol=1e-12)


def test_a_discard_beyond_a_wall_makes_steps_smaller(cache, tmp_path, isolate):
    """The rates can't be computed for x > 0.7, which x = 0.5 t + … reaches at t = 0.6 and no sooner."""
    file = eventful_fmu(tmp_path, 3, fault="if (c->x > 0.7) return 2;")
    plant = Fmu(file, name="plant", isolate=isolate)
    diagram = Diagram("d", plant(u=Constant(value=0.5, name="u"), n=Constant(value=0.0, name="n")))
    run = diagram.simulate(0.5, step=0.5, compile=True, max_step=10.0, progress=False)
    assert run.tier == "compiled"
    assert run["plant.x"][-1] == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_warning_in_c_is_told_once(cache, tmp_path, fmi, isolate):
    getter = "int NAME(REAL_GET)(void *p, const unsigned r[], size_t n, double v[] SIZE) {\n    instance *c = p;"
    values = (
        "for (size_t i = 0; i < n; i++) v[i] = r[i] == 1 ? c->x : r[i] == 2 ? c->u + c->k : r[i] == 3 ? c->u : c->t"
    )
    warning = getter + f" if (c->t > 0.3) {{ if (!n) return 0; {values}; return 1; }}"
    file = eventful_fmu(tmp_path, fmi, changes=[(getter, warning)])
    plant = Fmu(file, name="plant", isolate=isolate)
    diagram = Diagram("d", plant(u=Constant(value=0.5), n=Constant(value=0.0)))
    run = diagram.simulate(1.0, step=0.1, compile=True, progress=False)
    assert run.tier == "compiled"
    (told,) = [m for m in run.messages if "Warning" in m]
    assert told.startswith(f"plant: reading the outputs gave fmi{fmi}Warning at t = 0.")
