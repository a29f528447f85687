"""The step of an exported model's own integrator: chosen by its fastest mode; by SciPy's Radau at tight tolerance."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright import Fmu, build
from loopwright.blocks import Block, Constant, Input, State, Step, parameter
from loopwright.diagrams import Diagram
from loopwright.fmus.export import internal_step, model_spec

K, JM, JL, N, C, D = 0.04, 2e-5, 0.02, 30.0, 500.0, 0.5


class GearMotor(Block):
    """DC motor with a gear and an elastic shaft to its load."""

    R: float = parameter(default=2.0, unit="Ohm")
    L: float = parameter(default=1e-3, unit="H")
    u = Input(unit="V")
    i = State(unit="A", output=True)
    wm = State(unit="rad/s", output=True)
    twist = State(unit="rad")
    wl = State(unit="rad/s", output=True)

    def derivative(self, t, x, u):
        return rates((x.i, x.wm, x.twist, x.wl), u.u, self.R, self.L)


def rates(x, u, R=2.0, L=1e-3):
    i, wm, twist, wl = x
    shaft = C * twist + D * (wm / N - wl)
    friction = 0.02 * np.tanh(wl / 0.01)
    return (u - R * i - K * wm) / L, (K * i - shaft / N) / JM, wm / N - wl, (shaft - friction) / JL


class Wall(Block):
    """A spring that is as stiff as its parameter says."""

    rate: float = parameter(default=2e6, unit="1/s")
    u = Input(unit="1")
    y = State(unit="1", output=True)

    def derivative(self, t, x, u):
        return self.rate * (u.u - x.y)


def by_radau():
    t = 1e-3 * np.arange(51)
    options = {"method": "Radau", "rtol": 1e-12, "atol": 1e-14, "t_eval": t}
    return solve_ivp(lambda t, x: rates(x, 1.0), (0.0, t[-1]), np.zeros(4), **options).y


def run_of(path, **start):
    motor = Fmu(path, start=start, name="motor")
    return Diagram("drive", motor(u=Constant(value=1.0, unit="V"))).simulate(0.05, step=1e-3)


def test_a_default_build_resolves_the_fastest_mode():
    """With steps of 1 ms the current is 22 % off after the first one: |λ| h = 2."""
    run, expected = run_of(build(GearMotor())), by_radau()
    assert np.max(np.abs(run["motor.i"] - expected[0])) < 1e-6 * np.max(expected[0])
    assert np.max(np.abs(run["motor.wl"] - expected[3])) < 1e-6 * np.max(expected[3])
    assert run.messages == ()
    coarse = run_of(build(GearMotor()), internal_step=1e-3)
    assert abs(coarse["motor.i"][1] - expected[0][1]) > 0.1 * expected[0][1]


def test_a_coarse_step_is_a_warning_of_the_build_of_the_description_and_of_the_run():
    spec = model_spec(GearMotor())
    fastest = internal_step.find_fastest_mode(spec)
    h = 1e-7
    J = [(np.array(rates(h * e, 0.0)) - np.array(rates(-h * e, 0.0))) / (2 * h) for e in np.eye(4)]
    assert fastest == pytest.approx(np.max(np.abs(np.linalg.eigvals(np.transpose(J)))), rel=1e-5)
    said = r"gearmotor, internal_step: found 0\.001 s\. It is coarse: 2 time constants of the fastest mode"
    with pytest.warns(RuntimeWarning, match=said):
        path = build(GearMotor(), internal_step=1e-3)
    assert "resolves it, or integrator='rodas'" in Fmu(path).description.variables["internal_step"].description
    (message,) = run_of(path).messages
    assert "internal_step = 0.001 s is coarse beside the fastest mode at t = 0 s" in message


def test_other_parameters_in_a_run_are_compared_too():
    path = build(GearMotor())
    (message,) = run_of(path, L=5e-5).messages
    assert "is coarse beside the fastest mode" in message
    assert "about 4e+04 1/s" in message
    assert run_of(path, L=5e-5, integrator=3).messages == ()


@pytest.mark.slow
def test_a_very_stiff_model_gets_the_implicit_integrator():
    wall = Fmu(build(Wall()), name="wall")
    run = Diagram("stiff", wall(u=Step(times=2e-3, values=1.0))).simulate(5e-3, step=1e-3)
    assert run["wall.y"] == pytest.approx([0.0, 0.0, 0.0, 1.0, 1.0, 1.0], abs=1e-6)
    assert run.messages == ()


@pytest.mark.parametrize(
    ("rate", "step", "integrator"),
    [(50.0, 1e-3, "rk4"), (100.0, 1e-3, "rk4"), (101.0, 5e-4, "rk4"), (2e3, 5e-5, "rk4"), (2e4, 1e-3, "rodas")],
)
def test_the_step_is_a_tenth_of_the_time_constant(rate, step, integrator):
    chosen = internal_step.choose_internal_step(model_spec(Wall(rate=rate)))
    assert (chosen.internal_step, chosen.integrator) == (step, integrator)
