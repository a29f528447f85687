"""Between ticks a linear plant's derivative is a matrix exponential wherever it is, and no integration."""

import numpy as np
import pytest
import scipy.integrate
from scipy.linalg import expm

from loopwright.blocks import Block, Constant, Gain, Input, Output, Sine, State, Step, TransferFunction, parameter
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.model_exchange import ModelExchangeEvaluator
from loopwright.fmus import Fmu, build, mass_spring_damper

T = 0.05


def loop(plant):
    @subsystem(sample_time=T, name="controller")
    def controller(y):
        return Gain(gain=-3.0, name="k")(y - Constant(value=1.0, name="r")()).named("u")

    return Diagram("loop", plant(controller(plant.y)))


def test_a_linear_plant_that_moves_is_no_integration(monkeypatch):
    monkeypatch.setattr(scipy.integrate, "solve_ivp", lambda *_, **__: pytest.fail("integrated"))
    diagram = loop(TransferFunction(numerator=(1.0,), denominator=(0.02, 0.3, 1.0), name="plant"))
    model = diagram.linearize()
    assert np.max(np.abs(model.affine)) > 1e-3  # it is not at rest
    A, B, C = np.array([[-15.0, -50.0], [1.0, 0.0]]), np.array([[1.0], [0.0]]), np.array([[0.0, 50.0]])
    held = expm(np.block([[A, B], [np.zeros((1, 3))]]) * T)
    closed = held[:2, :2] - 3.0 * held[:2, 2:] @ C
    assert np.sort_complex(model.poles[np.abs(model.poles) > 1e-12]) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(closed)), rel=1e-12
    )


def test_the_slopes_of_a_moving_linear_plant_are_exact(monkeypatch):
    """One time constant τ under a sampled gain k: z = e − k (1 − e), e = exp(−T/τ)."""
    monkeypatch.setattr(scipy.integrate, "solve_ivp", lambda *_, **__: pytest.fail("integrated"))
    tau = 0.3
    diagram = loop(TransferFunction(numerator=(1.0,), denominator=(tau, 1.0), name="plant"))
    found = diagram.sensitivities("u", ["plant.denominator[1]"])
    e = np.exp(-T / tau)
    high = (1.0 + e) / (3.0 * (1.0 - e))  # largest factor of k: z = −1
    assert found["plant.denominator[1]", "gain_margin_high"].number.value == pytest.approx(high, rel=1e-9)
    by_e = 2.0 / (3.0 * (1.0 - e) ** 2)
    slope = by_e * e * T / tau**2
    assert found["plant.denominator[1]", "gain_margin_high"].slope.value == pytest.approx(slope, rel=1e-8)


class Tank(Block):
    """A tank: what flows out goes with the square of the level."""

    u = Input(shape=())
    y = Output(shape=())
    level = State(start=0.0)

    def derivative(self, t, x, u):
        return u.u - x.level**2

    def output(self, t, x, u):
        return x.level


def test_a_plant_that_is_not_linear_is_integrated(monkeypatch):
    calls = []
    plain = scipy.integrate.solve_ivp
    monkeypatch.setattr(scipy.integrate, "solve_ivp", lambda *a, **k: calls.append(1) or plain(*a, **k))
    model = loop(Tank(name="plant")).linearize()
    assert calls
    assert np.max(np.abs(model.affine)) == pytest.approx(np.sqrt(3.0) * np.tanh(np.sqrt(3.0) * T), rel=1e-9)


def exchanged(path, gain=-3.0, **start):
    plant = Fmu(path, interface="model_exchange", name="plant", start=start)
    read, push = ("y", "u") if "y" in plant.output_variables else ("position", "force")

    @subsystem(sample_time=T, name="controller")
    def controller(y):
        return Gain(gain=gain, name="k")(y).named("f")

    return Diagram("loop", plant(**{push: controller(getattr(plant, read))}))


def test_an_fmu_in_model_exchange_at_rest_is_no_integration(cache, monkeypatch):
    """Its derivatives are asked for once at each instant, whatever wires and parameters they are for."""
    monkeypatch.setattr(scipy.integrate, "solve_ivp", lambda *_, **__: pytest.fail("integrated"))
    asked = []
    plain = ModelExchangeEvaluator.differentiate
    monkeypatch.setattr(ModelExchangeEvaluator, "differentiate", lambda s, *a: asked.append(a[1]) or plain(s, *a))
    diagram = exchanged(mass_spring_damper.build(), position=0.0)
    model = diagram.linearize()
    A, B = np.array([[0.0, 1.0], [-100.0, -1.0]]), np.array([[0.0], [1.0]])
    held = expm(np.block([[A, B], [np.zeros((1, 3))]]) * T)
    closed = held[:2, :2] - 3.0 * held[:2, 2:] @ [[1.0, 0.0]]
    found = np.sort_complex(model.poles[np.abs(model.poles) > 1e-12])
    assert found == pytest.approx(np.sort_complex(np.linalg.eigvals(closed)), rel=1e-12)
    diagram.sensitivities("f", ["k.gain"])
    assert len(asked) <= 60  # 400 and more where it is integrated, along the gain four times as many again


class Dated(Block):
    """A first-order lag that becomes faster, with a disturbance that grows: ẋ = u − (1 + a t) x + b t²."""

    u = Input(shape=())
    y = Output(shape=())
    x = State(start=0.0)
    a: float = parameter(default=0.0)
    b: float = parameter(default=0.0)

    def derivative(self, t, x, u):
        return u.u - (1.0 + self.a * t) * x.x + self.b * t**2

    def output(self, t, x, u):
        return x.x


@pytest.mark.parametrize(
    ("start", "transition", "end"),
    [
        ({"b": 1.0}, np.exp(-T), T**2 - 2.0 * T + 2.0 - 2.0 * np.exp(-T)),
        ({"a": 40.0}, np.exp(-T - 20.0 * T**2), 0.0),
    ],
    ids=["its motion", "its derivatives"],
)
@pytest.mark.slow
def test_an_fmu_at_rest_that_follows_time_is_integrated(start, transition, end, cache):
    model = exchanged(build(Dated()), gain=0.0, **start).linearize()
    assert model.A[0, 0] == pytest.approx(transition, rel=1e-9)
    assert model.affine[0] == pytest.approx(end, abs=1e-12)


def pushed(load):
    """ẏ = −2 y + u + load, u = −1.5 y held over 0.1 s."""
    plant = TransferFunction(numerator=(1.0,), denominator=(1.0, 2.0), name="plant")
    controller = subsystem(sample_time=0.1, name="controller")(lambda y: Gain(gain=-1.5)(y).named("u"))
    return Diagram("loop", plant(controller(plant.y) + load))


@pytest.mark.parametrize("k", [2, 3, 4])
def test_a_step_that_pushes_a_plant_is_integrated_in_the_sample_alone_in_which_it_jumps(monkeypatch, k):
    """Ahead of it and behind it the flow doesn't depend on time: a report of three rates took 80 s, and 30 s so."""
    calls, plain = [], scipy.integrate.solve_ivp
    monkeypatch.setattr(scipy.integrate, "solve_ivp", lambda *a, **o: calls.append(1) or plain(*a, **o))
    model = pushed(Step(times=0.35, values=3.0, initial_value=1.0, name="load")).linearize(k / 10, outputs="plant.y")
    y, e, half = 0.0, np.exp(-0.2), np.exp(-0.1)
    for tick in range(k + 1):
        before, push = y, 3.0 if tick > 3 else 1.0
        y = e * y + (1.0 - e) / 2.0 * (-1.5 * y + push) + (1.0 - half) * (tick == 3)  # 2 more for the last 0.05 s
    assert (model.C @ model.affine)[0] == pytest.approx(y - before, rel=1e-6)  # of the run up to there
    assert model.A[0, 0] == pytest.approx(e - 1.5 * (1.0 - e) / 2.0, rel=1e-12)
    assert bool(calls) == (k == 3)


class Switched(Block):
    """A source that jumps at 0.35 s, which can't be read from it."""

    y = Output(shape=())

    def output(self, t, x, u):
        return np.where(t * t < 0.1225, 1.0, 3.0)


@pytest.mark.parametrize("load", [Switched(name="load"), Sine(amplitude=1.0, frequency=3.0, name="load")])
def test_a_source_that_announces_no_instants_or_that_moves_is_integrated(monkeypatch, load):
    calls, plain = [], scipy.integrate.solve_ivp
    monkeypatch.setattr(scipy.integrate, "solve_ivp", lambda *a, **o: calls.append(1) or plain(*a, **o))
    pushed(load).linearize(0.1)
    assert calls
