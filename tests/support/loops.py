"""Loops of which margins are asked for, and Hypothesis strategies that make more."""

import control
import numpy as np
from hypothesis import reject
from hypothesis import strategies as st


def triple(p):
    """The paper's continuous inner loop (3p s² + 3p² s + p³)/s³."""
    A = np.array([[0.0, 1, 0], [0, 0, 0], [1, 0, 0]])
    return control.ss(A, [[0.0], [1], [0]], [[3 * p**2, 3 * p, p**3]], 0)


def sampled_triple(p, T=1e-3):
    """The same gains, measured at the ticks, the command held, the integral by forward Euler."""
    A = np.array([[1.0, T, 0], [0, 1, 0], [T, 0, 1]])
    return control.ss(A, [[T**2 / 2], [T], [0]], [[3 * p**2, 3 * p, p**3]], 0, T)


def numbers(low, high):
    return st.floats(low, high, allow_nan=False).map(lambda v: float(np.round(v, 6)))


@st.composite
def modes(draw, unstable=True):
    """Real blocks of a few poles in different scales, lightly damped ones and integrators among them."""
    blocks = []
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["real", "pair", "integrator"]))
        size = 10 ** draw(numbers(-1, 2))
        sign = draw(st.sampled_from([-1.0, -1.0, 1.0])) if unstable else -1.0
        if kind == "real":
            blocks.append(np.array([[sign * size]]))
        elif kind == "pair":
            zeta = 10 ** draw(numbers(-3, 0)) * 0.99
            blocks.append(np.array([[0, size], [-size, 2 * sign * zeta * size]]))
        else:
            blocks.append(np.zeros((1, 1)))
    return blocks


@st.composite
def open_loops(draw, sampled):
    """A random loop with one channel: poles on both sides and on the limit, D or not."""
    blocks = draw(modes())
    n = sum(len(b) for b in blocks)
    A, at = np.zeros((n, n)), 0
    for b in blocks:
        A[at : at + len(b), at : at + len(b)] = b
        at += len(b)
    A += np.triu(np.where(np.add.outer(np.zeros(n), np.arange(n)) > 0, 0.1, 0.0), 2) * draw(st.integers(0, 1))
    B = np.array([[draw(numbers(0.1, 3))] for _ in range(n)])
    C = np.array([[draw(numbers(0.1, 3)) * draw(st.sampled_from([-1, 1])) for _ in range(n)]])
    D = draw(st.sampled_from([0.0, 0.0, 0.0, 0.4, -0.3, 2.0]))
    system = control.ss(A, B, C, D)
    return control.sample_system(system, 0.05 * draw(st.sampled_from([0.1, 1.0])), "zoh") if sampled else system


@st.composite
def stabilized_loops(draw, sampled):
    """A loop that is stable when closed: the state feedback of a random, possibly unstable, system (LQR)."""
    loop = draw(open_loops(sampled))
    n = loop.nstates
    weight = 10 ** draw(numbers(-1, 2))
    solve = control.dlqr if sampled else control.lqr
    try:
        K, _, _ = solve(loop.A, loop.B, np.eye(n) * weight, np.eye(1))
    except (np.linalg.LinAlgError, ValueError):  # a mode that can't be moved, or hardly, as SciPy says in two ways
        reject()
    return control.ss(loop.A, loop.B, K, 0, loop.dt)
