"""Networks of linear plants with random matrices, coupled by gains, against the matrix exponential of the whole."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Gain
from loopwright.diagrams import Coupling, Diagram
from support.held_linear import HeldLinear


def network(seed, count=3, feedthrough=0.0):
    """Return a diagram of plants that are coupled by gains, and its outputs in closed form."""
    rng = np.random.default_rng(seed)
    parts, K = [], rng.normal(size=(count, count)) * 0.6
    np.fill_diagonal(K, 0.0)
    for i in range(count):
        n = int(rng.integers(1, 4))
        A = rng.normal(size=(n, n)) - 2.5 * np.eye(n)
        numbers = {"A": A, "B": rng.normal(size=n), "C": rng.normal(size=n), "start": rng.normal(size=n)}
        parts.append(HeldLinear(**numbers, D=feedthrough * float(rng.normal()), name=f"plant_{i}"))
    calls = []
    for i, part in enumerate(parts):
        pull = sum((Gain(gain=float(K[i, j]))(parts[j].y) for j in range(count) if j != i), start=0.0)
        calls.append(part(u=pull))
    sizes = np.cumsum([0, *(len(p.B) for p in parts)])
    A, B, C = np.zeros((sizes[-1], sizes[-1])), np.zeros((sizes[-1], count)), np.zeros((count, sizes[-1]))
    for i, p in enumerate(parts):
        mine = slice(sizes[i], sizes[i + 1])
        A[mine, mine], B[mine, i], C[i, mine] = p.A, p.B, p.C
    outputs = np.linalg.solve(np.eye(count) - np.diag([p.D for p in parts]) @ K, C)  # y = C x + D K y
    whole, start = A + B @ K @ outputs, np.concatenate([p.start for p in parts])
    return Diagram("network", *calls), lambda times: np.array([outputs @ expm(whole * t) @ start for t in times])


def error_of(made, **options):
    diagram, exactly = made
    run = diagram.simulate(1.0, progress=False, **options)
    names = [f"{path}.y" for path in sorted(diagram.blocks) if path.startswith("plant_")]
    return np.abs(np.column_stack([run[name] for name in names]) - exactly(run.t)).max()


@pytest.mark.drawn(3)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("scheme", "order"), [("jacobi", 1), ("gauss_seidel", 1), ("iterated", 2)])
def test_a_network_converges_with_the_order_of_the_scheme(seed, scheme, order):
    errors = [error_of(network(seed), step=h, coupling=scheme) for h in (1 / 40, 1 / 80)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("seed", range(3))
def test_iteration_solves_a_network_with_feedthrough_in_every_loop(seed):
    errors = [error_of(network(seed, feedthrough=1.0), step=h, coupling="iterated") for h in (1 / 40, 1 / 80)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.3)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("seed", range(2))
def test_adaptive_steps_keep_to_the_error(seed):
    for error in (1e-3, 1e-5):
        coupling = Coupling(scheme="iterated", error=error)
        assert error_of(network(seed, feedthrough=0.5), step=0.25, coupling=coupling) < 100 * error
