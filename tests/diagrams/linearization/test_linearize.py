"""Linear models away from the easy cases: motion, cuts, loops, memory, names, notes and errors."""

import pickle
import re
from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    DiscreteStateSpace,
    Ellipse,
    Encoder,
    Function,
    Gain,
    Integrator,
    OptionError,
    PathProjection,
    PythonFunction,
    Quantizer,
    Relay,
    Sine,
    StateSpace,
    Step,
    StopCondition,
    Sum,
    TransportDelay,
    UnitDelay,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import Diagram, NonFiniteError, subsystem
from loopwright.diagrams.linearization.left_out_effects import EventWithinPeriod, StepsOnly, UnusualStart
from loopwright.fmus.fmu_block.derivation import Derivation, DerivativeMethod
from loopwright.types import Linearization, OperatingPoint
from support.linear import by_simulation, differences

T = 0.05


def close(got, want, bound):
    assert np.shape(got) == np.shape(want)
    assert np.max(np.abs(got - want), initial=0.0) <= bound * max(np.max(np.abs(want), initial=0.0), 1e-3)


# --- motion --------------------------------------------------------------------------------------------------------------


def pendulum():
    """A pendulum on a sampled, saturating controller, and what moves it: φ̈ = −9.81 sin φ − 0.3 φ̇ + u."""
    rate = Integrator(initial_value=0.4, name="rate")
    angle = Integrator(initial_value=1.1, name="angle")

    @subsystem(sample_time=T)
    def controller(angle, rate):
        past = UnitDelay(initial_value=0.2, name="past")
        push = Function(lambda a, b, c: 3 * np.tanh(-2 * a - b + 0.5 * c), name="push")(angle, rate, past.y)
        past(push)
        return push

    force = controller(angle.y, rate.y).named("force")
    pull = Function(lambda a, v, u: -9.81 * np.sin(a) - 0.3 * v + u, name="pull")(angle.y, rate.y, force)
    return Diagram("pendulum", angle(rate(pull).named("velocity")).named("swing"))


def pendulum_by_hand(x):
    """One period of `pendulum` from just before a tick: past, angle, rate."""
    past, angle, rate = x
    u = 3 * np.tanh(-2 * angle - rate + 0.5 * past)
    f = lambda t, s: [s[1], -9.81 * np.sin(s[0]) - 0.3 * s[1] + u]  # noqa: E731
    return np.array([u, *solve_ivp(f, (0, T), [angle, rate], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]])


@pytest.mark.parametrize("t", [0.35, 0.0])
@pytest.mark.drawn(1)
def test_away_from_an_equilibrium_the_transition_is_the_derivative_of_the_motion(t):
    lin = pendulum().linearize(t, rtol=1e-12, atol=1e-13)
    order = [lin.states.index(n) for n in ("controller.past.last", "angle.y", "rate.y")]
    x = lin.point.x[[list(names(lin)).index(n) for n in ("controller.past.last", "angle.y", "rate.y")]]
    close(lin.A[np.ix_(order, order)], differences(pendulum_by_hand, x, 1e-3), 1e-9)
    close(lin.affine[order], pendulum_by_hand(x) - x, 1e-9)
    assert not lin.is_equilibrium
    assert lin.point.residual > 0.1


def names(lin):

    return lin.diagram.flatten(lin.point.base).labels


def test_a_source_that_jumps_within_the_period_is_followed():
    x = Integrator(initial_value=0.5)
    jump = Step(times=0.02, values=3.0)
    f = Function(lambda x, w: -(x**3) * w)(x.y, Sum(signs="++")(jump, Constant(value=1.0)))

    @subsystem(sample_time=T)
    def box(x):
        return Gain(gain=0.1)(x)

    lin = Diagram("d", x(Sum(signs="++")(f, box(x.y)))).linearize()

    def go(x):
        u = 0.1 * x[0]
        for span, w in ((0.02, 1.0), (0.03, 4.0)):
            x = solve_ivp(lambda t, s, w=w: -(s**3) * w + u, (0, span), x, method="DOP853", rtol=1e-13, atol=1e-14).y[
                :, -1
            ]
        return x

    close(lin.A, differences(go, np.array([0.5]), 1e-3), 1e-9)


@pytest.mark.slow
def test_a_bent_algebraic_loop_is_solved_all_along_the_period():
    """ẋ = −2 v + u, v = 0.5 sin v + x², u held."""
    x = Integrator(initial_value=1.2)
    a, b = Function(lambda v: 0.5 * np.sin(v), name="a"), Sum(signs="++", name="b")
    loop = b(a.y, Function(lambda x: x**2)(x.y)).named("v")

    @subsystem(sample_time=T)
    def box(v):
        return Function(lambda v: v * v)(v)

    f = Function(lambda v, u: -2 * v + u)(loop, box(loop))
    lin = Diagram("d", a(loop), x(f), loops="solve").linearize(0.1, rtol=1e-11, atol=1e-13)

    def go(x):
        def v(x):
            return brentq(lambda v: 0.5 * np.sin(v) + x**2 - v, -5, 5, xtol=1e-15)

        u = v(x[0]) ** 2
        return solve_ivp(lambda t, s: [-2 * v(s[0]) + u], (0, T), x, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]

    x0 = lin.point.x[[list(names(lin)).index("integrator.y")]]
    i = lin.states.index("integrator.y")
    close(lin.A[[[i]], [[i]]], differences(go, x0, 1e-3), 1e-9)
    assert lin.affine[i] == pytest.approx((go(x0) - x0)[0], rel=1e-9)


def test_time_in_the_flow_counts_even_where_nothing_moves():
    x = Integrator(initial_value=0.0)
    f = Function(lambda x, s: x * s)(x.y, Sine(frequency=1.0, amplitude=40.0))

    @subsystem(sample_time=T)
    def box(x):
        return Gain(gain=0.0)(x)

    A = Diagram("d", x(f), box(x.y)).linearize().A
    assert A[-1, -1] == pytest.approx(np.exp(40 * (1 - np.cos(2 * np.pi * T)) / (2 * np.pi)), rel=1e-10)


@pytest.mark.slow
@pytest.mark.drawn(2)
@pytest.mark.parametrize("t", [0.0, 0.1, 0.15, 0.2])
def test_several_rates_that_move_against_differences_of_the_simulation(t):
    """Boxes every 2 and every 3 ticks with an offset around the pendulum's equation."""
    rate, angle = Integrator(initial_value=0.4, name="rate"), Integrator(initial_value=1.1, name="angle")

    @subsystem(sample_time=2 * T)
    def slow(a):
        z = UnitDelay(initial_value=0.3)
        out = Function(lambda a, z: np.sin(3 * a) + z * a)(a, z.y)
        z(Gain(gain=0.5)(out))
        return out

    @subsystem(sample_time=0.15, offset=T)
    def slower(a, v):
        return Function(lambda a, v: np.tanh(a * v))(a, v)

    u = slow(angle.y).named("u")
    f = Function(lambda a, v, u, w: -5 * np.sin(a) + u * w)(angle.y, rate.y, u, slower(rate.y, u).named("w"))
    diagram = Diagram("d", angle(rate(f)))
    A, moved = by_simulation(diagram, t, 6 * T)
    lin = diagram.linearize(t, rtol=1e-11, atol=1e-13)
    keep = [names(lin).index(n) for n in lin.states]
    close(lin.A, A[np.ix_(keep, keep)], 1e-7)
    close(lin.affine, moved[keep], 1e-7)
    gone = [i for i in range(len(A)) if i not in keep]
    assert not np.any(A[np.ix_(keep, gone)])


def test_a_cut_wire_keeps_the_motion_of_the_closed_diagram_at_every_tick_of_a_period():
    """Both boxes and what is cut, by hand: a fast one feeds a slow one, which feeds it back."""

    a = UnitDelay(initial_value=0.7, name="a")
    b = UnitDelay(initial_value=-0.4, name="b")

    @subsystem(sample_time=T)
    def fast(v):
        out = Function(lambda a, v: np.sin(a) + 0.3 * v, name="out")(a.y, v)
        a(out)
        return out

    @subsystem(sample_time=T)
    def squares(u):
        c = UnitDelay(initial_value=0.2, name="c")
        c(Function(lambda c, u: c * u + u * u, name="next")(c.y, u))
        return c.y

    @subsystem(sample_time=2 * T)
    def slow(u):
        return b(Function(lambda u, z: u * z, name="times")(u, squares(u)))

    y = fast(b.y).named("y")
    diagram = Diagram("d", slow(y).named("end"))
    lin = diagram.linearize(outputs="end", inputs="y", openings="y")

    def go(state, nominal=None, d=0.0):
        a, b, c = state
        b_next, seen = b, []
        for k in range(2):
            y = np.sin(a) + 0.3 * b
            seen.append(y)
            got = y if nominal is None else nominal[k] + d
            if k == 0:
                b_next = got * c  # the slow box holds what it put out
            a, c = got, c * got + got * got
        return np.array([a, b_next, c]), seen

    x0 = np.array([0.7, -0.4, 0.2])
    _, nominal = go(x0)
    order = [lin.states.index(next(s for s in lin.states if s.split(".")[-2] == n and "held" not in s)) for n in "abc"]
    close(lin.A[np.ix_(order, order)], differences(lambda x: go(x, nominal)[0], x0), 1e-9)
    close(lin.B[order], differences(lambda d: go(x0, nominal, d[0])[0], np.zeros(1)), 1e-9)


# --- loops ---------------------------------------------------------------------------------------------------------------


def hybrid():
    """A plant with two inputs and outputs, and a sampled controller: vector wires."""
    plant = StateSpace(
        A=[[0, 1, 0], [-4, -0.4, 1], [0.5, 0, -2]],
        B=[[0, 0], [1, 0.2], [0, 3]],
        C=[[1, 0, 0], [0, 0, 1]],
        D=np.zeros((2, 2)),
        name="plant",
    )

    @subsystem(sample_time=T)
    def controller(y):
        pi = DiscreteStateSpace(
            A=np.eye(2), B=T * np.eye(2), C=[[-1, 0.1], [0, -0.7]], D=[[-2, 0.0], [0.3, -0.5]], name="pi"
        )
        return pi(y).named("u")

    return Diagram("hybrid", plant(controller(plant.y.named("y")).named("force")))


@pytest.mark.drawn(1)
@pytest.mark.parametrize("wire", ["u", "y"])
def test_sensitivities_belong_to_the_loop(wire):
    lin = hybrid().linearize()
    L, S, U = lin.loop(wire), lin.sensitivity(wire), lin.complementary(wire)
    for w in np.geomspace(0.1, np.pi / T, 30):
        z = np.exp(1j * w * T)
        eye = np.eye(2)
        assert np.abs(S(z) + U(z) - eye).max() < 1e-12
        assert np.abs(S(z) - np.linalg.inv(eye + L(z))).max() < 1e-12 * np.abs(S(z)).max()
    assert isinstance(L, control.StateSpace)
    assert L.dt == T
    assert L.input_labels == [f"controller_u[{i}]" if wire == "u" else f"y[{i}]" for i in (1, 2)]
    assert S.name == f"S({wire})"


def closed(L):
    return np.poly(L.A - L.B @ np.linalg.solve(np.eye(len(L.D)) + L.D, L.C))


def test_the_closed_loops_poles_do_not_depend_on_where_it_is_cut():
    lin = hybrid().linearize()
    want = np.poly(lin.A)
    for cut in (("u",), ("y",), ("u[1]",), ("y[2]",), ("y[1]", "u[2]")):
        L = lin.loop(*cut)
        assert np.abs(closed(L) - want).max() < 1e-12
        assert L.ninputs == (2 if "[" not in cut[0] else len(cut))


@pytest.mark.parametrize("t", [0.35, 0.0])
@pytest.mark.drawn(1)
def test_closing_a_cut_loop_gives_the_closed_one_on_the_move_as_well(t):
    lin = pendulum().linearize(t)
    cut = pendulum().linearize(t, inputs="force", outputs="force", openings="force")
    close(cut.A + cut.B @ np.linalg.solve(np.eye(1) - cut.D, cut.C), lin.A, 1e-10)
    close(cut.affine, lin.affine, 1e-10)


def test_a_cut_at_a_port_cuts_all_its_consumers():
    x, y = Integrator(name="x"), Integrator(name="y")
    both = x.y.named("both")
    diagram = Diagram("d", x(Gain(gain=-2.0)(both)), y(both))
    assert diagram.linearize(openings="both").A.tolist() == [[0, 0], [0, 0]]
    assert diagram.linearize(openings="x.y").A.tolist() == [[0, 0], [0, 0]]
    assert diagram.linearize().A.tolist() == [[-2, 0], [1, 0]]


def test_a_loop_in_continuous_time_is_refused_in_a_model_over_a_period_where_it_is_not_closed_at_ticks():
    diagram = pendulum()
    with pytest.raises(OptionError, match=r"^rate\.y: 'velocity' changes between ticks, and blocks in continuous"):
        diagram.linearize().loop("velocity")
    assert diagram.linearize().loop("force").ninputs == 1


def test_a_torn_port_of_a_solved_loop_can_be_cut_and_injected_into():
    a, b = Gain(gain=0.5, name="a"), Sum(signs="++", name="b")
    loop = b(a.y, Constant(value=1.0)).named("v")
    diagram = Diagram("d", a(loop).named("w"), loops="solve")
    for wire in ("v", "w"):
        lin = diagram.linearize()
        assert pytest.approx(np.array([[-0.5]]), rel=1e-14) == lin.loop(wire).D
        assert pytest.approx(np.array([[2.0]]), rel=1e-14) == lin.sensitivity(wire).D


# --- what counts as a state -----------------------------------------------------------------------------------------------


def on_path():
    path = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
    mass = StateSpace(A=-np.eye(2), B=np.eye(2), C=np.eye(2), initial_state=[0.7, 0.6], name="mass")

    @subsystem(sample_time=T)
    def controller(y):
        theta = PathProjection(path, name="projection")(y)
        return Function(lambda t, s: s - 0.1 * np.stack([np.cos(6 * t), np.sin(6 * t)]))(theta, y)

    return Diagram("d", mass(controller(mass.y).named("u")))


def test_memory_is_reported_and_is_no_pole():
    lin = on_path().linearize()
    assert lin.memory == ("controller.projection.foot",)
    assert len(lin.A) == 3
    assert lin.poles.shape == (2,)
    assert np.abs(lin.A[:, lin.states.index("controller.projection.foot")]).max() < 1e-9
    everything = np.linalg.eigvals(lin.A)
    assert np.sort(np.abs(everything))[0] < 1e-9
    assert np.sort(np.abs(everything))[1:] == pytest.approx(np.sort(np.abs(lin.poles)), rel=1e-9)


def test_a_mode_that_only_events_change_is_no_state():
    x = Integrator(initial_value=0.3)

    @subsystem(sample_time=T)
    def box(x):
        return Gain(gain=-1.0)(x)

    relay = Relay(on_point=1.0, off_point=-1.0, on_value=2.0)(x.y)
    lin = Diagram("d", x(Sum(signs="++")(relay, box(x.y)))).linearize()
    assert lin.states == ("integrator.y",)
    assert pytest.approx(np.array([[1 - T]]), rel=1e-13) == lin.A
    assert lin.findings == (StepsOnly("relay", "y", "u"),)


def test_an_event_within_the_period_is_told():
    x = Integrator(initial_value=0.9)

    @subsystem(sample_time=1.0)
    def box(x):
        return Gain(gain=0.0)(x)

    relay = Relay(on_point=1.0, off_point=-1.0, on_value=-2.0, off_value=1.0)(x.y)
    lin = Diagram("d", x(Sum(signs="++")(relay, box(x.y)))).linearize()
    steps, note = lin.notes
    assert steps == "relay.y follows 'u' in steps only: it linearizes to zero"
    assert re.match(
        r"relay: its event '\w+' fires within the period from t = 0 s; the model is that of the motion", note
    )
    finding = lin.findings[1]
    assert isinstance(finding, EventWithinPeriod)
    assert (finding.block, finding.t, str(finding)) == ("relay", 0.0, note)


def test_names_are_those_of_wires_and_states():
    lin = hybrid().linearize(inputs="u", outputs=["y[2]", "plant.y"])
    assert lin.states == ("controller.pi.x[1]", "controller.pi.x[2]", "plant.x[1]", "plant.x[2]", "plant.x[3]")
    assert lin.inputs == ("controller.u[1]", "controller.u[2]")
    assert lin.outputs == ("y[2]", "plant.y[1]", "plant.y[2]")
    system = lin.system
    assert system.state_labels[0] == "controller_pi_x[1]"
    assert system.output_labels == ["y[2]", "plant_y[1]", "plant_y[2]"]
    assert system.name == "hybrid"
    assert isinstance(lin, Linearization)
    assert isinstance(lin.point, OperatingPoint)
    assert len(pickle.dumps(lin.point)) > 100


def test_a_diagram_without_states_has_a_model():
    lin = Diagram("d", Gain(gain=3.0)(Constant(value=1.0).y.named("u")).named("y")).linearize(inputs="u", outputs="y")
    assert lin.D.tolist() == [[3.0]]
    assert lin.poles.size == 0
    assert lin.system.D.tolist() == [[3.0]]


# --- what a model does not follow, and opaque blocks -----------------------------------------------------------------------


def test_an_encoder_by_its_slope_of_zero_says_so():
    x = Integrator(initial_value=0.3)

    @subsystem(sample_time=T)
    def box(x, v):
        p, _ = Encoder(quantum=1e-3, name="encoder")(x, v)
        return Gain(gain=-1.0)(Quantizer(quantum=0.1)(p))

    u = box(x.y, Constant(value=0.0)).named("u")
    lin = Diagram("d", x(u)).linearize(0.1, stairs="zero")
    assert lin.notes == (
        "box.encoder.measured_position follows 'position' in steps only: it linearizes to zero",
        "box.encoder.measured_velocity follows 'position' in steps only: it linearizes to zero",
        "box.quantizer.y follows 'u' in steps only: it linearizes to zero",
    )
    assert lin.findings[-1] == StepsOnly("box.quantizer", "y", "u")
    assert lin.A[-1, -1] == 1.0


def test_a_start_that_is_unlike_every_later_tick_is_told():
    x = Integrator()

    @subsystem(sample_time=T)
    def box(x, t):
        return Function(lambda x, t: np.where(t > 0, -x, 0.0))(x, t)

    diagram = Diagram("d", x(box(x.y, Clock())))
    assert diagram.linearize().notes[-1].startswith("the start is unlike every later tick")
    assert isinstance(diagram.linearize().findings[-1], UnusualStart)
    assert diagram.linearize(T).notes == ()


def test_an_opaque_block_is_differenced_and_it_says_so():
    x = Integrator(initial_value=0.5)
    f = PythonFunction(lambda x: -np.sin(x), name="foreign")
    lin = Diagram("d", x(f(x.y))).linearize()
    assert pytest.approx(np.array([[-np.cos(0.5)]]), rel=1e-9) == lin.A
    assert lin.how == {"foreign": "differences of the block"}
    assert lin.derivations == {"foreign": Derivation(DerivativeMethod.BLOCK_DIFFERENCES)}
    assert not lin.derivations["foreign"].is_exact


# --- operating points ------------------------------------------------------------------------------------------------------


def test_an_instant_of_a_run_is_found_again_with_its_step_its_tolerances_and_its_start():
    diagram = pendulum()
    first = diagram.simulate(0.2, progress=False, rtol=1e-10)
    second = diagram.simulate(0.4, progress=False, rtol=1e-10, start=first.final_state)
    for t in (0.2, 0.4, 0.6):
        point = diagram.linearize(second.at(t)).point
        assert point.t == pytest.approx(t, abs=1e-15)
        assert point.values["angle.y"] == pytest.approx(second.at(t)["angle.y"], abs=1e-12)
    whole = diagram.simulate(0.6, progress=False, rtol=1e-10)
    close(diagram.linearize(whole.at(0.5)).A, diagram.linearize(second.at(0.5)).A, 1e-7)


@pytest.mark.slow
def test_every_sample_of_a_continuous_run_is_an_operating_point():
    x = Integrator(initial_value=1.0)
    diagram = Diagram("d", x(Function(lambda x: -(x**3))(x.y)))
    run = diagram.simulate(3.0, progress=False, rtol=1e-10, atol=1e-12)
    for t in (0.0, run.t[137], run.t[-1], 1 / 3):
        lin = diagram.linearize(run.at(t) if t in run.t else t, rtol=1e-10, atol=1e-12)
        exact = 1 / np.sqrt(1 + 2 * t)
        assert pytest.approx(np.array([[-3 * exact**2]]), rel=1e-8) == lin.A
        assert lin.affine == pytest.approx([-(exact**3)], rel=1e-8)


def test_a_run_that_was_restored_on_its_way_is_not_found_again_without_its_start():
    diagram = pendulum()
    first = diagram.simulate(1.0, progress=False)
    with diagram.simulation() as simulation:
        simulation.restore(first.final_state)
        simulation.advance(0.2)
        run = simulation.run()
    assert diagram.linearize(run.at(1.2)).point.t == 1.2  # the same run, as it happens
    with diagram.simulation() as simulation:
        simulation.restore(replace(first.final_state, x=0.5 * first.final_state.x))
        simulation.advance(0.2)
        run = simulation.run()
    with pytest.raises(OptionError, match=r"run again to t = 1\.2 s, the diagram is not where it was in this run"):
        diagram.linearize(run.at(1.2))


def test_a_solver_of_fixed_step_keeps_its_step_on_the_way():
    x = Integrator(initial_value=1.0)
    diagram = Diagram("d", x(Function(lambda x: -(x**3))(x.y)))
    run = diagram.simulate(1.0, step=0.25, solver="euler", progress=False)
    assert diagram.linearize(run.at(1.0)).point.x.tolist() == run.at(1.0).state.tolist()
    half = diagram.simulate(0.5, step=0.25, solver="euler", progress=False)
    again = diagram.simulate(0.5, step=0.25, solver="euler", progress=False, start=half.final_state)
    assert diagram.linearize(again.at(1.0)).point.x.tolist() == run.at(1.0).state.tolist()
    with pytest.raises(OptionError, match=r"t = 0\.3 s is between two ticks"):
        diagram.linearize(0.3, step=0.25, solver="euler")


def test_points_between_the_ticks_of_slow_boxes_are_operating_points():
    diagram = hybrid()
    lin = diagram.linearize(0.02, step=0.01)
    assert lin.dt == T
    poles, want = np.poly(lin.A), np.poly(diagram.linearize().A)
    assert np.abs(poles[: len(want)] - want).max() < 1e-12


@pytest.mark.equal_bits
def test_a_batch_goes_through_points_and_parameters():
    found = hybrid().linearize_batch([0.0, T], [{}, {"pi.D": np.zeros((2, 2))}], inputs="u", outputs="u")
    assert [(lin.point.t, bool(np.any(lin.D))) for lin in found] == [(0.0, False), (T, False)] * 2
    assert not np.allclose(found[0].A, found[2].A)
    assert np.array_equal(found[0].A, hybrid().linearize().A)
    with pytest.raises(UnknownNameError, match=r"pi: it has no parameter 'E'.*\(with \{'pi\.E': 1\}"):
        hybrid().linearize_batch(variants=[{"pi.E": 1}])


@pytest.mark.parametrize(
    ("error", "text", "call"),
    [
        (UnknownNameError, r"there is no signal 'forse' in this diagram\. Did you mean 'force'", {"inputs": "forse"}),
        (
            UnknownNameError,
            r"'y' has no entry \[0\]; expected one within its shape \(2,\), counted from 1",
            {"inputs": "y[0]"},
        ),
        (UnknownNameError, r"Diagram.linearize: it has no argument 'ouputs'\. Did you mean 'outputs'", {"ouputs": "y"}),
        (OptionError, r"found plants='magic'; expected one of 'equations', 'step'", {"plants": "magic"}),
        (
            OptionError,
            r"operating point: t = 0\.07 s is between two ticks, which are 0\.05 s apart\. Take 0\.05 s",
            {"point": 0.07},
        ),
        (OptionError, r"found t = -1\.0 s; expected a time from 0 s on", {"point": -1}),
        (OptionError, r"found 'now'; expected an operating point", {"point": "now"}),
        (OptionError, r"found t = nan s", {"point": float("nan")}),
    ],
)
def test_what_is_wrong_is_said(error, text, call):
    with pytest.raises(error, match=text):
        hybrid().linearize(call.pop("point", None), **call)


def test_an_opening_at_which_nothing_is_wired_is_refused():
    x = Integrator(name="x")
    diagram = Diagram("d", x(Constant(value=0.0)))
    with pytest.raises(WiringError, match=r"^x\.y: found nothing wired to it; expected a wire to cut at 'x\.y'"):
        diagram.linearize(openings="x.y")


def test_a_transport_delay_in_continuous_time_is_closed_around_the_matrices():
    """ẋ = −y, y(t) = x(t − 0.1)."""
    x = Integrator(name="x")
    model = Diagram("d", x(-TransportDelay(delay=0.1, name="late")(x.y))).linearize()
    delays = model.delays
    assert (model.A.tolist(), delays.names, delays.times.tolist()) == ([[0.0]], ("late.y",), [0.1])
    assert np.ravel([delays.G, delays.Z, delays.H]) == pytest.approx([-1.0, 1.0, 0.0], abs=1e-12)


def test_the_point_of_another_diagram_is_refused():
    point = hybrid().operating_point()
    with pytest.raises(OptionError, match="found the operating point of a diagram with other blocks or wires"):
        pendulum().linearize(point)
    with pytest.raises(OptionError, match=r"found an instant of a run of the diagram 'hybrid', which has other blocks"):
        pendulum().linearize(hybrid().simulate(T, progress=False).at(T))
    with pytest.raises(OptionError, match=r"found step=0\.01; expected 0\.05 s, the ticks of the operating point"):
        hybrid().linearize(point, step=0.01)


def test_a_point_on_an_event_or_after_the_end_is_refused():
    @subsystem(sample_time=T)
    def box():
        return Step(times=2 * T, values=1.0)

    x = Integrator(name="x")
    diagram = Diagram("d", x(Relay(on_point=0.5, off_point=-0.5, name="relay")(box())))
    with pytest.raises(
        OptionError, match=r"at t = 0\.1 s the event '\w+' of 'relay' fires, so there is no linear model"
    ):
        diagram.linearize(2 * T)
    assert diagram.linearize(3 * T).affine == pytest.approx([T])
    late = Compare(relation=">")(x.y, Constant(value=1.0))
    with pytest.raises(
        OptionError, match=r"the run is stopped at t = 1 s by 'stop_condition', before the operating point"
    ):
        Diagram("d", x(Constant(value=1.0)), StopCondition()(late)).linearize(2.0, step=0.25)


def test_a_point_without_derivative_is_an_error():
    x = Integrator()
    diagram = Diagram("d", x(Function(np.sqrt)(x.y)))
    with pytest.raises(NonFiniteError, match="found a derivative of the diagram's functions that is not finite"):
        diagram.linearize()


def test_a_model_without_signals_is_no_system():
    with pytest.raises(OptionError, match="found 0 inputs and 0 outputs; expected at least one of each"):
        _ = hybrid().linearize().system
    with pytest.raises(OptionError, match="found no name of a wire"):
        hybrid().linearize().loop()
