"""Linear models of FMUs: directional derivatives and differences, of equations and of steps, against closed forms."""

import re
import zipfile
from functools import partial
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import ParameterError, UnknownNameError
from loopwright.fmus import (
    Fmu,
    FmuError,
    FmuRuntimeError,
    ModelSpec,
    Variable,
    bouncing_ball,
    build_fmu,
    dc_motor,
    gantry,
    gantry_contact,
    gantry_stiction,
    mass_spring_damper,
)
from loopwright.types import FmuLinearization
from support.closed_form import closed_form_fmu
from support.exported import pendulums, thermostat

WAYS = [("model_exchange", True), ("co_simulation", True), ("model_exchange", False), ("co_simulation", False)]
M, D, K = 2.0, 0.7, 30.0


def matrices(A, B, C, D):
    return np.block([[np.atleast_2d(A), np.atleast_2d(B)], [np.atleast_2d(C), np.atleast_2d(D)]])


def got(model):
    return matrices(model.A, model.B, model.C, model.D)


def bound(exact):
    """Of the largest entry: exact derivatives 1e-9, differenced ones 1e-6."""
    return 1e-9 if exact else 1e-6


def edited(file, folder, change):
    """The same FMU with another description."""
    path = folder / f"edited{len(list(folder.iterdir()))}.fmu"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                text = data.decode()
                assert change(text) != text
                data = change(text).encode()
            new.writestr(item, data)
    return path


@pytest.fixture(scope="module")
def msd(cache):
    """The library's: inputs (force), states (position, velocity), outputs (position, velocity, acceleration)."""
    return mass_spring_damper.build(mass_spring_damper.MassSpringDamper(mass=M, damping=D, stiffness=K))


@pytest.fixture(scope="module")
def motor(cache):
    return dc_motor.build()


A_MSD, B_MSD = np.array([[0, 1], [-K / M, -D / M]]), np.array([[0], [1 / M]])
WANT_MSD = matrices(A_MSD, B_MSD, np.vstack([np.eye(2), A_MSD[1]]), [[0], [0], [1 / M]])

R, L, KM, J, F = 1.2, 2e-3, 0.05, 2e-5, 1e-5
A_MOTOR = np.array([[-R / L, -KM / L, 0], [KM / J, -F / J, 0], [0, 1, 0]])
B_MOTOR = np.array([[1 / L, 0], [0, -1 / J], [0, 0]])
WANT_MOTOR = matrices(A_MOTOR, B_MOTOR, np.vstack([np.eye(3), [KM, 0, 0]]), np.zeros((4, 2)))


# --- of the equations -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("interface", "exact"), WAYS)
@pytest.mark.drawn(2)
def test_the_mass_spring_damper_has_its_matrices(msd, interface, exact):
    state = {"position": 0.3, "velocity": -1.2}
    model = Fmu(msd).linear_model(1.5, state=state, inputs={"force": 4.0}, interface=interface, exact=exact)
    assert np.abs(got(model) - WANT_MSD).max() < bound(exact) * np.abs(WANT_MSD).max()
    acceleration = (4.0 + D * 1.2 - K * 0.3) / M
    assert model.f == pytest.approx([-1.2, acceleration], rel=1e-14)
    assert model.y0 == pytest.approx([0.3, -1.2, acceleration], rel=1e-14)
    assert model.x0.tolist() == [0.3, -1.2]
    assert model.u0.tolist() == [4.0]
    assert (model.t, model.h) == (1.5, None)
    kind = "directional derivatives" if exact else "differences"
    assert model.how == f"{kind} in {interface.replace('_', '-')}"
    assert np.all((model.uncertainty == 0) if exact else (model.uncertainty >= np.abs(got(model) - WANT_MSD)))


@pytest.mark.parametrize(("interface", "exact"), WAYS)
def test_the_motor_has_its_matrices(motor, interface, exact):
    model = Fmu(motor).linear_model(state=[1.0, 50.0, 2.0], inputs=[12.0, 0.01], interface=interface, exact=exact)
    assert np.abs(got(model) - WANT_MOTOR).max() < bound(exact) * np.abs(WANT_MOTOR).max()
    assert model.states == ("current", "speed", "angle")
    assert model.inputs == ("voltage", "load_torque")
    assert model.outputs == ("current", "speed", "angle", "torque")
    assert isinstance(model, FmuLinearization)


@pytest.mark.parametrize(("interface", "exact"), WAYS)
def test_friction_enters_by_its_slope_at_the_operating_point(cache, interface, exact):
    # m dv/dt = u - F_c tanh(v/w) - c_v v + F - weight, per axis, with w = 10 mm/s
    v = np.array([0.004, -0.3])
    model = Fmu(gantry.build()).linear_model(state={"velocity": v}, interface=interface, exact=exact)
    m = np.array([7.61, 4.41]) + np.array([29.26, 16.79])
    slope = np.array([65.42, 37.69]) / 0.01 / np.cosh(v / 0.01) ** 2 + np.array([175.93, 62.83])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.zeros((2, 2)), np.diag(-slope / m)]])
    B = np.vstack([np.zeros((2, 4)), np.hstack([np.diag(1 / m)] * 2)])
    want = matrices(A, B, np.vstack([np.eye(4), A[2:]]), np.vstack([np.zeros((4, 4)), B[2:]]))
    assert np.abs(got(model) - want).max() < bound(exact) * np.abs(want).max()
    assert model.states == ("position[1]", "position[2]", "velocity[1]", "velocity[2]")
    assert model.inputs[2:] == ("external_force[1]", "external_force[2]")


@pytest.mark.parametrize(("interface", "exact"), WAYS)
def test_time_matrix_parameters_and_a_state_that_is_no_output_are_in_it(cache, interface, exact):
    plant = Fmu(build_fmu(pendulums()), start={"gain": [[1.0, 2.0], [3.0, 5.0]]})
    angle, torque = np.array([0.4, -0.6]), np.array([0.5, -0.1])
    model = plant.linear_model(0.7, state={"angle": angle}, inputs={"torque": torque}, interface=interface, exact=exact)
    A = np.zeros((5, 5))
    A[:2, 2:4], A[2:4, :2], A[2:4, 2:4] = np.eye(2), np.diag(-9.81 * np.cos(angle)), -0.1 * np.eye(2)
    B = np.zeros((5, 2))
    B[2:4] = [[1.0, 2.0], [3.0, 5.0]]
    C = np.zeros((5, 5))
    C[:2, :2], C[2:4, :2] = np.eye(2), np.diag(np.cos(angle))
    want = matrices(A, B, C, np.zeros((5, 2)))
    order = [[*model.outputs].index(n) for n in ("angle[1]", "angle[2]", "deflection[1]", "deflection[2]", "positive")]
    found = matrices(model.A, model.B, model.C[order], model.D[order])
    assert np.abs(found - want).max() < bound(exact) * 10.0
    f = np.array([0, 0, *(B[2:4] @ torque - 9.81 * np.sin(angle) + 0.5 * np.sin(2.1)), 0])
    assert model.f == pytest.approx(f, rel=1e-13, abs=1e-15)


@pytest.mark.parametrize(("interface", "exact"), WAYS)
@pytest.mark.parametrize("on", [0.0, 1.0])
def test_discrete_states_and_inputs_are_frozen(cache, interface, exact, on):
    plant = Fmu(build_fmu(thermostat()))
    state, inputs = {"temperature": 20.5, "on": on}, {"ambient": 3.0, "set_point": 20.0}
    model = plant.linear_model(state=state, inputs=inputs, interface=interface, exact=exact)
    assert pytest.approx(-0.1, rel=bound(exact)) == model.A
    assert pytest.approx(np.array([[0.1, 0.0]]), rel=bound(exact)) == model.B
    assert model.f == pytest.approx(-0.1 * 17.5 + 3.0 * on, rel=1e-14)
    assert model.states == ("temperature",)


@pytest.mark.parametrize(("interface", "exact"), WAYS)
def test_contact_and_free_flight_are_two_models(cache, interface, exact):
    plant = Fmu(gantry_contact.build(), start={"wall_stiffness": 2e4, "wall_damping": 400.0, "viscous_scale": 0.0})
    m, way = 4.41 + 16.79, {"interface": interface, "exact": exact}
    still = {"velocity": (0.3, 0.4)}  # so fast that the Coulomb friction is saturated
    free = plant.linear_model(state={**still, "position": (0.8, 0.6), "contact": 0.0}, **way)
    pressed = plant.linear_model(state={**still, "position": (0.8, 0.641), "contact": 1.0}, **way)
    assert np.abs(free.A[3]).max() < 1e-6
    assert pressed.A[3] == pytest.approx([0.0, -2e4 / m, 0.0, -400.0 / m], rel=1e-6, abs=1e-6)


def test_renamed_ports_are_those_of_the_block(motor):
    model = Fmu(motor, rename={"voltage": "u", "torque": "tau"}).linear_model(inputs={"u": 3.0})
    assert model.inputs == ("u", "load_torque")
    assert model.outputs[-1] == "tau"
    assert model.u0.tolist() == [3.0, 0.0]


def test_start_values_of_the_block_are_the_operating_point_unless_others_are_given(motor):
    plant = Fmu(motor, start={"speed": 7.0, "resistance": 2.0, "voltage": 1.0})
    model = plant.linear_model(state={"current": 3.0})
    assert model.x0.tolist() == [3.0, 7.0, 0.0]
    assert model.u0.tolist() == [1.0, 0.0]
    assert model.A[0, 0] == pytest.approx(-2.0 / L, rel=1e-14)


# --- what an FMU doesn't have -----------------------------------------------------------------------------------------


def test_it_falls_back_on_what_there_is(motor, tmp_path):
    no_exchange = edited(motor, tmp_path, lambda s: re.sub(r"<ModelExchange[^>]*/>", "", s))
    underived = edited(motor, tmp_path, lambda s: s.replace('providesDirectionalDerivatives="true"', ""))
    neither = edited(no_exchange, tmp_path, lambda s: s.replace('providesDirectionalDerivatives="true"', ""))
    hows = [
        (motor, "directional derivatives in model-exchange"),
        (no_exchange, "directional derivatives in co-simulation"),
        (underived, "differences in model-exchange"),
        (neither, "differences in co-simulation"),
    ]
    for file, how in hows:
        model = Fmu(file).linear_model()
        assert model.how == how
        assert np.abs(got(model) - WANT_MOTOR).max() < bound(how.startswith("dir")) * np.abs(WANT_MOTOR).max()
    with pytest.raises(
        FmuError,
        match=r"^fmu: it can't be linearized in this way \(interface=None, exact=True\): it has no model exchange, directional derivatives not there and not in co-simulation",
    ):
        Fmu(neither).linear_model(exact=True)


def test_states_with_guessed_start_values_are_set_in_model_exchange_alone(motor, tmp_path):
    def guess(text):
        return re.sub(r'(name="(?:current|speed)"[^>]*)initial="exact"', r'\1initial="approx"', text)

    plant = Fmu(edited(motor, tmp_path, guess))
    for exact in (True, False):
        model = plant.linear_model(state={"current": 2.0, "angle": 4.0}, exact=exact)
        assert model.x0.tolist() == [2.0, 0.0, 4.0]
        assert model.f[0] == pytest.approx(-R / L * 2.0, rel=1e-14)
        assert np.abs(got(model) - WANT_MOTOR).max() < bound(exact) * np.abs(WANT_MOTOR).max()
    with pytest.raises(FmuError, match=r"interface='co_simulation'.*states that cannot be set at the start"):
        plant.linear_model(interface="co_simulation")
    with pytest.raises(FmuError, match=r"^fmu\.current: its state has no exact start value"):
        plant.step_difference(1e-3)


def test_states_that_are_computed_at_the_start_are_set_in_model_exchange(motor, tmp_path):
    def compute(text):  # as of Dymola's FMUs, whose states start from parameters
        return re.sub(
            r'(name="(?:current|speed)"[^>]*)initial="exact"([^>]*?) start="[^"]*"', r'\1initial="calculated"\2', text
        )

    plant = Fmu(edited(motor, tmp_path, compute))
    assert plant.description.find("current").start is None
    for exact in (True, False):
        model = plant.linear_model(state={"current": 2.0, "speed": 3.0, "angle": 4.0}, exact=exact)
        assert model.x0.tolist() == [2.0, 3.0, 4.0]
        assert np.abs(got(model) - WANT_MOTOR).max() < bound(exact) * np.abs(WANT_MOTOR).max()
    with pytest.raises(ParameterError, match=r"fmu.current: found 'much'; expected finite numbers of shape \(\)"):
        plant.linear_model(state={"current": "much"})


def test_an_fmu_that_hides_its_states_has_no_linear_model_but_a_step(motor, tmp_path):
    hidden = edited(motor, tmp_path, lambda s: re.sub(r"<ContinuousStateDerivative[^>]*/>", "", s))
    plant = Fmu(hidden)
    with pytest.raises(FmuError, match=r"^fmu: its model structure lists no derivatives .* Use step_difference\(\)"):
        plant.linear_model()
    step = plant.step_difference(1e-3)
    E = expm(np.block([[A_MOTOR, B_MOTOR], [np.zeros((2, 5))]]) * 1e-3)
    assert step.A.shape == (0, 0)
    assert np.abs(step.D[:3] - E[:3, 3:]).max() < 1e-6 * np.abs(E).max()


@pytest.mark.parametrize("fmi", [2, 3])
def test_states_that_initialization_computes_again_are_set_in_model_exchange_or_refused(fmi, tmp_path):
    """As in an FMU of OpenModelica, whose description calls them exact; of dx/dt = u − x³, A = −3 x²."""
    deaf = ("else (r[i] < 10 ? c->x", "else if (r[i] >= 10) (r[i] < 10 ? c->x")
    plant = Fmu(closed_form_fmu(tmp_path, fmi, "dx[0] = u[0] - x[0]*x[0]*x[0]; y[0] = x[0];", changes=[deaf]), name="m")
    model = plant.linear_model(state={"x1": 2.0})
    assert (model.x0.tolist(), model.f.tolist()) == ([2.0], [-8.0])
    assert pytest.approx(np.array([[-12.0]]), rel=1e-7) == model.A
    ways = [
        (partial(plant.linear_model, interface="co_simulation"), "interface='model_exchange'"),
        (partial(plant.step_difference, 1e-3), "interface='model_exchange'"),
    ]
    for linearize, text in ways:
        with pytest.raises(
            FmuError, match=rf"^m\.x1: its state was set to 2\.0, but is \[0\.0\] when the FMU .*{text}"
        ):
            linearize(state={"x1": 2.0})
        assert linearize(state={"x1": 1e-17}).x0.tolist() == [0.0]


def test_wrong_points_are_refused(motor):
    plant = Fmu(motor, name="m")
    for given, error, text in (
        ({"state": {"curent": 1.0}}, UnknownNameError, r"^m\.state: found 'curent'.*current"),
        ({"inputs": {"speed": 1.0}}, UnknownNameError, r"^m\.inputs: found 'speed'"),
        (
            {"state": [1.0]},
            ParameterError,
            r"^m\.state: found 1 numbers; expected 3, the elements of current, speed, angle",
        ),
        ({"state": {"current": np.nan}}, ParameterError, r"^m\.start\.current: found nan; expected finite"),
        ({"t": np.inf}, ParameterError, r"^m\.t: found inf"),
        ({"interface": "me"}, ParameterError, r"^m\.interface: found 'me'"),
    ):
        with pytest.raises(error, match=text):
            plant.linear_model(**given)
    for h in (0.0, -1.0, np.nan):
        with pytest.raises(ParameterError, match=r"^m\.h: found"):
            plant.step_difference(h)


# --- of a step --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("saves", [True, False])
def test_a_step_of_the_mass_spring_damper_is_its_matrix_exponential(msd, tmp_path, saves):
    file = msd if saves else edited(msd, tmp_path, lambda s: s.replace('canGetAndSetFMUState="true"', ""))
    h = 0.05
    E = expm(np.block([[A_MSD, B_MSD], [np.zeros((1, 3))]]) * h)
    model = Fmu(file).step_difference(h, t=2.0, state=[0.2, 1.0], inputs=[-3.0])
    assert np.abs(np.hstack([model.A, model.B]) - E[:2]).max() < 1e-8  # of the differences; RK4 with 1 ms adds 1e-11
    assert model.f == pytest.approx(E[:2] @ [0.2, 1.0, -3.0], rel=1e-9)
    C = np.vstack([np.eye(2), A_MSD[1]])
    assert np.abs(model.C - C @ model.A).max() < 1e-7  # y is that at the end of the step
    assert np.abs(model.D - C @ model.B - [[0], [0], [1 / M]]).max() < 1e-7
    assert (model.t, model.h, model.how) == (2.0, h, "differences of steps")


def test_a_step_of_the_motor_is_its_matrix_exponential(motor):
    h = 1e-3
    E = expm(np.block([[A_MOTOR, B_MOTOR], [np.zeros((2, 5))]]) * h)
    model = Fmu(motor, start={"internal_step": 1e-5}).step_difference(h, state=[1.0, 5.0, 2.0], inputs=[12.0, 0.01])
    assert np.abs(np.hstack([model.A, model.B]) - E[:3]).max() < 1e-9 * np.abs(E).max()
    assert np.all(np.abs(np.hstack([model.A, model.B]) - E[:3]) < model.uncertainty[:3] + 1e-11 * np.abs(E).max())


def test_a_step_with_strong_friction_is_the_variational_equation_s(cache):
    # dv/dt = (u - F_c tanh(v/w) - c_v v)/m along y; S' = -(F_c/w sech^2 + c_v)/m S, by SciPy
    m, f_c, c_v, w, h, u = 36.87, 65.42, 175.93, 0.01, 1e-2, 30.0

    def rhs(t, z):
        slope = (f_c / w / np.cosh(z[0] / w) ** 2 + c_v) / m
        return [(u - f_c * np.tanh(z[0] / w) - c_v * z[0]) / m, -slope * z[1], z[1], 1 / m - slope * z[3]]

    end = solve_ivp(rhs, (0, h), [0.004, 1.0, 0.0, 0.0], "DOP853", rtol=1e-12, atol=1e-15).y[:, -1]
    plant = Fmu(gantry.build(), start={"internal_step": 5e-5})
    model = plant.step_difference(h, state={"velocity": (0.004, 0.0)}, inputs={"motor_force": (u, 43.2621)})
    assert model.A[2, 2] == pytest.approx(end[1], rel=1e-6)
    assert model.A[0, 2] == pytest.approx(end[2], rel=1e-6)
    assert model.B[2, 0] == pytest.approx(end[3], rel=1e-6)
    assert model.A[2, 3] == model.A[3, 2] == 0.0


def test_an_impact_within_the_step_is_in_it(cache):
    # from h0, v0 to the floor and up again: v+ = e sqrt(v0^2 + 2 g h0) at tau = (v0 + sqrt(v0^2 + 2 g h0))/g
    g, e, T = 9.81, 0.7, 0.2

    def flow(h0, v0):
        v = np.sqrt(v0**2 + 2 * g * h0)
        s = T - (v0 + v) / g
        return np.array([e * v * s - g * s**2 / 2, e * v - g * s])

    h0, v0, d = 0.1, -0.3, 1e-20
    want = np.column_stack([flow(h0 + 1j * d, v0).imag, flow(h0, v0 + 1j * d).imag]) / d  # complex step: exact
    model = Fmu(bouncing_ball.build()).step_difference(T, state={"height": h0, "velocity": v0})
    assert model.f == pytest.approx(flow(h0, v0), rel=1e-11)
    assert np.abs(model.A - want).max() < 1e-6 * np.abs(want).max()
    assert model.C[2:].tolist() == [[0.0, 0.0]] * 2  # the number of bounces does not change
    assert model.y0[2:].tolist() == [1.0, 0.0]


def test_a_stiff_step_by_an_adaptive_solver_is_within_its_own_uncertainty(cache):
    plant = Fmu(gantry_stiction.build(), start={"tolerance": 1e-10})
    inputs = {"motor_force": (40.0, 60.0)}
    model = plant.step_difference(1e-3, state={"velocity": (0.002, 0.001)}, inputs=inputs)
    fine = plant.step_difference(1e-3, state={"velocity": (0.002, 0.001)}, inputs=inputs, relative_step=2e-5)
    assert np.all(np.abs(model.A - fine.A) <= model.uncertainty[:6, :6] + fine.uncertainty[:6, :6])
    assert np.abs(model.A - fine.A).max() < 1e-4 * np.abs(fine.A).max()


@pytest.mark.slow
def test_a_start_on_a_bound_is_moved_to_one_side(cache):
    t, x, u, p = (ca.SX.sym(c, n) for c, n in (("t", 1), ("x", 1), ("u", 1), ("p", 0)))
    spec = ModelSpec(
        "tank",
        "",
        (Variable("q", "input", minimum=0.0, maximum=1.0),),
        (),
        (),
        (Variable("level", "output", start=1.0, state=True, minimum=0.0),),
        ca.Function("f", [t, x, u, p], [u**2 - ca.sqrt(x + 1.0)]),
        ca.Function("g", [t, x, u, p], [ca.SX(0, 1)]),
    )
    plant = Fmu(build_fmu(spec))
    for q in (0.0, 1.0):
        for exact in (True, False):
            model = plant.linear_model(state={"level": 0.0}, inputs={"q": q}, exact=exact, interface="co_simulation")
            assert pytest.approx(-0.5, rel=bound(exact)) == model.A
            assert pytest.approx(2 * q, rel=bound(exact), abs=bound(exact)) == model.B


# --- at the present point of a run ------------------------------------------------------------------------------------


def test_the_operating_point_of_a_run_is_that_of_its_linear_model(cache):
    plant = Fmu(gantry.build(), name="plant")
    with plant.instantiate(["motor_force"], None) as run:
        u, y = np.array([60.0, 100.0]), np.zeros(6)
        run.bind(u, y)
        run.begin()
        for k in range(50):
            run.step(k * 1e-3, 1e-3)
        point = run.operating_point()
        before = y.copy()
        column = run.directional_derivative(["der(velocity)", "acceleration"], ["velocity"], [1.0, 0.0])
        state = run.save()
        run.step(0.05, 1e-3)
        after = y.copy()
        run.restore(state)
        assert np.array_equal(y, before)
    assert point["t"] == pytest.approx(0.05, rel=1e-14)
    assert np.array_equal(point["state"]["velocity"], before[2:4])
    assert point["inputs"]["motor_force"].tolist() == [60.0, 100.0]
    assert set(point["inputs"]) == {"motor_force", "external_force"}
    model = plant.linear_model(**point)
    assert np.array_equal(column[:2], model.A[2:, 2])
    assert np.array_equal(column[2:], model.A[2:, 2])
    assert np.array_equal(model.y0, before)
    step = plant.step_difference(1e-3, **point)
    assert step.y0 == pytest.approx(after, rel=1e-12)  # nothing of this plant is hidden


def test_a_ball_that_rests_keeps_resting_at_its_operating_point(cache):
    plant = Fmu(bouncing_ball.build())
    with plant.instantiate([], None) as run:
        run.bind(np.zeros(0), np.zeros(4))
        run.begin()
        run.step(0.0, 3.0)
        point = run.operating_point()
    assert point["state"] == {"height": 0.0, "velocity": 0.0, "bounces": 18.0, "resting": 1.0}
    assert plant.linear_model(**point).f.tolist() == [0.0, 0.0]


def test_directional_derivatives_are_refused_by_name(motor, tmp_path):
    underived = edited(motor, tmp_path, lambda s: s.replace('providesDirectionalDerivatives="true"', ""))
    with Fmu(underived, name="m").instantiate([], None) as run:
        run.begin()
        with pytest.raises(
            FmuError, match=r"^m: it has no directional derivatives: providesDirectionalDerivatives is false"
        ):
            run.directional_derivative(["torque"], ["current"], [1.0])
    with Fmu(motor, name="m").instantiate([], None) as run:
        run.begin()
        assert run.directional_derivative(["torque", "der(speed)"], ["current"], 2.0) == pytest.approx(
            [0.1, 2 * KM / J]
        )
        assert run.directional_derivative([], ["current"], [1.0]).size == 0
        with pytest.raises(UnknownNameError, match=r"^m: it has no variable 'torqe'.*torque"):
            run.directional_derivative(["torqe"], ["current"], [1.0])
        with pytest.raises(
            FmuRuntimeError, match=r"^m, t = 0 s: a directional derivative failed .*torque is no known in Step Mode"
        ):
            run.directional_derivative(["torque"], ["current", "torque"], [1.0, 1.0])


# --- the page ---------------------------------------------------------------------------------------------------------


def test_the_page_on_fmus_runs(cache):
    text = (Path(__file__).parents[3] / "docs" / "reference" / "fmus.md").read_text(encoding="utf-8")
    scope = {}
    for snippet in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        exec(snippet, scope)
    assert scope["step"].h == 1e-3
