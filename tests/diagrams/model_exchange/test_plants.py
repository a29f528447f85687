"""Plants in model exchange, in co-simulation and as blocks: oscillators with closed forms, and the plants of Fig. 3."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import (
    Block,
    Constant,
    ErrorDynamics,
    Event,
    FeedbackLinearization,
    PathProjection,
    State,
    TransverseTransform,
    parameter,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.fmus import (
    Fmu,
    build,
    gantry,
    gantry_contact,
    gantry_elastic,
    gantry_stiction,
    scara,
)


class DrivenVanDerPol(Block):
    """Driven Van der Pol oscillator: ẍ = μ (1 − x²) ẋ − x + a cos ωt."""

    mu: float = parameter(default=2.0)
    amplitude: float = parameter(default=1.2)
    omega: float = parameter(default=0.6)
    x = State(start=1.0, output=True)
    v = State(start=0.0, output=True)

    def derivative(self, t, x, u):
        return x.v, self.mu * (1.0 - x.x**2) * x.v - x.x + self.amplitude * np.cos(self.omega * t)


class StickSlip(Block):
    """Mass on a spring, on a belt that moves at the speed V: it sticks up to the force F_s, and slips with F_k.

    Sticking: ẋ = V. Slipping: m v̇ = F_k − k x, until v = V again.
    """

    mass: float = parameter(default=1.0)
    stiffness: float = parameter(default=4.0)
    static: float = parameter(default=3.05)
    kinetic: float = parameter(default=2.0)
    belt: float = parameter(default=0.5)
    x = State(start=0.0, output=True)
    v = State(start=0.5, output=True)
    sticks = State(start=1.0, discrete=True, output=True)
    slip = Event("rising", "the spring pulls the mass off the belt")
    stick = Event("falling", "the mass is as fast as the belt again")

    def derivative(self, t, x, u):
        stuck = x.sticks > 0.5
        return x.v, np.where(stuck, 0.0, (self.kinetic - self.stiffness * x.x) / self.mass)

    def indicators(self, t, x, u):
        stuck = x.sticks > 0.5
        return np.where(stuck, self.stiffness * x.x - self.static, -1.0), np.where(stuck, 1.0, self.belt - x.v)

    def jump(self, t, x, u, fired):
        sticks = np.where(fired.slip > 0.5, 0.0, np.where(fired.stick > 0.5, 1.0, x.sticks))
        slower = np.where(fired.slip > 0.5, self.belt - 1e-10, x.v)  # off the border of the event that sticks
        return x.x + 0.0, np.where(fired.stick > 0.5, self.belt, slower), sticks


def switching_times(m, count):
    """Times at which a `StickSlip` slips and sticks, in closed form."""
    omega, over = np.sqrt(m.stiffness / m.mass), (m.static - m.kinetic) / m.stiffness
    slips = 2.0 / omega * (np.pi - np.arctan(over * omega / m.belt))
    first, sticks = m.static / m.stiffness / m.belt, 2.0 * over / m.belt
    return np.cumsum([first, *([slips, sticks] * count)])[:count]


@pytest.fixture(params=[2, 3])
def fmi(request):
    return request.param


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation", "block"])
@pytest.mark.drawn(1)
def test_a_driven_van_der_pol_oscillator_meets_its_equation_in_all_three_ways(cache, tmp_path, fmi, interface):
    model = DrivenVanDerPol(name="oscillator")
    if interface == "block":
        plant = model
    else:
        path = build(model, tmp_path / "vdp.fmu", fmi=fmi, name="vdp", integrator="dopri5", tolerance=1e-9)
        plant = Fmu(path, interface=interface, name="oscillator")
    run = Diagram("d", plant()).simulate(10.0, step=0.1, rtol=1e-9, atol=1e-11, progress=False)

    def rate(t, x):
        return [x[1], 2.0 * (1.0 - x[0] ** 2) * x[1] - x[0] + 1.2 * np.cos(0.6 * t)]

    exact = solve_ivp(rate, (0.0, 10.0), [1.0, 0.0], t_eval=run.t, method="DOP853", rtol=1e-12, atol=1e-14).y
    np.testing.assert_allclose([run["oscillator.x"], run["oscillator.v"]], exact, atol=2e-6)


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation", "block"])
@pytest.mark.drawn(1)
def test_a_mass_on_a_belt_sticks_and_slips_as_in_closed_form(cache, tmp_path, fmi, interface):
    model = StickSlip(name="mass")
    if interface == "block":
        plant = model
    else:
        path = build(model, tmp_path / "belt.fmu", fmi=fmi, name="belt", internal_step=1e-2)
        plant = Fmu(path, interface=interface, name="mass")
    step = 0.05
    run = Diagram("d", plant()).simulate(8.0, step=step, rtol=1e-8, atol=1e-10, progress=False)
    expected = switching_times(model, 4)
    assert expected[-1] < 8.0 < switching_times(model, 5)[-1]
    changes = run.t[1:][np.diff(run["mass.sticks"]) != 0.0]
    np.testing.assert_allclose(changes, np.ceil(expected / step) * step, atol=1e-9)
    if interface != "co_simulation":  # an indicator fires on its way back, too
        times = [e.t for e in run.events if e.before["sticks"] != e.after["sticks"]] if interface == "block" else None
        found = np.array(times if times is not None else [e.t for e in run.events])
        assert all(np.abs(found - t).min() < 1e-6 for t in expected)


PLANTS = (gantry, gantry_elastic, gantry_stiction, gantry_contact)


def follow_path(arm, model, path):
    """Wire Fig. 3 around an arm, with the arm's own model in the controller."""

    @subsystem(sample_time=1e-3)
    def follower(position, velocity, angle, rate):
        theta = PathProjection(path)(position).named("theta")
        eta, xi = TransverseTransform(path)(theta, position, velocity)
        along = ErrorDynamics.from_poles([-20] * 3, name="along")(eta, Constant(value=(0.2, 0.0, 0.0), name="eta_d"))
        across = ErrorDynamics.from_poles([-40] * 3, name="across")(xi, Constant(value=(0.0, 0.0, 0.0), name="xi_d"))
        return FeedbackLinearization(path, model)(theta, angle, rate, np.zeros(2), along, across)

    torque = follower(arm.position, arm.velocity, arm.joint_angle, arm.joint_velocity)
    return Diagram("arm", arm(motor_torque=torque, external_force=np.zeros(2)))


@pytest.mark.slow
def test_an_arm_in_model_exchange_follows_as_in_co_simulation_with_its_own_model_in_the_controller(cache, tmp_path):
    path = experiments.ELLIPSE
    start = {"joint_angle": scara.nominal.joint_angles(path.to_plane(0.10, 0.01))}
    runs = []
    for fmi in (2, 3):
        file = scara.build(out=tmp_path / f"arm{fmi}.fmu", fmi=fmi)
        for interface in ("model_exchange", "co_simulation"):
            arm = Fmu(file, interface=interface, name="plant", start=start)
            diagram = follow_path(arm, scara.nominal, path)
            runs.append(diagram.simulate(0.3, rtol=1e-9, atol=1e-12, progress=False)["plant.position"])
    np.testing.assert_allclose(runs[0], runs[2], rtol=1e-12)
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-6)
    assert np.abs(runs[0] - runs[0][0]).max() > 0.01  # m: it moves


@pytest.mark.slow
@pytest.mark.parametrize("model", PLANTS, ids=lambda m: m.__name__.rpartition(".")[2])
def test_fig3_runs_with_every_plant_in_model_exchange_as_in_co_simulation(cache, tmp_path, model):
    runs = {}
    for fmi in (2, 3):
        path = model.build(out=tmp_path / f"plant{fmi}.fmu", fmi=fmi)
        for interface in ("model_exchange", "co_simulation"):
            experiment = experiments.hand_guiding(plant=Fmu(path, interface=interface))
            runs[fmi, interface] = experiment.diagram.simulate(0.3, rtol=1e-9, atol=1e-12, progress=False)
    position = {key: run["position"] for key, run in runs.items()}
    for interface in ("model_exchange", "co_simulation"):
        np.testing.assert_allclose(position[2, interface], position[3, interface], rtol=1e-12)
    np.testing.assert_allclose(position[3, "model_exchange"], position[3, "co_simulation"], atol=1e-6)
