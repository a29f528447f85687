"""Cases that a review of the engine found: what it did silently wrong, or did not end."""

import math

import numpy as np
import pytest
from scipy.special import erf

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Constant,
    DiscreteIntegrator,
    Gain,
    Input,
    Integrator,
    OptionError,
    Output,
    ShapeError,
    SimulationError,
    Step,
    Sum,
    TransferFunction,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, mass_spring_damper

pytestmark = pytest.mark.both_tiers

ONE = Constant(value=1.0, name="one")


@pytest.fixture(scope="module")
def spring():
    return mass_spring_damper.build()


# --- discontinuities that a block announces -----------------------------------------------------------------------------


class Announces(Block):
    y = Output()

    def output(self, t, x, u):
        return 1.0 + 0.0 * t


@pytest.mark.parametrize(
    ("instant", "found"),
    [
        (lambda t: t, r"next_instant\(0\.0\) is 0\.0"),
        (lambda t: t - 1.0, r"next_instant\(0\.0\) is -1\.0"),
        (lambda t: math.nan, r"next_instant\(0\.0\) is nan"),
        (lambda t: None, r"next_instant\(0\.0\) failed: TypeError"),
        (lambda t: 1.0 / t, r"next_instant\(0\.0\) failed: ZeroDivisionError"),
    ],
)
def test_an_announced_instant_that_does_not_come_later_ends_the_run(instant, found):
    """It held the run where it was for ever, or was passed over."""
    kind = type("Announces", (Announces,), {"next_instant": lambda self, t: instant(t)})
    diagram = Diagram("d", Integrator(name="i")(kind(name="source")))
    with pytest.raises(SimulationError, match=rf"^source, t = 0 s: its {found}.*xpected a time after that"):
        diagram.simulate(1.0, step=0.1, progress=False)


# --- a box that is reset, and boxes of other rates in it ----------------------------------------------------------------


def ticks(sample_time, name, **options):
    """A box that counts its own ticks in seconds, from 0."""

    @subsystem(sample_time=sample_time, name=name, **options)
    def box(u):
        return DiscreteIntegrator(name="i")(u)

    return box


@pytest.mark.parametrize(("outer", "inner", "offset"), [(2, 1, 0), (1, 2, 0), (2, 2, 1), (3, 2, 1), (2, 6, 0)])
def test_a_box_that_is_reset_resets_what_has_another_rate_in_it(outer, inner, offset):
    """Only what acted at the very tick at which the box was enabled again was reset."""
    last, first = 8.5, 12.5  # disabled between these

    @subsystem(sample_time=outer, enabled="reset")
    def box(u):
        return DiscreteIntegrator(name="own")(u), ticks(inner, "inner", offset=offset)(u)

    enable = Step(times=(last, first), values=(0.0, 1.0), initial_value=1.0)
    own, other = box(ONE, enable=enable)
    run = Diagram("d", own.named("own"), other.named("other")).simulate(30, step=1, progress=False)

    def opened(k):
        """Whether the box is enabled at tick k: it looks at its own ticks."""
        k -= k % outer
        return not last < k < first

    again = next(k for k in range(13, 31) if k % outer == 0)
    for name, every, start in (("own", outer, 0), ("other", inner, offset)):
        held, state, expected = 0.0, 0.0, []
        for k in range(31):
            if k == again:
                state = 0.0
            if k >= start and (k - start) % every == 0 and opened(k):
                held, state = state, state + every
            expected.append(held)
        assert run[name].tolist() == expected


def test_states_in_a_closed_box_stay_though_a_box_inside_of_it_is_told_to_reset():
    @subsystem(enabled="reset")
    def inner(u):
        return DiscreteIntegrator(name="i")(u)

    @subsystem(sample_time=1, enabled="held")
    def outer(u, v):
        return inner(u, enable=v)

    on = Step(times=(3.5, 9.5), values=(0.0, 1.0), initial_value=1.0, name="on")
    inside = Step(times=(2.5, 5.5), values=(0.0, 1.0), initial_value=1.0, name="inside")
    diagram = Diagram("d", outer(ONE, inside, enable=on).named("y"))
    run = diagram.simulate(12, progress=False)
    assert run["y"].tolist() == [0, 1, 2, 2, 2, 2, 2, 2, 2, 2, 0, 1, 2]
    state = run.data[:, run.layout.total + diagram.flatten().states.slices["outer.inner.i"].start]
    assert state.tolist() == [0, 1, 2, 3, 3, 3, 3, 3, 3, 3, 3, 1, 2]


# --- boxes ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("sampled", {"sample_time": 0.5}),
        ("delayed", {"sample_time": 0.25, "delay": 1}),
        ("enabled", {"enabled": "held"}),
        ("triggered", {"triggered": "rising"}),
    ],
)
def test_a_signal_that_a_box_hands_on_as_it_is_is_refused_where_the_box_would_change_it(kind, options):
    """It went through unsampled, not delayed, and not held."""

    @subsystem
    def inner(u):
        return Gain(gain=2.0, name="g")(u), u

    @subsystem(name="box", **options)
    def box(u):
        doubled, same = inner(u)
        return {"doubled": doubled, "same": same}

    control = {"enabled": {"enable": ONE}, "triggered": {"trigger": ONE}}.get(kind, {})
    call = box(Clock(), **control)
    with pytest.raises(
        WiringError, match=rf"^uses\.u: found box\.same, a signal from outside that the {kind} subsystem only passes"
    ):
        Diagram("d", Integrator(name="i")(call.doubled), Gain(gain=1.0, name="uses")(call.same))
    Diagram("d", Integrator(name="i")(box(Clock(), **control).doubled))  # nothing uses it


def test_a_box_that_only_groups_may_hand_on_a_signal_until_it_is_given_a_rate():
    @subsystem
    def box(u):
        return u

    diagram = Diagram("d", Integrator(name="i")(box(ONE)))
    assert diagram.simulate(1.0, step=0.5, progress=False)["i.y"].tolist() == pytest.approx([0.0, 0.5, 1.0])
    assert diagram.sampled(0.5).simulate(1.0, progress=False)["i.y"].tolist() == [0.0, 0.5, 1.0]
    with pytest.raises(
        WiringError, match=r"^i\.u: found box\.u, a signal from outside that the sampled subsystem only passes"
    ):
        diagram.replace({"box.sample_time": 0.5})


def test_a_signal_that_a_box_hands_on_may_go_to_what_has_the_same_rate():
    @subsystem(sample_time=0.5)
    def sensors(u):
        return u

    run = Diagram("d", ticks(0.5, "box")(sensors(Clock())).named("y")).simulate(2.0, progress=False)
    assert run["y"].tolist() == [0.0, 0.0, 0.25, 0.75, 1.5]


def test_a_box_that_only_groups_is_discretized_by_the_method_of_the_box_around_it():
    """It was discretized exactly, whatever the box said that it stood in."""

    def step_response(outer, nested, **options):
        @subsystem(**options)
        def group(u):
            return TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")(u)

        @subsystem(sample_time=0.5, method=outer)
        def box(u):
            return group(u) if nested else TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")(u)

        return Diagram("d", box(ONE).named("y"))

    def response(diagram):
        return diagram.simulate(2.0, progress=False)["y"]

    for method, pole in (("exact", math.exp(-0.5)), ("forward", 0.5), ("trapezoidal", 0.75 / 1.25)):
        expected = 1.0 - pole ** np.arange(5)
        for nested in (False, True):
            assert response(step_response(method, nested)) == pytest.approx(expected, abs=1e-14)
        assert response(step_response("exact", True, method=method)) == pytest.approx(expected, abs=1e-14)
        changed = step_response("exact", True).replace({"box.method": method})
        assert response(changed) == pytest.approx(expected, abs=1e-14)
        whole = step_response("exact", True).continuous().sampled(0.5, method=method)
        assert response(whole) == pytest.approx(expected, abs=1e-14)


# --- what is recorded ---------------------------------------------------------------------------------------------------


def test_a_state_is_recorded_as_its_tick_found_it_also_where_an_event_fires_at_that_tick():
    """At such a tick the state that the next one would find was recorded."""

    def run(*more):
        diagram = Diagram("d", ticks(0.5, "box")(ONE).named("y"), *more)
        result = diagram.simulate(2.0, progress=False)
        return result.data[:, result.layout.total + diagram.flatten().states.slices["box.i"].start], result

    plain, _ = run(Integrator(name="other")(ONE))
    with_event, result = run(Compare(">", name="jumps")(Step(times=1.0, values=1.0), 0.5))
    assert [e.t for e in result.events] == [1.0]
    assert plain.tolist() == with_event.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]


# --- stop conditions ----------------------------------------------------------------------------------------------------


def test_what_ends_a_run_is_one_number_that_the_block_puts_out():
    """A name that is none was a KeyError when the run began; of a vector only the first entry was looked at."""

    class Wide(Block):
        stops = "reached"
        reached = Output(shape=(2,))

        def output(self, t, x, u):
            return np.stack([0.0 * t, 1.0 + 0.0 * t])

    class Misspelt(Announces):
        stops = "x"

    with pytest.raises(ShapeError, match=r"^stop\.reached: found shape \(2,\); expected one number"):
        Diagram("d", Wide(name="stop"))
    with pytest.raises(UnknownNameError, match=r"^stop: found stops = 'x'; expected the name of an output.*y"):
        Diagram("d", Misspelt(name="stop"))


# --- algebraic loops ------------------------------------------------------------------------------------------------------


class Cubic(Block):
    """y³ − y = v, as a loop through u: three solutions for |v| < 0.385, one beyond."""

    u = Input()
    v = Input()
    y = Output()

    def output(self, t, x, u):
        return u.u - (u.u**3 - u.u - u.v)


class Burst(Block):
    y = Output()

    def output(self, t, x, u):
        return 100.0 * np.exp(-(((t - 1.03) / 1e-3) ** 2))


@pytest.mark.parametrize(("solver", "max_step"), [("RK45", 0.1), ("RK45", 0.05), ("DOP853", 0.05), ("DOP853", 0.03)])
def test_a_trial_of_a_solver_neither_ends_a_run_with_a_loop_nor_leads_it_to_another_solution(solver, max_step):
    """A step that is too long tries states at which the loop has no solution near by; it is to be shortened."""
    loop = Cubic(name="c")
    x = Integrator(name="x")(Burst(name="burst"))
    diagram = Diagram("d", loop(u=loop.y, v=x), Integrator(name="z")(loop.y), loops="solve")
    options = {"rtol": 1e-8, "atol": 1e-10, "max_step": max_step}
    run = diagram.simulate(2.0, step=0.1, solver=solver, progress=False, **options)
    end = 0.1 * math.sqrt(math.pi)

    def solution(v):
        return 2 / math.sqrt(3) * np.cos((np.arccos(1.5 * math.sqrt(3) * v) + 4 * np.pi) / 3)

    assert run["x.y"][-1] == pytest.approx(end, abs=1e-8)
    assert run["c.y"] == pytest.approx(solution(run["x.y"]), abs=1e-9)
    t = np.linspace(1.02, 1.04, 200001)
    z = np.trapezoid(solution(0.5 * end * (1 + erf((t - 1.03) / 1e-3))), t) + 0.96 * solution(end)
    assert run["z.y"][-1] == pytest.approx(z, abs=2e-8)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", ["rk4", "RK45", "Radau", "BDF", "LSODA", "CVODE_BDF"])
def test_a_loop_whose_solution_ends_is_told_as_such(solver):
    loop = Cubic(name="c")
    x = Integrator(name="x")(ONE)
    diagram = Diagram("d", loop(u=loop.y, v=x), Integrator(name="z")(loop.y), loops="solve")
    with pytest.raises(
        SimulationError, match=r"(?s)the algebraic loop was not solved.*c\.y is wired to c\.u"
    ) as caught:
        diagram.simulate(1.0, step=0.01, solver=solver, progress=False)
    assert caught.value.block == "c"
    assert caught.value.t == pytest.approx(2 / math.sqrt(27), abs=0.02)


# --- a run in the making ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["blocks", "with an FMU"])
def test_a_run_that_has_not_begun_or_has_ended_is_not_gone_on_with(spring, kind):
    """It ran without its start and without its FMUs."""
    root = Integrator(name="i", initial_value=3.0)(ONE) if kind == "blocks" else Fmu(spring, name="m")(force=0.0)
    simulation = Diagram("d", root).simulation(step=0.1)
    for use in (lambda: simulation.advance(0.1), simulation.save):
        with pytest.raises(OptionError, match=r"^d: this run has not begun; expected it to be used inside"):
            use()
    with simulation:
        simulation.advance(0.2)
        state = simulation.save()
    for use in (lambda: simulation.advance(0.1), lambda: simulation.restore(state), simulation.__enter__):
        with pytest.raises(OptionError, match=r"^d: this run has ended, and its FMUs are freed; expected it"):
            use()
    run = simulation.run()
    assert run.t.tolist() == [0.0, 0.1, 0.2]
    assert (run.final_state is None) == (kind == "with an FMU")
    assert np.all(np.isfinite(run.data))


def test_a_loop_in_a_subsystem_that_acts_later_holds_its_solution_from_the_start():
    """e = 3 − e/2: until the first tick of the subsystem the integrator sees 2, too."""
    error = Sum(signs="+-", name="error")

    @subsystem(sample_time=0.1, offset=0.05)
    def box(u):
        return error(u, Gain(gain=0.5)(error.y)).named("e")

    made = Diagram("d", Integrator(name="i")(box(Constant(value=3.0))), loops="solve")
    run = made.simulate(0.3, step=0.05, progress=False)
    assert run["e"] == pytest.approx(np.full(7, 2.0), abs=1e-14)
    assert run["i.y"] == pytest.approx(2.0 * run.t, abs=1e-14)
