"""FMUs in model exchange under the diagram's solver: against closed forms, native blocks and co-simulation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import Gain, Integrator, SampleTimeError, Sine
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, bouncing_ball, mass_spring_damper


@pytest.fixture(scope="module")
def files(cache, tmp_path_factory):
    """FMUs of the library by model and version of FMI."""
    folder = tmp_path_factory.mktemp("exchange")
    models = (mass_spring_damper, bouncing_ball)
    return {
        (model, fmi): model.build(out=folder / f"{model.__name__.rpartition('.')[2]}{fmi}.fmu", fmi=fmi)
        for model in models
        for fmi in (2, 3)
    }


@pytest.fixture(params=[2, 3])
def fmi(request):
    return request.param


def driven(plant):
    return Diagram("driven", plant(force=Sine(frequency=0.5, name="wave")))


def exact_motion(t):
    """Position of the mass under sin πt, by SciPy at tight tolerance."""
    m = mass_spring_damper.nominal

    def rate(t, x):
        return [x[1], (np.sin(np.pi * t) - m.damping * x[1] - m.stiffness * x[0]) / m.mass]

    return solve_ivp(rate, (0.0, t[-1]), [0.1, 0.0], t_eval=t, method="DOP853", rtol=1e-12, atol=1e-14).y[0]


@pytest.mark.parametrize("solver", ["auto", "RK45", "DOP853", "Radau", "BDF", "LSODA", "CVODE_BDF", "CVODE_Adams"])
@pytest.mark.drawn(2)
def test_a_driven_mass_meets_its_equations_to_the_tolerance_of_each_solver(files, fmi, solver):
    diagram = driven(Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant"))
    run = diagram.simulate(2.0, step=0.1, solver=solver, rtol=1e-8, atol=1e-11, progress=False)
    np.testing.assert_allclose(run["plant.position"], exact_motion(run.t), atol=2e-7)


@pytest.mark.drawn(1)
def test_fixed_steps_converge_by_their_order(files, fmi):
    diagram = driven(Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant"))
    errors = []
    for step in (0.02, 0.01):
        run = diagram.simulate(1.0, step=step, solver="rk4", progress=False)
        errors.append(np.abs(run["plant.position"] - exact_motion(run.t)).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.2)


def test_both_versions_of_fmi_give_the_same_numbers(files):
    runs = [
        driven(Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant")).simulate(
            1.0, step=0.1, progress=False
        )
        for fmi in (2, 3)
    ]
    np.testing.assert_allclose(runs[0].data, runs[1].data, rtol=1e-13, atol=1e-15)


def test_states_are_those_of_the_diagram(files, fmi):
    diagram = driven(Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant"))
    assert diagram.is_continuous
    assert not diagram.has_fmu
    flat = diagram.flatten(1)
    assert flat.continuous_labels == ["plant.position", "plant.velocity"]
    assert flat.in_model_exchange == ("plant",)


@pytest.mark.drawn(1)
def test_feedthrough_by_the_model_structure_orders_a_loop_around_the_fmu(files, fmi):
    plant = Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant", start={"position": 0.1})
    feedback = Gain(gain=-5.0, name="feedback")(plant.position)  # no algebraic loop: the position has no feedthrough
    run = Diagram("loop", plant(force=feedback)).simulate(1.0, step=0.1, rtol=1e-9, progress=False)
    m = mass_spring_damper.nominal
    A = [[0.0, 1.0], [-(m.stiffness + 5.0) / m.mass, -m.damping / m.mass]]
    from scipy.linalg import expm

    exact = [(expm(np.array(A) * t) @ [0.1, 0.0])[0] for t in run.t]
    np.testing.assert_allclose(run["plant.position"], exact, atol=1e-8)


@pytest.mark.drawn(1)
def test_an_algebraic_loop_through_the_fmu_is_solved_or_told(files, fmi):
    def loop(**options):
        plant = Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant", start={"position": 0.1})
        return Diagram("loop", plant(force=Gain(gain=-0.5, name="inertia")(plant.acceleration)), **options)

    from loopwright.diagrams import AlgebraicLoopError

    with pytest.raises(AlgebraicLoopError, match=r"plant.force feeds through to plant.acceleration"):
        loop()
    run = loop(loops="solve").simulate(1.0, step=0.1, rtol=1e-9, progress=False)
    m = mass_spring_damper.nominal
    from scipy.linalg import expm

    heavier = m.mass + 0.5
    A = [[0.0, 1.0], [-m.stiffness / heavier, -m.damping / heavier]]
    exact = [(expm(np.array(A) * t) @ [0.1, 0.0])[0] for t in run.t]
    np.testing.assert_allclose(run["plant.position"], exact, atol=1e-8)


@pytest.mark.drawn(3)
@pytest.mark.parametrize("solver", ["RK45", "rk4", "CVODE_Adams"])
def test_a_ball_bounces_as_in_closed_form(files, fmi, solver):
    diagram = Diagram("ball", Fmu(files[bouncing_ball, fmi], interface="model_exchange", name="ball")())
    run = diagram.simulate(3.0, step=0.05, solver=solver, progress=False)
    g, e = 9.81, bouncing_ball.nominal.restitution
    fall = np.sqrt(2.0 / g)
    impacts = [fall + 2.0 * fall * sum(e**j for j in range(1, k + 1)) for k in range(18)]
    falls = [event.t for event in run.events if event.after["velocity"] != event.before["velocity"]]
    assert run["ball.bounces"][-1] == 18.0
    np.testing.assert_allclose(falls, impacts, atol=1e-8)
    assert run["ball.height"][-1] == run["ball.velocity"][-1] == 0.0


def test_it_refuses_to_stand_in_a_sampled_subsystem(files):
    @subsystem(sample_time=0.1)
    def box(u):
        return Fmu(files[mass_spring_damper, 3], interface="model_exchange", name="plant")(force=u)

    with pytest.raises(SampleTimeError, match=r"box.plant: a solver integrates its states \(model exchange\)"):
        Diagram("d", box(Sine(frequency=0.5, name="wave")))


def test_the_representation_says_which_interface_is_used(files):
    steps = Fmu(files[mass_spring_damper, 3], name="plant")
    solved = steps.replace(interface="model_exchange")
    assert steps.used_interface == "co_simulation"
    assert repr(steps).endswith(", by co-simulation")
    assert repr(solved).endswith(", by model exchange")
    told = [
        [m for m in driven(p).simulate(0.1, progress=False, step=0.1).messages if "integrates it" in m]
        for p in (steps, solved)
    ]
    assert told == [[], ["plant: it runs by model exchange: the solver integrates it"]]


def test_an_evaluation_that_needs_nothing_of_the_fmu_leaves_it_out(files, fmi):
    plant = Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant")
    aside = Integrator(name="aside")(Gain(gain=2.0, name="twice")(Sine(frequency=0.5, name="wave")))
    flat = Diagram("d", plant(force=Sine(frequency=0.5, name="push")), aside).flatten(1)
    assert len(flat.flow.opaque) == 1
    asked = flat.output(("twice", "y"))
    assert not asked.opaque
    assert asked.function.n_in() == 4
    found = asked(0.5, flat.x0, [], flat.p)[0]
    np.testing.assert_allclose(found, [2.0 * np.sin(np.pi * 0.5)])
    assert [stage.names[0] for stage in flat.jump.opaque][-1] == "jump"


def test_a_spring_that_the_position_pulls_on_acts_within_the_step(files, fmi):
    """The force needs the FMU's output, and the FMU's rates the force: both at every trial of the solver."""
    m, stiffness = mass_spring_damper.nominal, 30.0
    plant = Fmu(files[mass_spring_damper, fmi], interface="model_exchange", name="plant")
    loop = plant(force=Gain(gain=-stiffness, name="spring")(plant.position))
    run = Diagram("pulled", loop).simulate(2.0, step=0.1, rtol=1e-9, atol=1e-12, progress=False)

    decay = m.damping / (2.0 * m.mass)
    omega = np.sqrt((m.stiffness + stiffness) / m.mass - decay**2)
    exact = 0.1 * np.exp(-decay * run.t) * (np.cos(omega * run.t) + decay / omega * np.sin(omega * run.t))
    np.testing.assert_allclose(run["plant.position"], exact, atol=1e-8)


@pytest.mark.one_tier
def test_ticks_ask_neither_the_description_nor_the_sources_anew(files, monkeypatch):
    """Inputs that a sampled subsystem makes jump at every tick: an event each time, and nothing is looked up for it."""
    from loopwright.diagrams.simulation import continuous

    asked = []

    def count(module, name):
        plain = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *arguments, **more: asked.append(name) or plain(*arguments, **more))

    count(continuous, "absolute_tolerances")
    count(continuous, "next_instant")
    plant = Fmu(files[mass_spring_damper, 3], interface="model_exchange", name="plant")

    @subsystem(sample_time=0.01)
    def controller(y):
        return Gain(gain=-5.0, name="k")(y)

    loop = plant(force=controller(plant.position) + Sine(frequency=0.5, name="wave"))
    Diagram("sampled", loop).simulate(1.0, progress=False)
    assert asked.count("absolute_tolerances") <= 2
    assert asked.count("next_instant") <= 5  # one for each call of C, which goes over many of the 100 ticks
