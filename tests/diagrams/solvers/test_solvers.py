"""Solvers: order, tolerance, stiffness, samples within steps, landing on jumps, and failures that say where.

All of them by runs of diagrams; what SciPy's and SUNDIALS' methods alone have, by `make_solver`.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Clock,
    Event,
    Input,
    Integrator,
    OptionError,
    PythonFunction,
    SimulationError,
    State,
    Step,
)
from loopwright.diagrams import Diagram, NonFiniteError, subsystem
from loopwright.diagrams.solvers import cvode as _solvers_sundials
from loopwright.diagrams.solvers.base import SOLVERS, Problem
from loopwright.diagrams.solvers.choose import make_solver
from support.hybrid_blocks import Crossings
from support.work_in_c import simulate_counted

FIXED = {"euler": 1, "heun": 2, "rk3": 3, "rk4": 4}
VARIABLE = [name for name in SOLVERS if name not in FIXED]
STIFF = ["auto", "Radau", "BDF", "LSODA", "CVODE_BDF"]
ONE_STEP = {"RK23": 3, "RK45": 4, "DOP853": 7, "Radau": 3}  # order of the dense output
QUIET = {"progress": False}


def system(rate, start):
    """Return the diagram of a block with states x and the rates ``rate(t, x)``."""

    class System(Block):
        x = State(start=list(start), output=True)

        def derivative(self, t, x, u):
            return np.stack(rate(t, x.x))

    return Diagram("d", System(name="block"))


def end(solver, diagram, stop, **options):
    """Return the states at the end of a run; of variable step, one of one tick."""
    return diagram.simulate(stop, **{"step": stop, "solver": solver, **QUIET, **options})["block.x"][-1]


def random_linear(size, seed):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(size, size))
    a -= (np.linalg.eigvals(a).real.max() + 0.2) * np.eye(size)
    return a, rng.normal(size=size)


def slope(x, y):
    return np.polyfit(np.log(x), np.log(y), 1)[0]


def swing(t, x):
    """The rates of a pendulum that is damped and pushed."""
    return [x[1], -np.sin(x[0]) - 0.1 * x[1] + 0.5 * np.cos(2 * t)]


START = np.array([1.0, 0.5])
PENDULUM = system(swing, START)


@pytest.fixture(scope="module")
def pendulum():
    options = {"rtol": 1e-13, "atol": 1e-14, "max_step": 0.05, "dense_output": True}
    return solve_ivp(swing, (0, 5), START, method="DOP853", **options).sol


MU = 1000.0


def relax(t, x):
    """The rates of van der Pol's oscillator."""
    return [x[1], MU * (1 - x[0] ** 2) * x[1] - x[0]]


VAN_DER_POL = system(relax, [2.0, 0.0])


# its state at t = 2000, two jumps later: SciPy's Radau with rtol=1e-12, atol=1e-15; with 1e-11 the first 13 digits agree
VAN_DER_POL_AT_2000 = np.array([1.7061677321704027, -0.0008928097010248833])


@pytest.mark.slow
def test_the_recorded_state_of_the_van_der_pol_oscillator_is_what_scipy_says():
    done = solve_ivp(
        relax,
        (0, 2000),
        [2.0, 0.0],
        method="Radau",
        jac=lambda t, x: np.array([[0, 1], [-2 * MU * x[0] * x[1] - 1, MU * (1 - x[0] ** 2)]]),
        rtol=1e-12,
        atol=1e-15,
    )
    assert done.y[:, -1] == pytest.approx(VAN_DER_POL_AT_2000, rel=1e-12)


# --- order and tolerance -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FIXED)
def test_a_fixed_step_method_has_its_order_on_a_linear_system(name):
    a, x = random_linear(5, seed=1)
    steps = np.array([1 / 40, 1 / 80, 1 / 160, 1 / 320])
    diagram = system(lambda t, x: [sum(a[i, j] * x[j] for j in range(5)) for i in range(5)], x)
    errors = [np.abs(end(name, diagram, 2.0, step=h) - expm(2 * a) @ x).max() for h in steps]
    assert slope(steps, errors) == pytest.approx(FIXED[name], abs=0.2)


@pytest.mark.parametrize("name", FIXED)
def test_a_fixed_step_method_has_its_order_on_a_nonlinear_system(name, pendulum):
    steps = np.array([1 / 40, 1 / 80, 1 / 160, 1 / 320])
    errors = [np.abs(end(name, PENDULUM, 5.0, step=h) - pendulum(5.0)).max() for h in steps]
    assert slope(steps, errors) == pytest.approx(FIXED[name], abs=0.2)


@pytest.mark.parametrize(("name", "degree"), [*FIXED.items(), ("RK23", 3), ("RK45", 5), ("DOP853", 8), ("Radau", 5)])
def test_polynomials_of_the_methods_degree_are_exact(name, degree):
    # the error estimate of a pair doesn't vanish with the error: a loose tolerance lets steps be large
    options = {"step": 0.5 if name in FIXED else 2.0, "max_step": 0.5, "rtol": 0.1, "atol": 1e3}
    x = end(name, system(lambda t, x: [degree * t ** (degree - 1)], [0.0]), 2.0, **options)
    assert x[0] == pytest.approx(2.0**degree, rel=1e-13)
    beyond = end(name, system(lambda t, x: [(degree + 1) * t**degree], [0.0]), 2.0, **options)
    assert beyond[0] != pytest.approx(2.0 ** (degree + 1), rel=1e-9)


@pytest.mark.drawn(4)
@pytest.mark.parametrize("name", VARIABLE)
def test_the_global_error_scales_with_the_tolerance(name, pendulum):
    tolerances = 10.0 ** -np.arange(4, 11)
    errors = [np.abs(end(name, PENDULUM, 5.0, rtol=r, atol=r) - pendulum(5.0)).max() for r in tolerances]
    assert (errors < 300 * tolerances).all(), errors / tolerances
    # proportional: 1; the default takes DOP853 below 1e-8, which is more accurate than asked
    assert 0.7 < slope(tolerances, errors) < (1.5 if name == "auto" else 1.3), errors


@pytest.mark.parametrize("name", VARIABLE)
def test_a_step_is_at_most_max_step(name):
    slow = system(lambda t, x: [-0.01 * x[0]], [1.0])
    free, bound = (simulate_counted(slow, 3.0, step=3.0, solver=name, max_step=h)[1] for h in (None, 0.1))
    assert free.steps < 15
    assert 30 <= bound.steps < 40


@pytest.mark.parametrize("name", VARIABLE)
@pytest.mark.drawn(4)
def test_each_state_has_its_own_absolute_tolerance(name):
    """An oscillator in nanometres, once with nominal values that say so, and once with those of megametres."""

    def simulated(nominal):
        class Oscillator(Block):
            x = State(start=0.0, output=True, nominal=nominal)
            v = State(start=1e-9, output=True, nominal=nominal)

            def derivative(self, t, x, u):
                return x.v, -x.x

        return simulate_counted(Diagram("d", Oscillator(name="o")), 10.0, step=10.0, solver=name)

    (run, fine), (_, coarse) = simulated(1e-9), simulated(1e6)
    assert run["o.x"][-1] == pytest.approx(1e-9 * math.sin(10), abs=1e-13)
    assert run["o.v"][-1] == pytest.approx(1e-9 * math.cos(10), abs=1e-13)
    assert coarse.steps < fine.steps / 2


# --- samples and events within a step ----------------------------------------------------------------------------------


class WatchedPendulum(Block):
    """The pendulum, looked at 3.3 times a second, within steps."""

    x = State(start=START.tolist(), output=True)
    look = Event("rising")

    def derivative(self, t, x, u):
        return np.stack(swing(t, x.x))

    def indicators(self, t, x, u):
        return np.sin(2 * np.pi * 3.3 * t - 1.0)

    def jump(self, t, x, u, fired):
        return x.x


@pytest.mark.parametrize("name", FIXED)
def test_interpolation_inside_a_fixed_step_has_the_methods_own_order(name, pendulum):
    steps, errors = np.array([1 / 20, 1 / 40, 1 / 80, 1 / 160]), []
    for h in steps:
        run = Diagram("d", WatchedPendulum(name="block")).simulate(2.0, step=h, solver=name, **QUIET)
        assert [e.t for e in run.events] == pytest.approx((np.arange(7) + 0.5 / np.pi) / 3.3, abs=1e-12)
        errors.append(max(np.abs(e.before["x"] - pendulum(e.t)).max() for e in run.events))
    assert slope(steps, errors) == pytest.approx(FIXED[name], abs=0.2)


@pytest.mark.parametrize(("name", "order"), ONE_STEP.items())
def test_the_dense_output_of_a_one_step_method_has_its_order(name, order, pendulum):
    steps, errors = np.array([0.4, 0.3, 0.2, 0.15] if name == "DOP853" else [0.4, 0.2, 0.1, 0.05]), []
    for h in steps:  # one step, of a size that the tolerance does not hold back
        run, work = simulate_counted(PENDULUM, h, step=h / 20, solver=name, rtol=0.5, atol=1e3)
        assert work.steps == 1
        errors.append(np.abs(run["block.x"] - pendulum(run.t).T)[2:-2].max())
    assert slope(steps, errors) > order + 1 - 0.35  # local: one more than the order


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIABLE)
def test_the_dense_output_is_as_good_as_the_steps(name, pendulum):
    for rtol in (1e-5, 1e-8):
        run, work = simulate_counted(PENDULUM, 5.0, step=0.002, solver=name, rtol=rtol, atol=rtol)
        assert work.steps < len(run.t) / 2
        # the cubic of Radau is of lower order than its steps
        assert np.abs(run["block.x"] - pendulum(run.t).T).max() < (3e4 if name == "Radau" else 300) * rtol


# --- stiffness ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.drawn(2)
@pytest.mark.parametrize("name", STIFF)
def test_a_stiff_van_der_pol_oscillator_is_followed_through_its_jumps(name):
    run, work = simulate_counted(VAN_DER_POL, 2000.0, step=2000.0, solver=name, rtol=1e-8, atol=1e-11)
    assert np.abs(run["block.x"][-1] / VAN_DER_POL_AT_2000 - 1).max() < 1e-6
    assert work.rates < 40_000  # an explicit method takes 8 million
    assert work.slopes > 0


def test_the_default_says_when_it_changed_between_stiff_and_not():
    there, back, *_ = VAN_DER_POL.simulate(1000.0, step=1000.0, **QUIET).messages
    assert "stiff at steps of" in there
    assert there.endswith("RK45 → Radau")
    assert "t = 807" in back  # the jump of the oscillator
    assert back.endswith("Radau → RK45")


@pytest.mark.parametrize(("rtol", "rates"), [(1e-6, 6), (1e-9, 12)])
def test_the_default_stays_explicit_where_the_problem_is_not_stiff(rtol, rates):
    """By RK45 with six rates a step, by DOP853 with twelve below 1e-8."""
    run, work = simulate_counted(PENDULUM, 50.0, step=50.0, rtol=rtol, atol=rtol)
    assert run.messages == ()
    assert work.rates == 2 + rates * (work.steps + work.rejected)


@pytest.mark.slow
def test_the_default_does_not_take_a_fast_oscillation_for_stiff():
    fast = system(lambda t, x: [300 * x[1], -300 * x[0] - 0.01 * x[1]], [1.0, 0.0])
    run, work = simulate_counted(fast, 3.0, step=3.0)
    assert run.messages == ()
    assert work.slopes < 50


def test_the_default_finds_stiffness_between_short_restarts():
    @subsystem(sample_time=0.01)
    def clocked(t):
        return 0.0 * t

    class Lags(Block):
        u = Input()
        x = State(start=[1.0, 0.0], output=True)

        def derivative(self, t, x, u):
            return np.stack([-x.x[0], 1e5 * (1.0 + u.u - x.x[1])])

    run, work = simulate_counted(Diagram("d", Lags(name="block")(clocked(Clock()))), 1.0)
    assert run["block.x"][-1] == pytest.approx([math.exp(-1), 1.0], rel=1e-5)
    assert 100 <= work.steps < 600  # RK45 alone: 40,000


# --- jumps of sources --------------------------------------------------------------------------------------------------


def jumps():
    """Return instants: first pairs t and s with t + (s − t) just beyond s, then some an ulp to a nanosecond apart."""
    times, draw = [1e-9], np.random.default_rng(3)
    while times[-1] < 0.01:
        t = times[-1] * draw.uniform(1.5, 3.0)
        s = t * draw.uniform(3.0, 6.0)
        if t + (s - t) > s:
            times += [t, s]
    return [*times, 0.2, math.nextafter(0.2, 1), 0.2 + 1e-15, 0.2 + 1e-12, 0.2 + 1e-9, *(k / 7 for k in range(2, 14))]


@pytest.mark.one_tier
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.drawn(6)
def test_a_solver_lands_on_jumps_and_never_looks_beyond(name):
    """x' = −x and x' = 0 in turns; rounding in t + (s − t) does not carry a stage beyond s, either."""
    times, seen = jumps(), []

    def rate(count, x):
        seen.append(count)
        return -x if count % 2 else 0.0

    count = Step(times=times, values=np.arange(1.0, len(times) + 1), name="count")
    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(PythonFunction(rate, results={"y": ()}, name="rate")(count, x.y)))
    run = made.simulate(2.0, step=0.03125, solver=name, rtol=1e-6, **QUIET)
    assert np.all(np.diff(seen) >= 0)
    assert {*range(len(times) + 1)} - {*seen} == {times.index(0.2) + 1}  # an ulp is no time
    decays = sum(b - a for a, b in zip(times[::2], [*times, 2.0][1::2], strict=False))
    assert run["x.y"][-1] == pytest.approx(math.exp(-decays), rel={"euler": 0.05, "heun": 2e-3}.get(name, 2e-4))


@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", SOLVERS)
def test_a_jump_is_met_with_a_step_that_shrinks(name):
    """At rest, steps grow without bound; then the input jumps."""

    class Fast(Block):
        u = Input()
        x = State(output=True)

        def derivative(self, t, x, u):
            return 50 * (u.u - x.x)

    at = 1.0 if name in FIXED else 100.0
    made = Diagram("d", Fast(name="block")(Step(times=at, values=1.0)))
    run = made.simulate(at + 0.03, step=1e-3 if name in FIXED else 0.01, solver=name, **QUIET)
    assert run["block.x"][run.t <= at] == pytest.approx(0.0, abs=1e-9)
    expected = 1 - math.exp(-50 * 0.03)  # at h λ = −1 the estimate of RK23 is 0
    assert run["block.x"][-1] == pytest.approx(expected, abs={"euler": 2e-2, "heun": 1e-3}.get(name, 1e-4))


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.drawn(4)
def test_a_diagram_without_states_is_stepped_to_its_ticks(name):
    made = Diagram("d", Crossings(name="c")(Clock() - 0.7123456789))
    run, _ = simulate_counted(made, 1.0, step=0.25, solver=name)
    assert run.t.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert [e.t for e in run.events] == pytest.approx([0.7123456789], abs=2e-16)
    if name not in FIXED:
        steps = [simulate_counted(made, 0.5, step=0.5, solver=name, max_step=h)[1].steps for h in (None, 0.125)]
        assert steps == [1, 4]


# --- the domain of the rates -------------------------------------------------------------------------------------------


def tank(level):
    """Return a tank that runs empty at t = 2 √level."""
    return system(lambda t, x: [-np.sqrt(x[0])], [level])


@pytest.mark.parametrize("name", VARIABLE)
def test_a_trial_beyond_the_domain_of_the_rates_shortens_the_step(name):
    run = tank(1.0).simulate(1.95, step=0.975, solver=name, **QUIET)
    exact = (1 - run.t / 2) ** 2
    assert run["block.x"][:, 0] == pytest.approx(exact, rel=1e-2 if name in {"BDF", "LSODA"} else 2e-3)


@pytest.mark.parametrize("name", VARIABLE)
def test_a_first_step_may_be_tried_beyond_the_domain_of_the_rates(name):
    x = end(name, tank(1e-14), 1.9e-7)  # Euler's step to there is below zero; empty at 2e-7
    assert 0 <= x[0] < 1e-14


@pytest.mark.parametrize("name", sorted({*VARIABLE} - {"LSODA", "CVODE_Adams"}))
def test_a_decay_towards_the_border_of_the_domain_goes_on(name):
    # LSODA never gets there; Adams puts an accepted point beyond, which is an error that names the state
    options = {"step": 30.0, "solver": name, "atol": 1e-3}
    _, free = simulate_counted(system(lambda t, x: [-x[0]], [1.0]), 30.0, **options)
    run, work = simulate_counted(system(lambda t, x: [1e-300 * np.sqrt(x[0]) - x[0]], [1.0]), 30.0, **options)
    assert abs(run["block.x"][-1, 0]) < 1e-3
    assert work != free  # it was tried beyond


# --- failures ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVERS)
def test_a_rate_that_is_not_finite_behind_a_jump_is_named(name):
    class Root(Block):
        u = Input()
        x = State(start=[0.0, 1.0], output=True)

        def derivative(self, t, x, u):
            return np.stack([1.0 + 0.0 * x.x[0], np.sqrt(u.u)])

    made = Diagram("d", Root(name="block")(Step(times=3.0, values=-1.0, initial_value=1.0)))
    with pytest.raises(
        NonFiniteError, match=r"^block, t = 3 s: The rate of block\.x\[2\] is nan with solver="
    ) as caught:
        made.simulate(4.0, step=0.1, solver=name, **QUIET)
    assert caught.value.state == "block.x[2]"


@pytest.mark.parametrize("name", VARIABLE)
@pytest.mark.drawn(3)
def test_growth_to_infinity_ends_in_an_error_that_names_the_state(name):
    with pytest.raises(SimulationError, match=r"^block, [^:]*: block\.x\[2\] grows without limit") as caught:
        end(name, system(lambda t, x: [1.0, x[1] ** 2], [0.0, 1.0]), 3.0)  # infinite at t = 1
    assert caught.value.t == pytest.approx(1.0, abs=1e-3)
    assert caught.value.state == "block.x[2]"


@pytest.mark.parametrize("name", FIXED)
def test_an_unstable_fixed_step_ends_in_an_error_that_names_the_state(name):
    with pytest.raises(NonFiniteError, match=r"^block, .*(state|rate) of block\.x\[2\].*a step too long"):
        end(name, system(lambda t, x: [0.0, -1e6 * x[1]], [0.0, 1.0]), 30.0, step=0.1)


@pytest.mark.slow
@pytest.mark.drawn(2)
@pytest.mark.parametrize("name", VARIABLE)
def test_a_jump_that_is_no_event_ends_in_an_error_not_in_a_hang(name):
    with pytest.raises(
        SimulationError, match=r"^block, .*(can't meet rtol|got no further than).*block\.x\[1\].*no event"
    ) as caught:
        end(name, system(lambda t, x: [-np.sign(x[0])], [0.5]), 10.0)
    assert caught.value.t == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.drawn(2)
def test_an_error_in_the_rates_passes_through(name):
    def rate(x):
        if x < 0.4:
            raise SimulationError("the pump is dry", block="pump")
        return -x

    x = Integrator(name="x", initial_value=1.0)
    made = Diagram("d", x(PythonFunction(rate, results={"y": ()}, name="rate")(x.y)))
    with pytest.raises(SimulationError, match="^pump, .*the pump is dry") as caught:
        made.simulate(3.0, step=0.1, solver=name, **QUIET)
    assert caught.value.t == pytest.approx(math.log(2.5), abs=0.1 if name in FIXED else 1e-4)
    assert caught.value.run.t[-1] == pytest.approx(0.8 if name == "euler" else 0.9)


# --- counts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "rates"), FIXED.items())
def test_steps_and_rates_of_a_fixed_step_are_counted(name, rates):
    _, work = simulate_counted(system(lambda t, x: [-x[0]], [1.0]), 2.5, step=0.05, solver=name)
    assert work == (50, 0, 50 * rates, 0)


@pytest.mark.parametrize(("name", "rates"), [("RK23", 3), ("RK45", 6), ("DOP853", 12)])
def test_rejected_steps_are_counted(name, rates):
    kick = system(lambda t, x: [1e4 * np.exp(-(((t - 1) / 1e-3) ** 2))], [0.0])
    _, work = simulate_counted(kick, 2.0, step=2.0, solver=name, max_step=0.01)
    assert 1 <= work.rejected < work.steps
    assert work.rates == 2 + rates * (work.steps + work.rejected)  # the first step takes two


# --- options -----------------------------------------------------------------------------------------------------------


def test_names_ignore_capitals_and_an_unknown_one_is_answered_with_near_ones():
    for name, same in (("rk45", "RK45"), ("CVODE", "CVODE_BDF")):
        assert end(name, PENDULUM, 1.0).tolist() == end(same, PENDULUM, 1.0).tolist()
    with pytest.raises(OptionError, match=r"no solver 'rk54'; expected one of auto, .* Did you mean .*'RK45'"):
        end("rk54", PENDULUM, 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_step": -1.0}, "max_step is -1.0; expected a positive"),
        ({"rtol": 0.0}, "rtol is 0.0; expected 3e-14"),
        ({"rtol": math.nan}, "rtol is nan"),
        ({"atol": -1.0}, "atol is -1.0"),
        ({"atol": np.ones(3)}, r"array of shape \(2,\)"),
    ],
)
@pytest.mark.parametrize("name", ["auto", "Radau", "BDF"])
def test_options_out_of_range_are_refused(name, options, message):
    with pytest.raises(OptionError, match=message):
        end(name, PENDULUM, 1.0, **options)


# --- the methods of SciPy and SUNDIALS behind their interface ----------------------------------------------------------


def problem(rate, jacobian, size):
    buffer = np.empty(size)

    def into_buffer(t, x):  # as a traced function does: the same array at each call
        assert x.shape == (size,)
        buffer[:] = rate(t, x)
        return buffer

    return Problem(size, into_buffer, jacobian, [f"block.x[{i}]" for i in range(size)])


def go(solver, x, stops):
    """Go to each stop; return the number of steps."""
    t, x, count = 0.0, np.array(x, dtype=float), 0
    for stop in stops:
        solver.restart(t, x, stop)
        while t < stop:
            step = solver.step()
            assert step.t_old == t
            t, x, count = step.t, step.x, count + 1
        assert t == stop
    return count


@pytest.mark.parametrize("name", ["LSODA", "CVODE_BDF"])
def test_solvers_of_two_runs_do_not_disturb_each_other(name):
    (a, x), (b, y) = random_linear(3, seed=5), random_linear(4, seed=6)
    first, second = (problem(lambda t, x, m=m: m @ x, lambda t, x, m=m: m, len(m)) for m in (a, b))
    one, two = make_solver(name, first, rtol=1e-9), make_solver(name, second, rtol=1e-9)
    one.restart(0.0, x, 1.0)
    two.restart(0.0, y, 1.0)
    s = t = None
    while s is None or s.t < 1.0 or t.t < 1.0:
        s = one.step() if s is None or s.t < 1.0 else s
        t = two.step() if t is None or t.t < 1.0 else t
    assert s.x == pytest.approx(expm(a) @ x, abs=1e-7)
    assert t.x == pytest.approx(expm(b) @ y, abs=1e-7)


def test_without_sundials_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(_solvers_sundials._FUNCTIONS, "sundials_of_another_version", {"f": (None,)})
    monkeypatch.setattr(_solvers_sundials, "_load_library", _solvers_sundials._load_library.__wrapped__)
    with pytest.raises(OptionError, match=r"SUNDIALS can't be loaded: .*pip install -U fmpy, or take solver='BDF'"):
        end("cvode", PENDULUM, 1.0)


@pytest.mark.slow
def test_cvode_frees_its_memory():
    resource = pytest.importorskip("resource")
    of = problem(lambda t, x: -x, lambda t, x: -np.eye(200), 200)

    def many():
        for _ in range(150):
            go(make_solver("cvode", of), np.ones(200), [0.01])
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    many()
    before = many()
    assert many() - before < 20_000  # kB; each leaves 640 kB of matrices behind if it isn't freed: 100 MB
