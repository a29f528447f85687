"""Stiff problems in C: values of the literature, closed forms, and the change of the method."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, expm

from loopwright.blocks import Block, Event, State, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled.method_coefficients import radau_numbers

QUIET = {"progress": False}
T = 1e-3


class Hires(Block):
    y = State(start=[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057], output=True)

    def derivative(self, t, x, u):
        y = x.y
        p = 280.0 * y[5] * y[7]
        rates = [
            -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
            1.71 * y[0] - 8.75 * y[1],
            -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
            8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
            -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
            -p + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
            p - 1.81 * y[6],
            -p + 1.81 * y[6],
        ]
        return np.stack(rates)


AT_THE_END = [
    0.7371312573325668e-3,
    0.1442485726316185e-3,
    0.5888729740967575e-4,
    0.1175651343283149e-2,
    0.2386356198831331e-2,
    0.6238968252742796e-2,
    0.2849998395185769e-2,
    0.2850001604814231e-2,
]
"""Of HIRES at t = 321.8122 s: Test Set for IVP Solvers."""


@pytest.mark.parametrize("solver", ["Radau", "auto"])
def test_hires_ends_at_the_values_of_the_test_set(solver):
    made = Diagram("hires", Hires(name="system"))
    errors = []
    for rtol in (1e-4, 1e-7):
        options = {"step": 321.8122, "solver": solver, "rtol": rtol, "atol": 1e-4 * rtol}
        run = made.simulate(321.8122, compile=True, **options, **QUIET)
        errors.append(np.max(np.abs(run["system.y"][-1] / AT_THE_END - 1.0)))
    assert errors[0] < 5e-2
    assert errors[1] < 1e-4


class VanDerPol(Block):
    x = State(start=2.0, output=True)
    v = State(output=True)

    def derivative(self, t, x, u):
        return x.v, 1000.0 * (1.0 - x.x**2) * x.v - x.x


def test_auto_changes_to_radau_says_so_and_is_as_accurate_as_interpreted():
    made = Diagram("vdp", VanDerPol(name="system"))
    runs = [made.simulate(600.0, rtol=1e-5, atol=1e-8, compile=form, **QUIET) for form in (False, True)]
    told = [[m for m in run.messages if "RK45 → Radau" in m] for run in runs]
    assert float(told[0][0].split()[2]) < 1.0
    assert told[0] == told[1]
    exact = solve_ivp(
        lambda t, x: [x[1], 1000.0 * (1.0 - x[0] ** 2) * x[1] - x[0]],
        (0.0, 600.0),
        [2.0, 0.0],
        "Radau",
        runs[1].t,
        jac=lambda t, x: [[0.0, 1.0], [-2000.0 * x[0] * x[1] - 1.0, 1000.0 * (1.0 - x[0] ** 2)]],
        rtol=1e-9,
        atol=1e-12,
    )
    errors = [np.max(np.abs(run["system.x"] - exact.y[0])) for run in runs]
    assert errors[1] < max(1.5 * errors[0], 1e-5)


def fast_loop():
    """A PI controller at 1 kHz around a lag of 10 µs and one of 50 ms: stiff at each of its ticks."""

    @subsystem(sample_time=T, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 2.0 * error + 5.0 * memory(memory.y + T * error)

    slow = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="slow")
    fast = TransferFunction(numerator=1.0, denominator=[1e-5, 1.0], name="fast")
    return Diagram("loop", slow(fast(controller(slow.y))).named("y"))


def exact_fast(n):
    A = np.array([[-20.0, 20.0], [0.0, -1e5]])
    step = expm(T * np.vstack([np.hstack([A, [[0.0], [1e5]]]), np.zeros((1, 3))]))
    x, integral, found = np.zeros(2), 0.0, []
    for _ in range(n + 1):
        found.append(x[0])
        error = 1.0 - x[0]
        x, integral = step[:2, :2] @ x + step[:2, 2] * (2.0 * error + 5.0 * integral), integral + T * error
    return np.array(found)


@pytest.mark.parametrize(("rtol", "bound"), [(1e-4, 1e-5), (1e-8, 3e-8)])
def test_a_stiff_plant_under_a_controller_is_that_of_the_matrix_exponential(rtol, bound):
    run = fast_loop().simulate(0.3, solver="Radau", rtol=rtol, atol=1e-3 * rtol, compile=True, **QUIET)
    assert np.max(np.abs(run["y"] - exact_fast(300))) < bound


class Switched(Block):
    """A decay that an event makes a thousand times faster."""

    x = State(start=1.0, output=True)
    speed = State(start=1.0)
    late = Event("rising")

    def derivative(self, t, x, u):
        return -x.speed * x.x, 0.0 * x.speed

    def indicators(self, t, x, u):
        return t - 0.5

    def jump(self, t, x, u, fired):
        return x.x, 1000.0 * x.speed


def test_an_event_that_changes_the_slope_leaves_no_old_one():
    run = Diagram("d", Switched(name="s")).simulate(
        0.52, step=0.01, solver="Radau", rtol=1e-8, atol=1e-12, compile=True, **QUIET
    )
    expected = np.where(run.t <= 0.5, np.exp(-run.t), np.exp(-0.5 - 1000.0 * (run.t - 0.5)))
    assert np.max(np.abs(run["s.x"] - expected)) < 1e-7


def test_the_numbers_of_radau_make_its_coefficients_block_diagonal():
    root = np.sqrt(6.0)
    A = np.array(
        [
            [(88 - 7 * root) / 360, (296 - 169 * root) / 1800, (-2 + 3 * root) / 225],
            [(296 + 169 * root) / 1800, (88 + 7 * root) / 360, (-2 - 3 * root) / 225],
            [(16 - root) / 36, (16 + root) / 36, 1 / 9],
        ]
    )
    numbers = radau_numbers()
    left, right, P = (numbers[i : i + 9].reshape(3, 3) for i in (6, 15, 24))
    real, re, im = numbers[33:]
    D = block_diag(real, np.array([[re, -im], [im, re]]))
    assert np.max(np.abs(left @ right - np.eye(3))) < 1e-15
    assert np.max(np.abs(A @ left @ D - left)) < 1e-14
    nodes = numbers[:3, None] ** np.arange(1, 4)
    assert np.max(np.abs(nodes @ P.T - np.eye(3))) < 1e-13
