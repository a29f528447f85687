"""Algebraic loops: refused, printed port by port, or solved."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    Function,
    Gain,
    Product,
    PythonFunction,
    Relay,
    SimulationError,
    Sine,
    StateSpace,
    Sum,
    UnitDelay,
)
from loopwright.diagrams import AlgebraicLoopError, Diagram, NonFiniteError, subsystem
from support.hybrid_blocks import TIGHT, Lag, decay


def feedback(forward, back, source, **options):
    """``e = source − back(y)``, ``y = forward(e)``."""
    e = Sum(signs="+-", name="e")
    y = forward(e.y)
    return Diagram("loop", e(source, back(y)), loops="solve", **options)


def test_a_loop_is_refused_and_printed_port_by_port():
    e, g = Sum(signs="+-", name="e"), Gain(gain=0.5, name="g")
    with pytest.raises(AlgebraicLoopError) as caught:
        Diagram("loop", e(Constant(value=1.0), g(e.y)))
    text = str(caught.value)
    for line in ("e.y", "g.y", "wired to", "feeds through to"):
        assert line in text


def test_a_loop_through_subsystem_borders_is_found_and_printed_with_its_paths():
    @subsystem(sample_time=0.1)
    def inner(u):
        return Gain(gain=0.5, name="g")(u)

    e = Sum(signs="+-", name="e")

    @subsystem(sample_time=0.1)
    def outer():
        return e(Constant(value=1.0), inner(e.y))

    with pytest.raises(AlgebraicLoopError, match=r"outer\.inner\.g\.y"):
        Diagram("loop", outer())


def test_a_cycle_through_a_box_that_is_no_loop_between_ports_runs():
    """Two channels of one box: the second takes the first's way round."""

    @subsystem(sample_time=0.1)
    def box(a, b):
        return Gain(gain=2.0, name="g")(a).named("first"), Gain(gain=3.0, name="h")(b).named("second")

    plus = Sum(signs="++", name="plus")
    made = box(Constant(value=1.0), plus.y)
    run = Diagram("d", plus(made.first, 1.0), made).simulate(0.2, progress=False)
    assert run["second"].tolist() == [9.0, 9.0, 9.0]


@pytest.mark.parametrize("gain", [0.5, -0.3, 10.0, -25.0, 1e6])
def test_a_linear_loop_is_solved_exactly(gain):
    run = feedback(lambda e: Gain(gain=gain, name="k")(e), lambda y: y, Sine(frequency=1.0)).simulate(
        1.0, step=0.05, progress=False
    )
    e = np.sin(2 * np.pi * run.t) / (1 + gain)
    assert np.max(np.abs(run["e.y"] - e)) <= 1e-14
    assert np.max(run.residual) <= 1e-13


def test_a_loop_of_vectors_and_matrices_is_solved():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(4, 4))
    b = rng.normal(size=4)
    e = Sum(signs="++", name="e")
    run = Diagram("loop", e(Constant(value=b), Gain(gain=A, name="A")(e.y)), loops="solve").simulate(
        0.2, step=0.1, progress=False
    )
    assert np.allclose(run["e.y"], np.linalg.solve(np.eye(4) - A, b), rtol=1e-12)


def test_two_loops_that_share_a_block_are_solved_together():
    s = Sum(signs="+--", name="s")
    g, h = Gain(gain=2.0, name="g"), Gain(gain=3.0, name="h")
    run = Diagram("loops", s(Constant(value=12.0), g(s.y), h(s.y)), loops="solve").simulate(
        0.1, step=0.1, progress=False
    )
    assert run["s.y"] == pytest.approx([2.0, 2.0], rel=1e-14)


def test_a_nonlinear_loop_follows_its_branch():
    """Y + y³ = u(t), against a root finder."""
    cube = Function(lambda v: v**3, name="cube")
    e = Sum(signs="+-", name="e")
    run = Diagram("loop", e(Sine(frequency=1.0, amplitude=5.0), cube(e.y)), loops="solve").simulate(
        1.0, step=0.01, progress=False
    )
    exact = [brentq(lambda y: y + y**3 - 5 * np.sin(2 * np.pi * t), -3, 3, xtol=1e-15) for t in run.t]  # noqa: B023
    assert np.max(np.abs(run["e.y"] - exact)) < 1e-12
    assert run.residual.shape == run.t.shape
    assert np.max(run.residual) < 1e-13


@pytest.mark.drawn(3)
@pytest.mark.parametrize("solver", ["rk4", "DOP853", "Radau", "BDF", "CVODE_BDF", "auto"])
def test_a_loop_inside_the_rates_is_solved_at_every_evaluation(solver):
    """Ẏ = s, s = 3 − tanh(s) − y: an index-1 differential-algebraic equation, against SciPy."""
    s, lag = Sum(signs="+--", name="s"), Lag(name="lag", k=0.0)
    tanh = Function(np.tanh, name="tanh")
    wired = lag(s(Constant(value=3.0), tanh(s.y), lag.y))
    run = Diagram("dae", wired, loops="solve").simulate(
        5.0, step=0.01, solver=solver, rtol=1e-9, atol=1e-11, progress=False
    )

    def rate(t, y):
        return [brentq(lambda v: v + np.tanh(v) - 3 + y[0], -10, 10, xtol=1e-14)]

    exact = solve_ivp(rate, (0, 5), [0.0], "DOP853", t_eval=[5.0], rtol=1e-12, atol=1e-13).y[0, -1]
    assert run["lag.y"][-1] == pytest.approx(exact, abs=2e-7)
    assert np.max(np.abs(run["s.y"] + np.tanh(run["s.y"]) + run["lag.y"] - 3)) < 1e-8


def test_a_stiff_loop_has_the_exact_jacobian():
    """An implicit solver takes few steps only if ∂f/∂x goes through the loop: ẏ = −1e5 s, s = (y + s) / 2 = y."""
    s = Sum(signs="++", name="s")
    half = Gain(gain=0.5, name="half")
    fast = Lag(name="fast", k=0.0, start=1.0)
    counted = []
    watch = PythonFunction(lambda v: counted.append(1) or v, name="watch", results={"y": ()})
    wired = fast(watch(Gain(gain=-1e5, name="k")(half(s(fast.y, half.y)))))
    run = Diagram("stiff", wired, loops="solve").simulate(1.0, step=1.0, solver="Radau", progress=False)
    assert run["fast.y"][-1] == pytest.approx(0.0, abs=1e-6)
    assert len(counted) < 3000


def test_loops_at_ticks_alone_and_in_two_rates_are_solved():
    @subsystem(sample_time=0.1)
    def fast(u):
        e, k = Sum(signs="+-", name="e"), Gain(gain=3.0, name="k")
        return e(u, k(e.y))

    @subsystem(sample_time=0.2)
    def slow(u):
        e, k = Sum(signs="+-", name="e"), Gain(gain=1.0, name="k")
        return e(u, k(e.y))

    run = Diagram("d", slow(fast(Clock()).named("f")).named("s"), loops="solve").simulate(1.0, progress=False)
    assert np.allclose(run["f"], run.t / 4, rtol=0, atol=1e-15)
    assert np.allclose(run["s"], np.repeat(run.t[::2], 2)[: len(run.t)] / 8, rtol=0, atol=1e-15)


def test_a_loop_through_an_opaque_block_is_solved_with_differences():
    cos = PythonFunction(lambda v: float(np.cos(v)), name="foreign", results={"y": ()})
    e = Sum(signs="++", name="e")
    run = Diagram("loop", e(cos(e.y), Constant(value=0.0)), loops="solve").simulate(0.2, step=0.1, progress=False)
    assert run["e.y"] == pytest.approx(0.7390851332151607, abs=1e-14)


def test_an_exception_of_an_opaque_block_in_a_loop_names_it():
    def breaks(v):
        if v > 0.5:
            raise ValueError("beyond")
        return v

    foreign = PythonFunction(breaks, name="foreign", results={"y": ()})
    e = Sum(signs="+-", name="e")
    with pytest.raises(SimulationError, match=r"foreign.*ValueError: beyond") as caught:
        Diagram("loop", e(Clock(), foreign(e.y)), loops="solve").simulate(2.0, step=0.1, progress=False)
    assert isinstance(caught.value.__cause__, ValueError)
    assert caught.value.run.t[-1] == 1.0


def test_a_loop_without_a_solution_is_an_error_with_the_loop_printed():
    """Y = y² + u has none for u > 1/4; at u = 0.2 and below it has one."""
    square = Function(lambda v: v**2, name="square")
    e = Sum(signs="++", name="e")
    told = r"e\.y.*t = 0\.3 s.*the algebraic loop was not solved: its residual is .*expected at most 1e-09"
    with pytest.raises(SimulationError, match=told) as caught:
        Diagram("loop", e(Clock(), square(e.y)), loops="solve").simulate(1.0, step=0.1, progress=False)
    assert "wired to" in str(caught.value)
    assert "UnitDelay" in str(caught.value)
    assert caught.value.run.t[-1] == 0.2
    assert caught.value.run["e.y"][-1] == pytest.approx((1 - np.sqrt(1 - 0.8)) / 2, rel=1e-9)


def test_a_singular_loop_is_an_error():
    """Y = y + 1."""
    e = Sum(signs="++", name="e")
    with pytest.raises(SimulationError, match="the algebraic loop was not solved"):
        Diagram("loop", e(Constant(value=1.0), Gain(gain=1.0, name="g")(e.y)), loops="solve").simulate(
            1.0, step=0.5, progress=False
        )


def test_a_nan_in_a_loop_is_named_as_such_and_not_as_a_loop():
    root = Function(np.sqrt, name="root")
    e = Sum(signs="+-", name="e")
    wired = e(root(1.05 - Clock()), Gain(gain=0.5, name="g")(e.y))
    with pytest.raises(NonFiniteError, match=r"root\.y, t = 1\.1 s: found \[nan\]") as caught:
        Diagram("loop", wired, loops="solve").simulate(2.0, step=0.1, progress=False)
    assert caught.value.run.t[-1] == 1.0


@pytest.mark.parametrize("solver", ["rk4", "DOP853"])
def test_a_nan_in_a_loop_inside_the_rates_is_named_as_such(solver):
    root = Function(np.sqrt, name="root")
    e = Sum(signs="+-", name="e")
    wired = Lag(name="lag")(e(root(1.05 - Clock()), Gain(gain=0.5, name="g")(e.y)))
    with pytest.raises(SimulationError, match=r"t = 1\.\d+ s") as caught:
        Diagram("loop", wired, loops="solve").simulate(2.0, step=0.1, solver=solver, progress=False)
    assert "algebraic loop" not in str(caught.value)
    assert caught.value.run.t[-1] == 1.0


def test_loops_that_need_no_solving_leave_no_residual():
    run = Diagram("d", Lag(name="lag")(Constant(value=1.0)), loops="solve").simulate(1.0, progress=False)
    assert run.residual is None


def test_a_delay_breaks_a_loop():
    @subsystem(sample_time=0.1)
    def box():
        e, z = Sum(signs="+-", name="e"), UnitDelay(initial_value=0.0, name="z")
        return e(Constant(value=1.0), z(e.y))

    run = Diagram("d", box().named("e")).simulate(0.4, progress=False)
    assert run["e"].tolist() == [1, 0, 1, 0, 1]


def test_an_event_that_looks_at_a_solved_loop_is_found():
    """Y + y³ = t reaches 1 at t = 2."""
    cube = Function(lambda v: v**3, name="cube")
    e = Sum(signs="+-", name="e")
    wired = Compare(">", name="c")(e(Clock(), cube(e.y)), 1.0)
    run = Diagram("loop", wired, loops="solve").simulate(3.0, step=0.5, progress=False)
    assert [x.t for x in run.events] == pytest.approx([2.0], abs=1e-13)


def test_a_jump_reads_a_solved_loop():
    """The loop is solved anew after each jump: e = 1 + r − e/2 with the relay's r."""
    relay, lag = Relay(name="r", on_point=0.5, off_point=-10.0), Lag(name="lag", k=1.0)
    e = Sum(signs="++-", name="e")
    wired = lag(e(Constant(value=1.0), relay(lag.y), Gain(gain=0.5, name="g")(e.y)))
    run = Diagram("loop", wired, loops="solve").simulate(3.0, step=0.1, **TIGHT)
    at = -np.log(1 - 0.5 / (2 / 3))
    assert [x.t for x in run.events] == pytest.approx([at], abs=1e-11)
    exact = np.where(run.t < at, (1 - decay(run.t)) * 2 / 3, 4 / 3 + (0.5 - 4 / 3) * decay(run.t - at))
    assert np.max(np.abs(run["lag.y"] - exact)) < 1e-11
    assert np.max(np.abs(run["e.y"] - np.where(run.t < at, 2 / 3, 4 / 3))) < 1e-12


def test_the_loop_of_direct_feedthroughs_is_the_feedback_of_state_spaces():
    A, B = np.array([[-1.0, 0.5], [0.0, -2.0]]), np.array([1.0, 1.0])
    C, D = np.array([2.0, -1.0]), 0.7
    plant = StateSpace(A=A, B=B, C=C, D=D, name="plant")
    e = Sum(signs="+-", name="e")
    run = Diagram("loop", e(Constant(value=1.0), plant(e.y)), loops="solve").simulate(2.0, step=0.1, **TIGHT)
    closed = A - np.outer(B, C) / (1 + D)
    steady = np.linalg.solve(closed, -B / (1 + D))
    x = np.array([steady - expm(closed * t) @ steady for t in run.t])
    assert np.max(np.abs(run["e.y"] - (1 - x @ C) / (1 + D))) < 1e-11


@pytest.mark.parametrize("root", [3.0, -40.0, 1e3])
def test_newtons_steps_that_go_too_far_are_shortened(root):
    """Y = y − atan(y − root): from 0 the full steps of Newton's method run away, and so does the size of y."""
    turn = Function(lambda v: v - np.arctan(v - root), name="turn")
    e = Sum(signs="++", name="e")
    run = Diagram("loop", e(Constant(value=0.0), turn(e.y)), loops="solve").simulate(0.1, step=0.1, progress=False)
    assert run["e.y"] == pytest.approx([root, root], rel=1e-12)


# --- loops with more than one solution --------------------------------------------------------------------------------


def run_of(*calls):
    return Diagram("loop", *calls, loops="solve").simulate(0.2, step=0.1, progress=False)


def test_a_singular_loop_that_any_value_solves_says_so():
    g = Gain(gain=1.0, name="g")
    with pytest.raises(SimulationError, match=r"g\.y, t = 0 s: the algebraic loop does not determine g\.y: it is sing"):
        run_of(g(g.y))


def test_a_singular_loop_of_vectors_names_the_entries_that_are_free():
    """The second and the third entry swap: only their sum is determined, by nothing."""
    A = np.array([[0.5, 0, 0], [0, 0, 1.0], [0, 1.0, 0]])
    e = Sum(signs="++", name="e")
    with pytest.raises(SimulationError, match=r"does not determine (e|A)\.y\[2\], (e|A)\.y\[3\]: it is singular"):
        run_of(e(Constant(value=[1.0, 0.0, 0.0]), Gain(gain=A, name="A")(e.y)))


def test_a_loop_that_becomes_singular_says_when():
    """The values go with y = g(t) y, g = 10 t: at 0.1 s anything solves it."""
    times = Product(name="times")
    with pytest.raises(SimulationError, match=r"t = 0\.1 s: the algebraic loop does not determine times\.y"):
        run_of(times(Gain(gain=10.0)(Clock()), times.y))


def test_a_multiple_root_is_a_solution():
    """The only solution of y = y − y³ is 0, at which the derivative of the loop is singular."""
    f = Function(lambda v: v - v**3, name="f")
    assert run_of(f(f.y))["f.y"].tolist() == [0, 0, 0]


def test_linearization_refuses_an_undetermined_loop_too():
    g, lag = Gain(gain=1.0, name="g"), Lag(name="lag", k=1.0)
    diagram = Diagram("loop", g(g.y), lag(Constant(value=1.0)), loops="solve")
    with pytest.raises(SimulationError, match="does not determine"):
        diagram.linearize()


def test_of_several_solutions_the_other_ones_are_told():
    """Those of y = 2 − y² are 1 and −2."""
    f = Function(lambda v, u: u - v**2, name="f")
    run = run_of(f(f.y, Constant(value=2.0)))
    assert run["f.y"] == pytest.approx([1.0, 1.0, 1.0], abs=1e-12)
    (message,) = run.messages
    assert "several solutions at t = 0 s" in message
    assert "others are -2." in message
    assert str(message) in repr(run)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_start_from_which_newtons_method_gets_stuck_is_sought_from_other_values(compiled):
    """Of y = 3 cos 2y: from 0 the residual has a minimum of 0.02 near y = 3 that is no solution."""

    def left(y):
        return 3 * np.cos(2 * y) - y

    near, second, third = brentq(left, 0.5, 1.0), brentq(left, -1.2, -0.8), brentq(left, -2.1, -1.9)
    assert max(left(np.linspace(2.5, 3.5, 10001))) < -0.09
    f = Function(lambda v: 3 * np.cos(2 * v), name="f")
    run = Diagram("loop", f(f.y), loops="solve").simulate(0.2, step=0.1, compile=compiled, progress=False)
    assert run["f.y"] == pytest.approx([near] * 3, abs=1e-12)
    (message,) = run.messages
    for other in (second, third):
        assert f"{other:.6g}" in message


def test_a_loop_without_a_solution_is_refused_after_the_search():
    f = Function(lambda v: v + 1.0 + v**2, name="f")
    with pytest.raises(SimulationError, match="was not solved.*from a few other values, got no closer"):
        run_of(f(f.y))


def test_a_solution_that_ends_later_is_refused_where_it_ends():
    """y = y² + c has a solution up to c = 1/4 only: none is looked for elsewhere then."""
    f = Function(lambda v, c: v**2 + c, name="f")
    with pytest.raises(
        SimulationError, match=r"t = 0\.3 s: the algebraic loop was not solved.*from the last solution, got"
    ):
        Diagram("loop", f(f.y, Clock()), loops="solve").simulate(0.4, step=0.1, progress=False)


def test_three_solutions_are_told_and_a_unique_one_is_not():
    """Y = tanh(3 y) has 0 and ± y with y = 0.9949; y = −tanh(3 y) has 0 only."""
    up, down = Function(lambda v: np.tanh(3 * v), name="f"), Function(lambda v: -np.tanh(3 * v), name="f")
    other = brentq(lambda v: v - np.tanh(3 * v), 0.5, 1.5)
    (message,) = run_of(up(up.y)).messages
    assert f"{other:.6g}" in message
    assert f"{-other:.6g}" in message
    assert run_of(down(down.y)).messages == ()


def test_a_block_without_values_elsewhere_does_no_harm():
    """Other solutions are sought where a user's own code fails."""

    def root(v):
        if not -0.5 < v < 3.5:
            raise ValueError("out of range")
        return 0.25 * v + 1.5

    f = PythonFunction(root, name="f", results={"y": ()})
    run = run_of(f(f.y))
    assert run["f.y"] == pytest.approx([2.0, 2.0, 2.0], abs=1e-9)
    assert run.messages == ()
