"""Modes that a loop doesn't see in the Nyquist count: Z = N + P is that of the realization that was given."""

import control
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.linalg import block_diag

from loopwright.blocks import Constant, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.frequency import margins, nyquist_count
from support.loops import numbers, open_loops
from support.random_cases import random_cases

SEEN = {0: control.tf([2.0, 3.0], [1.0, 1.0, -2.0]), 0.1: control.tf([0.5, 0.1], [1.0, -1.7, 0.6], 0.1)}
"""Loops by their sample time, each with a pole beyond the limit: 1, and 1.2."""
WAYS = ("not driven", "not seen", "neither")


def hide(loop, poles, way, *, rotated=False, coupling=0.0):
    """Return a loop with further modes. They have the given poles, and are coupled by rounding at the most."""
    rng, n, m = np.random.default_rng(len(poles)), loop.nstates, len(poles)
    A = block_diag(loop.A, np.diag(poles))
    into, out = coupling * rng.normal(size=(2, m))
    B = np.append(loop.B[:, 0], into + (way == "not seen"))[:, None]
    C = np.append(loop.C[0], out + (way == "not driven"))[None, :]
    if rotated:
        Q, _ = np.linalg.qr(rng.normal(size=(n + m, n + m)))
        A, B, C = Q @ A @ Q.T, Q @ B, C @ Q.T
    return control.ss(A, B, C, loop.D, loop.dt)


def poles_beyond(loop):
    """Return the numbers of open-loop and closed-loop poles beyond the limit, by the eigenvalues of what was given."""
    A, B, C, D = loop.A, loop.B, loop.C, loop.D
    found = []
    for M in (A, A - B @ C / (1 + D[0, 0])):
        p = np.linalg.eigvals(M)
        found.append(int(np.sum((np.abs(p) - 1 if loop.dt else p.real) > 1e-6)))
    return tuple(found)


def check(loop):
    count = nyquist_count(loop)
    assert (count.open_loop, count.closed_loop) == poles_beyond(loop)
    assert count.closed_loop == count.encirclements + count.open_loop
    return count


@pytest.mark.parametrize("dt", [0, 0.1])
@pytest.mark.parametrize("gain", [0.3, 4.0])
def test_of_two_equal_lags_in_parallel_one_mode_stays_unstable(dt, gain):
    # k/(s − 1) + k/(s − 1): the sum of the states sees the feedback, their difference doesn't
    count = check(control.ss((1.0 + dt) * np.eye(2), [[1.0], [1.0]], [[gain * (dt or 1.0) / 2] * 2], 0, dt))
    assert (count.open_loop, count.closed_loop) == (2, 2 if gain < 1 else 1)
    assert count.encirclements == (0 if gain < 1 else -1)
    assert count.hidden_unstable == pytest.approx([1.0 + dt], rel=1e-12)


@pytest.mark.parametrize("coupling", [0.0, 1e-13])
@pytest.mark.parametrize("rotated", [False, True])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("dt", "poles"), [(0, [3.0]), (0, [0.5, -4.0, 2.0]), (0.1, [1.3]), (0.1, [-1.1, 0.5, 1.05])])
@pytest.mark.drawn
def test_hidden_unstable_modes_count_in_the_open_and_in_the_closed_loop(dt, poles, way, rotated, coupling):
    seen = control.ss(SEEN[dt])
    for gain in (0.1, 1.0):
        alone = nyquist_count(gain * seen)
        count = check(hide(gain * seen, poles, way, rotated=rotated, coupling=coupling))
        beyond = sorted(p for p in poles if (abs(p) - 1 if dt else p) > 0)
        assert count.encirclements == alone.encirclements
        assert count.open_loop == alone.open_loop + len(beyond)
        assert sorted(np.real(count.hidden_unstable)) == pytest.approx(beyond, rel=1e-9)


@pytest.mark.drawn(2)
@pytest.mark.parametrize("way", WAYS)
def test_lags_that_differ_by_rounding_alone_count_as_equal_ones(way):
    for apart in (0.0, 1e-15, 1e-13, 1e-12):
        loop = control.ss(np.diag([1.0, 1.0 + apart]), [[1.0], [1.0]], [[0.3, 0.3]], 0)
        assert check(hide(loop, [2.0], way)).closed_loop == 3


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("dt", "poles"), [(0, [-3.0, -0.1]), (0.1, [0.5, -0.9]), (0.1, [0.0])])
def test_hidden_stable_modes_change_nothing(dt, poles, way):
    seen = control.ss(SEEN[dt])
    count = check(hide(seen, poles, way, rotated=True))
    assert count == nyquist_count(seen)
    assert repr(count) == repr(nyquist_count(seen))
    assert "hidden_unstable" not in str(count)
    assert count.hidden_unstable == ()


@pytest.mark.parametrize(("dt", "pole"), [(0, 0.0), (0.1, 1.0), (0.1, -1.0)])
def test_a_hidden_mode_on_the_limit_is_not_counted_as_none_on_it_is(dt, pole):
    seen = control.ss(SEEN[dt])
    assert nyquist_count(hide(seen, [pole], "not seen")) == nyquist_count(seen)


def test_whole_samples_of_delay_leave_the_hidden_modes_counted():
    loop = hide(control.ss(0.2 * SEEN[0.1]), [1.3], "not seen")
    late = control.ss(0, 1, 1, 0, 0.1) * control.ss(loop)
    count = nyquist_count(loop, delay=1)
    assert (count.open_loop, count.closed_loop) == poles_beyond(late) == (2, count.encirclements + 2)


@pytest.mark.parametrize("D", [0.0, 2.0, -3.0])
def test_a_loop_of_hidden_modes_alone_keeps_them(D):
    count = check(control.ss([[2.0]], [[0.0]], [[1.0]], D))
    assert (count.encirclements, count.open_loop, count.closed_loop) == (0, 1, 1)


def test_hidden_unstable_modes_are_told_by_their_poles():
    told = "3: not in this loop, and not moved by feedback around it"
    loop = hide(control.ss(SEEN[0]), [3.0], "not seen")
    count = nyquist_count(loop)
    assert repr(count).endswith(f"closed_loop=1, hidden_unstable={count.hidden_unstable!r})")
    assert str(count).splitlines()[-1] == f"  hidden_unstable  {told}"
    assert told in str(margins(loop))
    sampled = nyquist_count(hide(control.ss(SEEN[0.1]), [-1.1], "not seen"))
    assert "hidden_unstable  -1.1: not in this loop" in str(sampled)


@pytest.mark.parametrize("dt", [0, 0.1])
@pytest.mark.parametrize("driven", [False, True])
def test_a_loop_of_a_diagram_counts_a_mode_that_its_wire_does_not_see(dt, driven):
    """L = 2/(s + 1) around a lag, and 1/(s − 3) that the wire drives beside it, or that adds to the lag."""
    lag = TransferFunction(numerator=[2.0], denominator=[1.0, 1.0], name="lag")
    other = TransferFunction(numerator=[1.0], denominator=[1.0, -3.0], name="other")

    @subsystem(sample_time=dt or None)
    def controller(y):
        return Constant(value=0.0, name="r") - y

    if driven:
        u = controller(lag.y).named("u")
        loop = Diagram("d", lag(u), other(u)).linearize().loop("u")
    else:
        u = controller((lag.y + other(Constant(value=0.0, name="w"))).named("y")).named("u")
        loop = Diagram("d", lag(u), other.y).linearize().loop("u")
    count = check(loop)
    assert (count.encirclements, count.open_loop, count.closed_loop) == (0, 1, 1)
    assert np.real(count.hidden_unstable) == pytest.approx([np.exp(3.0 * dt) if dt else 3.0], rel=1e-9)


@pytest.mark.parametrize("pole", [-3.0, -1e4, 1.5])
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.drawn
def test_an_integrator_stays_on_the_limit_beside_a_hidden_mode_in_rotated_states(pole, seed):
    # L = −1/s: the open loop is on the limit, which doesn't count, the closed loop s − 1 is beyond it, with N = 1
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(2, 2)))
    loop = control.ss(Q @ np.diag([0.0, pole]) @ Q.T, Q @ [[1.0], [0.0]], [[-1.0, 2.0]] @ Q.T, 0)
    count, beyond = check(loop), int(pole > 0)
    assert (count.encirclements, count.open_loop, count.closed_loop) == (1, beyond, 1 + beyond)
    assert margins(loop).encirclements == 1


@pytest.mark.parametrize("fast", [10.0, 1e3, 1e5])
@pytest.mark.parametrize("rotated", [False, True])
def test_a_hidden_pendulum_on_a_cart_counts_beside_a_fast_filter(fast, rotated):
    # the poles 0, 0 and ±1 have the mean 0, as four of a chain of integrators have that rounding has scattered
    A = block_diag([[-fast]], [[0.0, 1.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]])
    Q = np.eye(5)
    if rotated:
        Q[1:, 1:], _ = np.linalg.qr(np.random.default_rng(3).normal(size=(4, 4)))
    loop = control.ss(Q @ A @ Q.T, Q @ [[fast], [0], [0], [0], [0]], [[1.0, 1.0, 0, 1.0, 0]] @ Q.T, 0)
    count = nyquist_count(loop)
    assert (count.encirclements, count.open_loop, count.closed_loop) == (0, 1, 1)
    assert np.real(count.hidden_unstable) == pytest.approx([1.0], rel=1e-6)
    assert margins(loop).hidden_unstable == count.hidden_unstable


@random_cases(
    10,
    150,
    open_loops(sampled=False) | open_loops(sampled=True),
    st.lists(numbers(-2, 2), min_size=1, max_size=3),
    st.sampled_from(WAYS),
    st.booleans(),
    reaching=0.3,
)
def test_counts_of_random_loops_with_hidden_modes_are_those_of_what_was_given(loop, rates, way, rotated):
    loop = hide(loop, np.exp(np.multiply(rates, loop.dt)) if loop.dt else rates, way, rotated=rotated)
    A, B, C, D = loop.A, loop.B, loop.C, loop.D
    p = np.linalg.eigvals(A - B @ C / (1 + D[0, 0]))
    if np.abs(np.abs(p) - 1 if loop.dt else p.real).min() <= 1e-5:  # on the limit, where rounding decides
        return False
    check(loop)
    return True
