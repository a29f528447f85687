"""Limits confirmed for plants that are none of the library's, against matrices of our own."""

import re
import zipfile
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import Block, Constant, Gain, Input, OptionError, Output, State
from loopwright.diagrams import ConfirmationError, Diagram, subsystem
from loopwright.diagrams.contact.attached_environment import attach_environment
from loopwright.diagrams.contact.confirmed_limits import LimitTrials
from loopwright.diagrams.contact.moored_plant import Mooring
from loopwright.diagrams.linearization import linearize_plant
from loopwright.fmus import Fmu, build
from loopwright.types import TrialMethod
from support.haptic import HANDLE, haptic

M, SHARE, DRAG, T, SUBSTEPS = 0.5, 8.0, 40.0, 5e-3, 10
"""Mass in kg, share of the measured force that the drive adds, drag in N s/m, sample time in s."""
B = 10.0
"""Damping of the environment in N s/m."""
PORTS = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt"}


class SampledCart(Block):
    """A mass with two forces, that does not show its acceleration."""

    motor = Input(unit="N")
    push = Input(unit="N")
    position = State(unit="m", start=0.0, output=True)
    velocity = State(unit="m/s", start=0.0, output=True)

    def derivative(self, t, x, u):
        return x.velocity, (u.motor + u.push) / M


class ShowingCart(SampledCart):
    acceleration = Output(unit="m/s2")

    def output(self, t, x, u):
        return (u.motor + u.push) / M


@cache
def cart_file(cls=SampledCart):
    return build(cls(), name=cls.__name__.lower())


def without(interface, folder):
    """The cart's FMU without one of its interfaces."""
    path = folder / f"without_{interface}.fmu"
    with zipfile.ZipFile(cart_file()) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                text = data.decode()
                data = re.sub(rf"<{interface}\b[^>]*/>", "", text).encode()
                assert data.decode() != text
            new.writestr(item, data)
    return path


def contact(cart):
    hand = Constant(value=0.0, unit="N", name="hand")

    @subsystem(sample_time=T)
    def drive(velocity, push):
        felt = Gain(gain=1.0, name="sensor")(push).named("felt")
        return Gain(gain=SHARE, name="share")(felt) - Gain(gain=DRAG, name="drag")(velocity)

    made = Diagram("cart", cart(motor=drive(cart.velocity, hand), push=hand))
    return made.contact("cart.push", direction=[1.0], **PORTS)


def step_matrix(h, k=0.0, b=0.0, m=0.0):
    """Matrix over h of (x, v, u, f): (M + m) v̇ = u + f − k x − b v, with u and f held."""
    A = np.zeros((4, 4))
    A[0, 1] = 1.0
    A[1] = np.array([-k, -b, 1.0, 1.0]) / (M + m)
    return expm(A * h)


def growth(k, b=0.0, m=0.0):
    """ln|z|/T of the slowest pole: the force is exact, and measured under the last u; u = SHARE f − DRAG v."""
    whole = step_matrix(T, k, b, m)[:2, :3]
    # the force on the mass m: −k x − b v − m v̇, with v̇ = (u − k x − b v)/(M + m)
    felt = np.array([-k, -b, 0.0]) - m * np.array([-k, -b, 1.0]) / (M + m)
    u = SHARE * felt - DRAG * np.array([0.0, 1.0, 0.0])
    closed = np.vstack([whole[:, :2] @ np.eye(3)[:2] + np.outer(whole[:, 2], u), u])
    return np.log(np.max(np.abs(np.linalg.eigvals(closed)))) / T


def growth_held(k, b=0.0):
    """ln|z|/T where f = −k x − b v is held over T/10, and u over T."""
    part = step_matrix(T / SUBSTEPS)
    f = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-k, -b, 0.0]])
    first = np.array([[1, 0], [0, 1], [-SHARE * k, -SHARE * b - DRAG]])
    closed = np.linalg.matrix_power((part @ f)[:3], SUBSTEPS) @ first
    return np.log(np.max(np.abs(np.linalg.eigvals(closed[:2])))) / T


def root(function, near):
    return brentq(function, 0.7 * near, 1.3 * near, xtol=1e-300, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "method"),
    [
        pytest.param("block", "SOLVER", marks=pytest.mark.slow),
        pytest.param("both", "SOLVER", marks=pytest.mark.slow),
        ("co_simulation", "HELD"),
        pytest.param("model_exchange", "SOLVER", marks=pytest.mark.slow),
    ],
)
def test_a_spring_at_a_plant_that_is_none_of_the_librarys(plant, method, tmp_path):
    file = {"co_simulation": "ModelExchange", "model_exchange": "CoSimulation"}.get(plant)
    file = cart_file() if file is None else without(file, tmp_path)
    here = contact(SampledCart(name="cart") if plant == "block" else Fmu(file, name="cart", isolate=False))
    limit = here.stability_limit(damping=B)
    assert limit.value == pytest.approx(root(lambda k: growth(k, B), limit.value), rel=1e-9)
    found = here.confirm(limit)
    assert found.method is TrialMethod[method]
    expected = growth if method == "SOLVER" else growth_held
    assert found.tried == pytest.approx(root(lambda k: expected(k, B), limit.value), rel=1e-5)
    for trial, factor in zip(found.trials, (0.97, 1.03), strict=True):
        rate = expected(factor * found.tried, B)
        assert trial.predicted == pytest.approx(rate, rel=1e-4)
        assert trial.measured == pytest.approx(rate, rel=5e-3)
        assert 0.3e-6 < trial.fastest < 1e-3
    assert found.method.value in str(found)
    assert ("limit that the held force has itself" in str(found)) is (method == "HELD")


@pytest.mark.parametrize(
    ("plant", "method"),
    [
        (SampledCart, None),
        pytest.param(ShowingCart, None, marks=pytest.mark.slow),
        pytest.param("fmu", "held", marks=pytest.mark.slow),
    ],
)
def test_a_mass_at_a_plant_that_is_none_of_the_librarys(plant, method):
    here = contact(Fmu(cart_file(), name="cart", isolate=False) if plant == "fmu" else plant(name="cart"))
    limit = here.stability_limit("mass", stiffness=100.0)
    m = root(lambda m: growth(100.0, 0.0, m), limit.value)
    assert limit.value == pytest.approx(m, rel=1e-9)
    found = here.confirm(limit, method=method)
    assert found.tried == pytest.approx(m, rel=0.02 if method == "held" else 1e-9)  # T/10 more of delay
    for trial in found.trials:
        assert trial.measured == pytest.approx(trial.predicted, rel=0.02)
    if method != "held":
        assert found.above.predicted == pytest.approx(growth(100.0, 0.0, found.above.value), rel=1e-6)


def test_a_method_that_a_plant_does_not_allow_is_refused(tmp_path):
    here = contact(Fmu(without("ModelExchange", tmp_path), name="cart", isolate=False))
    limit = here.stability_limit()
    with pytest.raises(OptionError, match=r"cart.method: found 'solver'.*expected one of held"):
        here.confirm(limit, method="solver")
    with pytest.raises(OptionError, match=r"found 'hold'. Did you mean 'held'"):
        here.confirm(limit, method="hold")


def test_a_run_that_an_fmus_solver_damps_refutes_its_limit_and_says_what_to_try(tmp_path, monkeypatch):
    here = contact(Fmu(without("ModelExchange", tmp_path), name="cart", isolate=False))
    limit = here.stability_limit(damping=B)

    def damped(trials, value, push, duration):
        t = np.arange(0.0, duration + T, T)
        return t, 1e-6 * np.exp(-9.0 * t) * np.cos(limit.frequency * t), 1e-6

    monkeypatch.setattr(LimitTrials, "run", damped)
    with pytest.raises(ConfirmationError, match=r"cart: stiffness .* is refuted.*StepOptions\(tolerance=1e-10\)"):
        here.confirm(limit)


def test_a_mass_that_no_sensor_feels_is_sampled_nowhere():
    here = haptic(300.0).contact("handle.push", direction=[1.0], **HANDLE)
    model = linearize_plant(here.wired, here.point, here.plant)
    mooring = Mooring(np.array([1.0]), np.zeros(()), stiffness=100.0, mass=0.1, kick=1.0, kick_time=1e-3)
    made = attach_environment(here.wired, here.ports, model, None, mooring, None, Fraction(1, 1000))
    assert "environment" in made.blocks
    assert [path for path in made.blocks if path.startswith("environment_sampling")] == []
