"""Operating points by trim, from given states, and runs that start there."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    Delay,
    Ellipse,
    Function,
    Gain,
    Input,
    Integrator,
    OptionError,
    ParameterError,
    Reference,
    SimulationError,
    State,
    Sum,
    TransportDelay,
    UnitDelay,
    UnknownNameError,
    parameter,
)
from loopwright.diagrams import Channel, Diagram, fig3, subsystem
from loopwright.fmus import Fmu, build, gantry, mass_spring_damper
from loopwright.fmus.models.mass_spring_damper import MassSpringDamper

PATH = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))


def pendulum():
    """θ̈ = −9.81 sin θ − θ̇ + τ."""
    torque = Constant(value=0.0, name="torque")
    rate, angle = Integrator(name="rate"), Integrator(name="angle")
    acceleration = Function(lambda a, w, tau: -9.81 * np.sin(a) - w + tau, name="motion")
    return Diagram("pendulum", angle(rate(acceleration(angle.y, rate.y, torque))))


def mass():
    """A mass of 1 kg on a spring of 100 N/m, as an FMU, driven by a constant force."""
    plant = Fmu(mass_spring_damper.build(), name="plant")
    return Diagram("mass", plant(force=Constant(value=0.0, name="force")))


def fig3_at_rest(xi=0.0, eta=0.12):
    plant = Fmu(gantry.build(), name="plant", start={"position": PATH.to_plane(eta + 0.02, xi - 0.01)})
    par, perp = (Channel(Reference(v, unit="m", name=n)) for v, n in ((eta, "eta_d"), (xi, "xi_d")))
    return fig3(plant, PATH, par, perp)


def test_a_parameter_is_found_for_a_signal_at_rest():
    point = pendulum().trim(free={"torque.value": (-10, 10)}, targets={"angle.y": 0.5})
    assert point.how == "trim"
    assert point.parameters["torque.value"] == pytest.approx(9.81 * np.sin(0.5), rel=1e-12)
    assert point.values["rate.y"] == pytest.approx(0.0, abs=1e-12)
    assert point.residual <= 1e-9
    assert set(point.residuals) == {"d/dt angle.y", "d/dt rate.y", "angle.y"}


def test_states_alone_are_found_where_parameters_are_given():
    point = pendulum().replace({"torque.value": 3.0}).trim()
    assert point.values["angle.y"] == pytest.approx(np.arcsin(3.0 / 9.81), rel=1e-12)


def test_the_branch_is_chosen_by_where_the_search_begins_and_by_bounds():
    diagram = pendulum()
    above = diagram.trim(at=diagram.operating_point(states={"angle.y": 3.0}))
    assert above.values["angle.y"] == pytest.approx(np.pi, rel=1e-12)
    bounded = diagram.trim(free={"angle.y": (2.0, 4.0)})
    assert bounded.values["angle.y"] == pytest.approx(np.pi, rel=1e-12)


def test_a_rate_that_is_asked_for_is_had():
    point = pendulum().trim(free=["torque.value"], targets={"angle.y": 0.2}, rates={"angle.y": 1.5, "rate.y": 0.0})
    assert point.values["rate.y"] == pytest.approx(1.5, rel=1e-12)
    assert point.parameters["torque.value"] == pytest.approx(9.81 * np.sin(0.2) + 1.5, rel=1e-12)


def test_what_is_fixed_stays_and_a_free_rate_is_no_equation():
    point = pendulum().trim(fixed=["angle.y", "rate.y"], rates={"rate.y": None, "angle.y": None})
    assert point.values["angle.y"] == 0.0
    assert point.residuals == {}


def test_an_fmu_stands_where_it_is_asked_to_and_the_run_from_there_stays():
    diagram = mass()
    point = diagram.trim(free={"force.value": (-100, 100)}, targets={"plant.position": 0.2}, step=1e-3)
    assert point.parameters["force.value"] == pytest.approx(20.0, rel=1e-12)
    assert point.plants["plant"]["state"]["position"] == pytest.approx(0.2, rel=1e-12)
    run = diagram.simulate(0.5, start=point, progress=False)
    assert np.max(np.abs(run["plant.position"] - 0.2)) <= 1e-14
    assert run["force.y"][0] == pytest.approx(20.0, rel=1e-12)


@pytest.mark.slow
def test_an_fmus_own_parameter_is_found():
    """a = (F − d v − k s)/m: 0.5 = (20.5 − 0 − 20)/m."""
    diagram = mass().replace({"force.value": 20.5})
    point = diagram.trim(
        free={"plant.start.mass": (0.1, 10.0)},
        targets={"plant.position": 0.2, "plant.acceleration": 0.5},
        rates={"plant.velocity": None},
        step=1e-3,
    )
    assert point.parameters["plant.start.mass"] == pytest.approx(1.0, rel=1e-9)


class Capillary(Block):
    """A vessel that empties through a capillary: V̇ = q − k d⁴ V."""

    diameter: float = parameter(default=2e-6, unit="m", description="d")
    conductance: float = parameter(default=1e23, unit="1/(m4.s)", description="k")
    inflow = Input(unit="m3/s", description="q")
    volume = State(unit="m3", start=1.0, output=True)

    def derivative(self, t, x, u):
        return u.inflow - self.conductance * self.diameter**4 * x.volume


@pytest.mark.slow
def test_a_parameter_of_an_fmu_far_below_1_in_its_unit_is_found():
    plant = Fmu(build(Capillary()), name="plant")
    diagram = Diagram("vessel", plant(inflow=Constant(value=0.5, unit="m3/s", name="q")))
    point = diagram.trim(free={"plant.start.diameter": (1e-7, 1e-3)}, targets={"plant.volume": 2.0}, step=1e-2)
    assert point.parameters["plant.start.diameter"] == pytest.approx((0.5 / (1e23 * 2.0)) ** 0.25, rel=1e-9)


@pytest.mark.slow
def test_fig3_at_rest_at_a_point_off_the_path_stays_there():
    diagram = fig3_at_rest(xi=0.03)
    point = diagram.trim()
    assert point.residual <= 1e-12
    np.testing.assert_allclose(point.plants["plant"]["state"]["position"], PATH.to_plane(0.12, 0.03), atol=1e-13)
    np.testing.assert_allclose(point.z[:2], gantry.nominal.weight, atol=1e-10)
    run = diagram.simulate(1.0, start=point, progress=False)
    assert np.max(np.abs(run["position"] - run["position"][0])) <= 1e-12
    assert np.max(np.abs(run["xi"][:, 0] - 0.03)) <= 1e-12


def test_a_trim_is_linearized_with_its_parameters():
    """At θ = 0.5 the stiffness is 9.81 cos 0.5."""
    diagram = pendulum()
    model = diagram.linearize(diagram.trim(free=["torque.value"], targets={"angle.y": 0.5}))
    assert model.is_equilibrium
    stiffness = 9.81 * np.cos(0.5)
    np.testing.assert_allclose(np.poly(model.A), [1.0, 1.0, stiffness], rtol=1e-9)


def test_sampled_states_repeat():
    """q⁺ = 0.5 q + u and a delay: q = 2 u."""

    @subsystem(sample_time=0.1)
    def law(u):
        q = UnitDelay(initial_value=0.0, name="q")
        return Delay(steps=3, initial_value=0.0, name="late")(q(0.5 * q.y + u)).named("late")

    point = Diagram("d", law(Constant(value=1.5, name="u"))).trim()
    assert point.values["law.late.y"] == pytest.approx(3.0, rel=1e-12)
    run = Diagram("d", law(Constant(value=1.5, name="u"))).simulate(1.0, start=point, progress=False)
    np.testing.assert_allclose(run["late"], 3.0, rtol=1e-12)


def test_a_box_that_does_not_act_at_the_start_holds_what_it_puts_out_at_the_point():
    """x' = 1 − x + h with h = −2 x held by a box with an offset: x = 1/3."""

    @subsystem(sample_time=0.1, offset=0.05)
    def law(x):
        return Gain(gain=-2.0, name="k")(x)

    x = Integrator(name="x", initial_value=5.0)
    diagram = Diagram("d", x(Constant(value=1.0) - x.y + law(x.y)))
    run = diagram.simulate(1.0, start=diagram.trim(), progress=False)
    np.testing.assert_allclose(run["x.y"], 1 / 3, rtol=1e-9)


def test_an_algebraic_loop_is_solved_along():
    """x' = v − x with v = cos(v) + x/2."""
    x = Integrator(name="x")
    v = Function(lambda v, x: np.cos(v) + 0.5 * x, name="v")
    diagram = Diagram("d", x(v(v.y, x.y) - x.y), loops="solve")
    point = diagram.trim()
    assert point.values["x.y"] == pytest.approx(brentq(lambda s: np.cos(s) - 0.5 * s, 0, 2), rel=1e-10)


def delayed(initial_value=0.0):
    """Ẋ = pipe − √x, the pipe 1.05 s late, a sampled PI that wants √x to be 0.6."""
    pipe, tank = (
        TransportDelay(delay=1.05, initial_value=initial_value, name="pipe"),
        Integrator(name="tank", initial_value=0.5),
    )
    root = Function(lambda x: np.sqrt(x), name="root")
    controller = subsystem(sample_time=0.1)(lambda wanted, y: PID(kp=0.5, ki=0.1)(wanted, y).named("u"))
    flow = root(tank.y)
    return Diagram("delayed", tank(pipe(controller(Constant(value=0.6), flow)) - flow))


@pytest.mark.drawn(2)
@pytest.mark.parametrize("initial_value", [0.0, 0.5, None])
def test_a_dead_time_at_rest_puts_out_its_input(initial_value):
    """Whatever it holds at the start: the search wanted it to put out 0, and no such loop had an operating point."""
    diagram = delayed(initial_value)
    point = diagram.trim()
    found = [point.values[name] for name in ("tank.y", "pipe.y", "root.y")]
    assert found == pytest.approx([0.36, 0.6, 0.6], abs=1e-9)
    run = diagram.simulate(3.0, start=point, progress=False)
    assert run["tank.y"] == pytest.approx(np.full(31, 0.36), abs=1e-8)
    assert point.free == ()


def test_a_dead_time_puts_out_what_it_did_where_other_states_are_given():
    """At 0.8 s nothing has passed it yet."""
    point = delayed(0.25).operating_point(0.8, states={"tank.y": 0.49})
    assert [point.values["pipe.y"], point.values["root.y"]] == pytest.approx([0.25, 0.7], abs=1e-12)


def test_a_run_with_a_dead_time_starts_where_states_are_given_and_not_within_a_run():
    """What has gone into the pipe is 0.25 V before, as at the start; of a point within a run it isn't known."""
    diagram = delayed(0.25)
    given = diagram.operating_point(0.0, states={"tank.y": 0.49})
    run = diagram.simulate(1.0, start=given, progress=False)
    exact = solve_ivp(lambda t, x: 0.25 - np.sqrt(x), (0.0, 1.0), [0.49], rtol=1e-10, atol=1e-12).y[0, -1]
    assert run["tank.y"][-1] == pytest.approx(exact, abs=1e-6)
    with pytest.raises(
        OptionError, match=r"^delayed\.start: the operating point at t = 2 s moves .*start=run\.final_state"
    ):
        diagram.simulate(1.0, start=diagram.operating_point(2.0), progress=False)


def test_targets_out_of_reach_are_an_error_with_what_is_left():
    with pytest.raises(SimulationError, match=r"no operating point.*torque\.value is at its bound"):
        pendulum().trim(free={"torque.value": (-1, 1)}, targets={"angle.y": 0.5})
    near = pendulum().trim(free={"torque.value": (-1, 1)}, targets={"angle.y": 0.5}, tolerance=np.inf)
    assert next(iter(near.residuals.values())) > 1e-3


def test_the_residual_of_a_trim_is_what_still_moves_and_not_what_is_left_of_its_equations():
    turning = pendulum().trim(fixed=["angle.y"], rates={"angle.y": 2.0, "rate.y": None})
    assert next(iter(turning.residuals.values())) <= 1e-9
    assert turning.residual == pytest.approx(2.0, rel=1e-9)
    assert turning.largest == "angle"


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"targets": {"angel.y": 1.0}}, UnknownNameError, "angle"),
        ({"free": {"torque.valu": None}}, UnknownNameError, "value"),
        ({"fixed": ["angel"]}, UnknownNameError, "angle"),
        ({"rates": {"angel": 1.0}}, UnknownNameError, "angle"),
        ({"free": {"torque.value": 3.0}}, OptionError, "pair"),
        ({"free": {"torque.value": (2.0, 1.0)}}, OptionError, "lowest value first"),
        ({"free": "torque.value"}, OptionError, "in a list|bounds"),
        ({"targets": {"angle.y": (1.0, 2.0)}}, OptionError, "shape"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, error, text):
    with pytest.raises(error, match=text):
        pendulum().trim(**arguments)


def test_a_parameter_that_is_structure_is_refused():
    @subsystem(sample_time=0.1)
    def law(u):
        return Delay(steps=2, name="late")(u)

    with pytest.raises(ParameterError, match="a trim finds numbers alone"):
        Diagram("d", law(Constant(value=1.5, name="u"))).trim(free=["late.steps"])
    start = Diagram("d", MassSpringDamper(name="m")(force=Constant(value=1.0)))
    with pytest.raises(ParameterError, match="structure"):
        start.trim(free=["m.start_position"])


def test_an_unknown_parameter_of_a_blocks_path_is_told_with_the_block():
    with pytest.raises(UnknownNameError, match=r"path_projection: it has no parameter 'path.centre'\. .*center"):
        fig3_at_rest().trim(free=["controller.path_projection.path.centre"])


def test_given_states_make_the_signals_that_follow_from_them():
    point = mass().operating_point(step=1e-3, states={"plant.position": 0.3, "plant.velocity": -0.1})
    assert point.how == "given"
    assert point.values["plant.acceleration"] == pytest.approx(-30.0 + 0.1, rel=1e-12)
    with pytest.raises(UnknownNameError, match="position"):
        mass().operating_point(step=1e-3, states={"plant.positon": 0.3})


def test_a_run_from_given_states_begins_there():
    """s(t) of a free mass from s = 0.3 against its closed form, at the FMU's internal step of 1 ms (RK4)."""
    diagram = mass()
    run = diagram.simulate(
        0.5, start=diagram.operating_point(step=1e-3, states={"plant.position": 0.3}), progress=False
    )
    w, t = np.sqrt(100 - 0.25), run.t
    want = 0.3 * np.exp(-0.5 * t) * (np.cos(w * t) + 0.5 / w * np.sin(w * t))
    np.testing.assert_allclose(run["plant.position"], want, atol=1e-9)


def test_a_run_goes_on_from_an_operating_point_of_a_run():
    diagram = fig3_at_rest()
    whole = diagram.simulate(0.4, progress=False)
    rest = diagram.simulate(0.2, start=diagram.operating_point(0.2), progress=False)
    np.testing.assert_allclose(rest.t, whole.t[200:], rtol=1e-12)
    np.testing.assert_allclose(rest["position"], whole["position"][200:], atol=1e-11)


def test_a_run_from_a_point_on_other_ticks_is_refused():
    diagram = mass()
    point = diagram.operating_point(0.003, step=1e-3)
    with pytest.raises(OptionError, match="ticks"):
        diagram.simulate(0.1, step=2e-3, start=point, progress=False)
    with pytest.raises(OptionError, match="another diagram"):
        fig3_at_rest().simulate(0.1, start=diagram.operating_point(step=1e-3), progress=False)


# --- trims that are not unique ------------------------------------------------------------------------------------------


def two_torques():
    """J ω̇ = motor − 2 load − 0.3 ω, φ̇ = ω: one equation for two torques, none for the angle."""
    angle, speed = Integrator(name="angle"), Integrator(name="speed")
    motor, load = Constant(value=1.0, name="motor"), Constant(value=0.5, name="load")
    total = Sum(signs="+--", name="sum")(motor, Gain(gain=2.0, name="two")(load), Gain(gain=0.3, name="damp")(speed.y))
    return Diagram("shaft", angle(speed.y), speed(total))


def test_a_trim_that_is_not_unique_names_the_directions_that_are_free():
    diagram = two_torques()
    point = diagram.trim(free=["motor.value", "load.value"])
    angle, torques = point.free
    assert dict(torques.entries) == pytest.approx({"motor.value": 1.0, "load.value": 0.5})  # 1 = 2 · 0.5
    assert dict(angle.entries) == {"angle.y": 1.0}
    assert "nothing determines the change of motor.value by 1, load.value by 0.5" in str(torques)
    model = diagram.linearize(point)
    assert model.findings == point.free
    assert model.carried == ()
    for share in (2.0, -3.0):  # every point along the direction is a trim
        moved = {name: point.parameters[name] + share * v for name, v in torques.entries}
        assert diagram.replace(moved).linearize(at_rest := diagram.replace(moved).trim()).point is at_rest
        assert at_rest.residual < 1e-12


def test_what_a_target_or_a_fixed_state_determines_is_not_free():
    diagram = two_torques()
    assert [f.entries for f in diagram.trim(free=["motor.value"]).free] == [(("angle.y", 1.0),)]
    assert diagram.trim(free=["motor.value"], targets={"angle.y": 0.3}).free == ()
    assert diagram.trim(free=["motor.value"], fixed=["angle.y"]).free == ()
    (torques,) = diagram.trim(free={"motor.value": (0, 5), "load.value": (0, 5)}, fixed=["angle.y"]).free
    assert {name for name, _ in torques.entries} == {"motor.value", "load.value"}


def test_a_free_direction_does_not_depend_on_units():
    """The angle in other units, 1e6 and 1e-6 of it, is as free as before, and nothing else is."""
    for unit in (1e-6, 1e6):
        angle, speed = Integrator(name="angle"), Integrator(name="speed")
        drive = speed(Sum(signs="+-")(Constant(value=0.0, name="u"), Gain(gain=0.3)(speed.y)))
        point = Diagram("d", angle(Gain(gain=unit)(speed.y)), drive).trim()
        assert [f.entries for f in point.free] == [(("angle.y", 1.0),)]
