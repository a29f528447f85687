"""Linear models, trims, saved states and branches of diagrams with an FMU in model exchange."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PID, Constant, Gain
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.linearization import differentiate_loop
from loopwright.diagrams.report import analyse
from loopwright.fmus import Fmu, FmuError, bouncing_ball, gantry, mass_spring_damper

K, D, M = 100.0, 1.0, 1.0
A, B = np.array([[0.0, 1.0], [-K / M, -D / M]]), np.array([[0.0], [1.0 / M]])


@pytest.fixture(scope="module", params=[2, 3])
def file(request, cache, tmp_path_factory):
    return mass_spring_damper.build(out=tmp_path_factory.mktemp("msd") / f"m{request.param}.fmu", fmi=request.param)


def pushed(file, **options):
    plant = Fmu(file, interface="model_exchange", name="plant", **options)
    return Diagram("pushed", plant(force=Constant(value=3.0, name="force")))


def test_the_linear_model_has_the_matrices_of_the_equations(file):
    linear = pushed(file).linearize(inputs="force.y", outputs=["plant.position", "plant.acceleration"])
    np.testing.assert_allclose(linear.A, A, atol=1e-12)
    np.testing.assert_allclose(linear.B, B, atol=1e-12)
    np.testing.assert_allclose(linear.C, [[1.0, 0.0], A[1]], atol=1e-12)
    np.testing.assert_allclose(linear.D, [[0.0], [1.0 / M]], atol=1e-12)
    assert linear.states == ("plant.position", "plant.velocity")
    assert linear.how["plant"] == "directional derivatives in model-exchange"
    assert linear.uncertainty == 0.0


def test_without_directional_derivatives_differences_are_taken_and_their_error_is_told(file, monkeypatch):
    fmu = Fmu(file, interface="model_exchange")
    monkeypatch.setitem(vars(fmu.description.exchange), "has_derivatives", False)
    linear = pushed(file).linearize(inputs="force.y", outputs="plant.acceleration")
    assert linear.how["plant"] == "differences in model-exchange"
    assert 0.0 < linear.uncertainty < 1e-6
    assert np.abs(linear.A - A).max() <= linear.uncertainty
    run = pushed(file).simulate(0.5, step=0.1, solver="Radau", rtol=1e-8, atol=1e-10, progress=False)
    exact = [0.03 + (expm(A * t) @ [0.07, 0.0])[0] for t in run.t]
    np.testing.assert_allclose(run["plant.position"], exact, atol=1e-6)


def test_a_sampled_loop_has_the_discrete_model_of_its_matrices(file):
    @subsystem(sample_time=0.02)
    def controller(y):
        return Gain(gain=-5.0, name="k")(y)

    plant = Fmu(file, interface="model_exchange", name="plant")
    diagram = Diagram("loop", plant(force=controller(plant.position)))
    linear = diagram.linearize()
    held = expm(np.block([[A, B], [np.zeros((1, 3))]]) * 0.02)
    closed = held[:2, :2] + held[:2, 2:] @ [[-5.0, 0.0]]
    found = np.sort_complex(linear.poles[np.abs(linear.poles) > 1e-9])
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(closed)), rtol=1e-9)


@pytest.mark.drawn(1)
def test_a_trim_finds_the_states_by_name_and_a_run_stays_there(file):
    point = pushed(file).trim(free=["force.value"], targets={"plant.position": 0.5})
    assert point.parameters["force.value"] == pytest.approx(50.0, rel=1e-12)
    np.testing.assert_allclose(point.x, [0.5, 0.0], atol=1e-12)
    run = pushed(file).simulate(1.0, step=0.1, start=point, progress=False)
    np.testing.assert_allclose(run["plant.position"], 0.5, atol=1e-9)
    fixed = pushed(file).operating_point(0.0, states={"plant.position": 0.3})
    assert fixed.x[0] == 0.3


@pytest.mark.drawn(1)
def test_a_run_goes_on_from_a_saved_state_and_branches(file):
    diagram = pushed(file)
    with diagram.simulation(step=0.1) as simulation:
        simulation.advance(0.5)
        half = simulation.save()
        simulation.advance(0.5)
        straight = simulation.run()["plant.position"]
        simulation.restore(half)
        simulation.advance(0.5)
        np.testing.assert_array_equal(simulation.run()["plant.position"], straight[5:])
    again = diagram.simulate(0.5, step=0.1, start=half, progress=False)
    np.testing.assert_array_equal(again["plant.position"], straight[5:])
    branch = diagram.replace({"force.value": 0.0}).simulate(0.5, step=0.1, start=half, rtol=1e-9, progress=False)
    exact = [(expm(A * (t - 0.5)) @ half.x)[0] for t in branch.t]
    np.testing.assert_allclose(branch["plant.position"], exact, atol=1e-6)


def test_discrete_states_are_saved_with_the_continuous_ones(cache, tmp_path):
    ball = Fmu(bouncing_ball.build(out=tmp_path / "ball.fmu"), interface="model_exchange", name="ball")
    diagram = Diagram("d", ball())
    with diagram.simulation(step=0.05) as simulation:
        simulation.advance(1.5)
        saved = simulation.save()
        simulation.advance(1.5)
        straight = simulation.run()
    again = diagram.simulate(1.5, step=0.05, start=saved, progress=False)
    assert again["ball.bounces"][0] == 2.0
    np.testing.assert_array_equal(again["ball.bounces"], straight["ball.bounces"][30:])
    np.testing.assert_allclose(again["ball.height"], straight["ball.height"][30:], atol=1e-12)


def test_an_fmu_that_cannot_save_its_state_says_so(file, monkeypatch):
    fmu = Fmu(file, interface="model_exchange")
    monkeypatch.setitem(vars(fmu.description.exchange), "can_serialize", False)
    with pushed(file).simulation(step=0.1) as simulation:
        simulation.advance(0.1)
        assert not simulation.can_save
        with pytest.raises(FmuError, match=r"canSerializeFMU[Ss]tate is false for model exchange"):
            simulation.save()


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.slow
def test_fig3_with_a_plant_in_model_exchange_is_fig3_with_the_plant_as_a_block(cache, tmp_path, fmi):
    path = gantry.build(out=tmp_path / "gantry.fmu", fmi=fmi)
    swapped = experiments.hand_guiding(plant=Fmu(path, interface="model_exchange")).diagram
    start = swapped.blocks["plant"].start["position"]
    native = swapped.replace(plant=gantry.nominal.replace(name="plant", start_position=start))
    runs = [d.simulate(0.2, progress=False) for d in (swapped, native)]
    np.testing.assert_allclose(runs[0]["position"], runs[1]["position"], rtol=1e-12)
    linear = [d.linearize() for d in (swapped, native)]
    np.testing.assert_allclose(linear[0].A, linear[1].A, atol=1e-10)


@pytest.mark.slow
def test_co_simulation_tends_to_model_exchange_as_its_internal_step_goes_to_zero(cache, tmp_path):
    def positions(name, step, interface):
        path = mass_spring_damper.build(out=tmp_path / f"{name}.fmu", internal_step=step)
        plant = Fmu(path, interface=interface, name="plant")

        @subsystem(sample_time=0.1)
        def controller(y):
            return Gain(gain=-5.0, name="k")(y)

        diagram = Diagram("loop", plant(force=controller(plant.position)))
        return diagram.simulate(1.0, rtol=1e-11, atol=1e-13, progress=False)["plant.position"]

    reference = positions("reference", 1e-3, "model_exchange")
    held = expm(np.block([[A, B], [np.zeros((1, 3))]]) * 0.1)
    states = [np.array([0.1, 0.0])]
    for _ in range(10):
        states.append(held[:2, :2] @ states[-1] + held[:2, 2] * -5.0 * states[-1][0])
    np.testing.assert_allclose(reference, np.array(states)[:, 0], atol=1e-9)
    errors = [np.abs(positions(f"s{n}", 0.1 / n, "co_simulation") - reference).max() for n in (4, 8)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.3)  # rk4


@pytest.mark.slow
def test_a_report_of_fig3_has_the_numbers_of_co_simulation(cache, tmp_path):
    """The gantry is linear between its steps, and the controller's inputs are held: both interfaces mean one model."""
    file = gantry.build(out=tmp_path / "gantry.fmu")
    numbers = []
    for interface in ("co_simulation", "model_exchange"):
        diagram = experiments.compliance(plant=Fmu(file, interface=interface)).diagram
        made = analyse(diagram, only=("operating_points", "poles", "inner", "admittance"))
        assert {"inner", "admittance"} <= {section.key for section in made.sections}
        numbers.append({f"{s.key}.{name}": number.value for s in made.sections for name, number in s.numbers.items()})
    stepped, exchanged = numbers
    assert stepped.keys() == exchanged.keys()
    assert len(stepped) > 50
    for name, value in stepped.items():
        assert exchanged[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name


@pytest.mark.slow
def test_a_loop_has_its_slopes_by_the_parameters_of_its_controller(file):
    plant = Fmu(file, interface="model_exchange", name="plant")

    @subsystem(sample_time=0.02)
    def controller(y):
        return PID(kp=2.0, ki=3.0, name="pi")(0.0, y)

    model = Diagram("loop", plant(force=controller(plant.position).named("u"))).linearize()
    by_kp, by_ki = differentiate_loop(model, ["u"], ["controller.pi.kp", "controller.pi.ki"])
    A, _, C, _ = by_kp.matrices  # the row of C is -kp at the position
    position, integral = model.states.index("plant.position"), model.states.index("controller.pi.integral")
    expected = np.zeros_like(C)
    expected[0, position] = C[0, position] / 2.0
    np.testing.assert_allclose(by_kp.slopes[2], expected, atol=1e-9)
    assert abs(expected[0, position]) == pytest.approx(1.0)
    steps = A[integral, position] / 3.0  # the integral of ki e
    assert by_ki.slopes[0][integral, position] == pytest.approx(steps, rel=1e-9)
    assert abs(steps) == pytest.approx(0.02, rel=1e-9)
    found = model.diagram.sensitivities("u", ["controller.pi.kp", "controller.pi.ki"])
    assert {"controller.pi.kp", "controller.pi.ki"}.isdisjoint(found.without_effect)


@pytest.mark.slow
def test_a_loop_has_its_slopes_by_parameters_of_the_fmu(file):
    plant = Fmu(file, interface="model_exchange", name="plant", start={"position": 0.0})
    force = PID(kp=20.0, ki=30.0, name="pi")(0.0, plant.position).named("u")
    model = Diagram("loop", plant(force=force)).linearize()
    by_k, by_d = differentiate_loop(model, ["u"], ["plant.stiffness", "plant.damping"])
    position, speed = (model.states.index(f"plant.{name}") for name in ("position", "velocity"))
    for found, column in ((by_k, position), (by_d, speed)):  # a = -k s - d v, with m = 1
        expected = np.zeros_like(found.slopes[0])
        expected[speed, column] = -1.0
        np.testing.assert_allclose(found.slopes[0], expected, atol=1e-7)
    found = model.diagram.sensitivities("u", ["plant.stiffness"])
    short, full = (found[name, "ms"] for name in ("plant.stiffness", "plant.start.stiffness"))
    assert short is full
