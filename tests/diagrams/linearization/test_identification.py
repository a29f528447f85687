"""FMUs that give neither derivatives nor their states: linear models from pulse responses, against closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, Gain
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization import identification as _identification
from loopwright.diagrams.linearization.identification import identify_step, realize
from loopwright.fmus import Fmu, FmuError, dc_motor, gantry, mass_spring_damper
from support.plants import hidden

H = 1e-3


def held(A, B, h=H):
    n, m = B.shape
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * h)
    return both[:n, :n], both[:n, n:]


def responses(A, B, C, D, count):
    """Outputs after each step, of a pulse in the first one."""
    found, x = [], B
    for k in range(count):
        found.append(C @ x + (D if k == 0 else 0.0))
        x = A @ x
    return np.array(found)


def got(m, count):
    return responses(m.A, m.B, m.C, 0.0, count)


@pytest.mark.parametrize("saves", [True, False])
@pytest.mark.drawn(1)
def test_a_mass_on_a_spring_is_found_with_its_poles_and_feedthrough(tmp_path, saves):
    """m s̈ + d ṡ + k s = F; the acceleration's feedthrough is a pole at z = 0."""
    block = Fmu(hidden(mass_spring_damper.build(), tmp_path, saves=saves), start={"position": 0.0})
    assert not block.description.states
    m = identify_step(block, {"t": 0.0, "state": {}, "inputs": {"force": np.array(0.0)}}, H)
    A, B = held(np.array([[0, 1.0], [-100, -1]]), np.array([[0.0], [1]]))
    C, D = np.array([[1.0, 0], [0, 1], [-100, -1]]), np.array([[0.0], [0], [1]])
    assert len(m.A) == 3
    want = responses(A, B, C, D, 2000)
    np.testing.assert_allclose(got(m, 2000), want, atol=1e-7 * np.max(np.abs(want)))
    poles = np.sort_complex(np.linalg.eigvals(m.A))
    np.testing.assert_allclose(poles, np.sort_complex([0.0, *np.linalg.eigvals(A)]), atol=1e-7)
    assert m.uncertainty <= 1e-9
    again = identify_step(block, {"t": 0.0, "state": {}, "inputs": {"force": np.array(0.0)}}, H)
    assert again is m  # a point is identified once
    with pytest.raises(ValueError, match="read-only"):
        m.A[0, 0] = 0.0


@pytest.mark.slow
def test_a_motor_is_found_with_both_its_inputs(tmp_path):
    """Poles of 600 1/s and 180 1/s beside an integrator."""
    motor = dc_motor.build()
    known = Fmu(motor, start={"voltage": 0.0, "load_torque": 0.0}).linear_model()
    block = Fmu(hidden(motor, tmp_path), start={"voltage": 0.0, "load_torque": 0.0})
    inputs = {name: np.zeros(port.shape or ()) for name, port in block.inputs.items()}
    m = identify_step(block, {"t": 0.0, "state": {}, "inputs": inputs}, H)
    A, B = held(known.A, known.B)
    want = responses(A, B, known.C, known.D, 1000)
    scale = np.max(np.abs(want), axis=0)
    assert np.max(np.abs(got(m, 1000) - want) / np.where(scale > 0, scale, 1.0)) <= 1e-5


@pytest.mark.slow
def test_a_loop_around_it_is_that_around_the_open_one(tmp_path):
    def loop(file):
        plant = Fmu(file, name="plant", start={"position": 0.0})

        @subsystem(sample_time=H)
        def law(s, v):
            return (Gain(gain=-30.0, name="kp")(s) + Gain(gain=-4.0, name="kd")(v)).named("u")

        return Diagram("d", plant(force=law(plant.position, plant.velocity)))

    file = mass_spring_damper.build()
    plain, blind = (loop(f).linearize() for f in (file, hidden(file, tmp_path)))
    assert blind.how["plant"].startswith("identified from pulse responses, order 3")
    assert 0 < blind.uncertainty <= 1e-6
    z = np.exp(1j * np.geomspace(1, 1000, 8) * H)
    a, b = (m.loop("u")(z) for m in (plain, blind))
    np.testing.assert_allclose(b, a, rtol=1e-5)
    slow = [np.sort_complex(m.poles[np.abs(m.poles) > 0.5]) for m in (plain, blind)]
    np.testing.assert_allclose(slow[1], slow[0], atol=1e-8)


def test_it_can_be_asked_for_where_there_are_derivatives():
    plant = Fmu(mass_spring_damper.build(), name="plant", start={"position": 0.0})
    diagram = Diagram("d", plant(force=Constant(value=0.0, name="force")))
    point = diagram.operating_point(step=H)
    a, b = (
        diagram.linearize(point, inputs="force.y", outputs="plant.position", plants=way, step=H).system
        for way in ("equations", "identified")
    )
    z = np.exp(1j * np.geomspace(1, 1000, 8) * H)
    np.testing.assert_allclose(b(z), a(z), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize(("pulse", "bound"), [(1e-2, 1e-6), (20.0, 1e-4)])
def test_friction_in_the_pulse_is_taken_away(tmp_path, monkeypatch, pulse, bound):
    """Axis y at rest: m v̇ = F − (F_c/w + c_v) v; at 20 N its bend alone is 1e-3."""
    monkeypatch.setattr(_identification, "PULSE", pulse)
    start = {"motor_force": (0.0, 0.0), "external_force": (0.0, 0.0), "internal_step": 2e-4, "gravity": 0.0}
    block = Fmu(hidden(gantry.build(), tmp_path), start=start)
    inputs = {name: np.zeros(2) for name in ("motor_force", "external_force")}
    m = identify_step(block, {"t": 0.0, "state": {}, "inputs": inputs}, H)
    rate = (65.42 / 0.01 + 175.93) / 36.87
    velocity = got(m, 50)[:, 2, 0]
    want = (1 - np.exp(-rate * H)) / rate / 36.87 * np.exp(-rate * H * np.arange(50))
    np.testing.assert_allclose(velocity, want, atol=bound * want[0])


@pytest.mark.slow
def test_where_it_comes_to_no_rest_or_to_another_one_is_an_error(tmp_path):
    block = Fmu(hidden(mass_spring_damper.build(), tmp_path), start={"position": 0.0})
    point = {"t": 0.0, "state": {}, "inputs": {"force": np.array(0.0)}}
    with pytest.raises(FmuError, match="comes to rest by itself"):
        identify_step(block, point, H, np.array([0.2, 0.0, -20.0]))
    motor = Fmu(hidden(dc_motor.build(), tmp_path), start={"voltage": 1.0, "load_torque": 0.0})
    spinning = {"t": 0.0, "state": {}, "inputs": {"voltage": np.array(1.0), "load_torque": np.array(0.0)}}
    with pytest.raises(FmuError, match="it still moves after"):
        identify_step(motor, spinning, H)


def test_a_realization_has_the_order_of_what_it_explains():
    """A double integrator, a fast pole, and a delay, with noise and without."""
    A = np.diag([1.0, 1.0, 0.2, 0.0])
    A[0, 1] = 1e-2
    B, C = np.array([[0.0], [1], [1], [1]]), np.array([[1.0, 0, 0.5, 2.0]])
    G = responses(A, B, C, 0.0, 800)
    for noise, order in ((0.0, 4), (1e-6, 4)):
        shaken = G + noise * np.random.default_rng(1).standard_normal(G.shape)
        a, b, c, sigma = realize(shaken, np.full((1, 1), noise))
        assert len(a) == order
        assert len(sigma) > order
        np.testing.assert_allclose(responses(a, b, c, 0.0, 800), G, atol=1e-10 + 300 * noise)
