"""Linear models of diagrams with FMUs, against closed forms; the loops of Fig. 3 and the paper's claims about them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import (
    Constant,
    DiscreteStateSpace,
    Ellipse,
    Function,
    Gain,
    Integrator,
    OptionError,
    Reference,
    Sum,
)
from loopwright.diagrams import Channel, Diagram, Rig, fig3, subsystem
from loopwright.fmus import Fmu, FmuError, dc_motor, gantry, mass_spring_damper
from support.contact import parameters

T = 1e-3
WAYS = [("model_exchange", True), ("co_simulation", True), ("model_exchange", False), ("co_simulation", False)]
M, D, K = 1.0, 1.0, 100.0
A_MSD, B_MSD = np.array([[0, 1], [-K / M, -D / M]]), np.array([[0], [1 / M]])
R, L, KM, J, F = 1.2, 2e-3, 0.05, 2e-5, 1e-5
A_MOTOR = np.array([[-R / L, -KM / L, 0], [KM / J, -F / J, 0], [0, 1, 0]])
B_MOTOR = np.array([[1 / L, 0], [0, -1 / J], [0, 0]])


def close(got, want, bound):
    assert np.shape(got) == np.shape(want)
    assert np.max(np.abs(got - want), initial=0.0) <= bound * np.max(np.abs(want), initial=0.0)


def held(A, B, h=T):
    n, m = B.shape
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * h)
    return both[:n, :n], both[:n, n:]


def forced(monkeypatch, interface, exact):
    """Let every FMU be linearized in one way."""
    free = Fmu.linear_model
    monkeypatch.setattr(
        Fmu, "linear_model", lambda self, t=0.0, **given: free(self, t, **given, interface=interface, exact=exact)
    )
    return 1e-9 if exact else 1e-6


def mass(**start):
    return Fmu(mass_spring_damper.build(), start=start, name="mass")


def around_the_mass(plant):
    """A sampled controller that feeds the acceleration back as well: u = 0.3 a − 20 s + c, c⁺ = 0.9 c − s."""

    @subsystem(sample_time=T)
    def controller(s, a):
        c = DiscreteStateSpace(A=[[0.9]], B=[[-1.0]], C=[[1.0]], D=[[-20.0]], name="c")
        pi = c(Function(lambda s: np.stack([s]), name="vector")(s))
        return Function(lambda p, a: p[0] + 0.3 * a, name="sum")(pi, a)

    return Diagram("d", plant(force=controller(plant.position, plant.acceleration).named("u")))


def model_around_the_mass():
    """States c, s, v and the force that acts until the tick; from what is added to the force, to the force."""
    Phi, Gam = held(A_MSD, B_MSD)
    u = np.array([[1.0, -20 + 0.3 * A_MSD[1, 0], 0.3 * A_MSD[1, 1], 0.3 / M]])
    A = np.zeros((4, 4))
    A[0, :2] = 0.9, -1
    A[1:3, 1:3] = Phi
    A[1:3] += Gam @ u
    A[3] = u
    return A, np.vstack([[[0]], Gam, [[1]]]), u, np.zeros((1, 1))


@pytest.mark.parametrize(("interface", "exact"), WAYS)
@pytest.mark.drawn(1)
def test_a_sampled_loop_around_an_fmu_at_rest(monkeypatch, interface, exact):
    bound = forced(monkeypatch, interface, exact)
    lin = around_the_mass(mass(position=0.0)).linearize(inputs="u", outputs="u")
    assert lin.states == ("controller.c.x[1]", "mass.position", "mass.velocity", "held(mass.force)")
    for got, want in zip((lin.A, lin.B, lin.C, lin.D), model_around_the_mass(), strict=True):
        assert np.max(np.abs(got - want)) <= bound * max(1.0, np.max(np.abs(want)))
    kind = "directional derivatives" if exact else "differences"
    assert lin.how == {"mass": f"{kind} in {interface.replace('_', '-')}, held over a step by a matrix exponential"}
    assert (lin.derivations["mass"].is_exact, lin.derivations["mass"].held) == (exact, True)
    assert lin.uncertainty == 0 if exact else lin.uncertainty < 1e-11
    assert lin.is_equilibrium


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.0, 0.05])
def test_on_the_move_the_step_itself_is_differenced(at):
    lin = around_the_mass(mass()).linearize(at, inputs="u", outputs="u")
    assert lin.how == {"mass": "differences of steps"}
    for got, want in zip((lin.A, lin.B, lin.C, lin.D), model_around_the_mass(), strict=True):
        assert np.max(np.abs(got - want)) <= 1e-6 * max(1.0, np.max(np.abs(want)))
    assert 0 < lin.uncertainty < 1e-6
    held_too = around_the_mass(mass()).linearize(at, plants="equations")
    assert held_too.affine[1:3] == pytest.approx(lin.affine[1:3], rel=1e-8, abs=1e-12)
    with around_the_mass(mass()).simulation() as run:
        if at:
            run.advance(at)
        before = run.save().w.copy()
        run.advance(T)
        assert run.save().w[:2] - before[:2] == pytest.approx(lin.affine[1:3], rel=1e-8)


@pytest.mark.slow
def test_the_loop_of_an_fmu_is_closed_again_wherever_it_is_cut():
    lin = around_the_mass(mass(position=0.0)).linearize()
    want = np.poly(lin.A)
    for wires in (("u",), ("mass.position",), ("mass.acceleration",), ("mass.acceleration", "mass.position")):
        cut, S = lin.loop(*wires), lin.sensitivity(*wires)
        eye = np.eye(len(wires))
        got = np.poly(cut.A - cut.B @ np.linalg.solve(eye + cut.D, cut.C))
        n = min(len(got), len(want))  # an input held for a feedthrough that is cut is no state
        assert np.abs(got[:n] - want[:n]).max() < 1e-11
        for w in (1.0, 30.0, 1000.0):
            z = np.exp(1j * w * T)
            assert np.abs(S(z) - np.linalg.inv(eye + cut(z))).max() < 1e-12 * np.abs(S(z)).max()


@pytest.mark.parametrize(("interface", "exact"), WAYS)
@pytest.mark.drawn(2)
def test_a_continuous_diagram_with_a_feedthrough_back_to_its_own_fmu(monkeypatch, interface, exact):
    """F = −0.5 a − 3 ∫s: the outputs depend on the inputs, which depend on the outputs."""
    bound = forced(monkeypatch, interface, exact)
    plant, memory = mass(), Integrator(name="memory")
    total = Function(lambda a, i: -0.5 * a - 3 * i, name="total")(plant.acceleration, memory.y).named("u")
    lin = Diagram("d", plant(force=total), memory(plant.position)).linearize(inputs="u", outputs="u")
    # m a = F + d − D v − K s, F = −0.5 a − 3 i
    a = np.array([-3, -K, -D]) / (M + 0.5)
    A = np.array([[0, 1, 0], [0, 0, 1], a])
    assert lin.dt == 0.0
    assert lin.states == ("memory.y", "mass.position", "mass.velocity")
    close(lin.A, A, bound)
    close(lin.B, np.array([[0], [0], [1 / (M + 0.5)]]), bound)
    close(lin.C, -0.5 * a[None] - np.array([[3, 0, 0]]), bound)
    close(lin.D, np.array([[-0.5 / (M + 0.5)]]), bound)


@pytest.mark.parametrize("h", [1e-3, 0.02])
def test_continuous_blocks_see_an_fmu_by_steps(h):
    """ẋ = −4 x + s with s held, F = −0.5 a − 3 x, by what the acceleration was at the end of the last step."""
    plant, lag = mass(position=0.0), Integrator(name="lag")
    total = Function(lambda a, i: -0.5 * a - 3 * i, name="total")(plant.acceleration, lag.y).named("u")
    rate = Function(lambda x, s: s - 4 * x, name="rate")(lag.y, plant.position)
    lin = Diagram("d", plant(force=total), lag(rate)).linearize(step=h, inputs="u", outputs="u")
    assert lin.states == ("lag.y", "mass.position", "mass.velocity", "held(mass.force)")
    Phi, Gam = held(A_MSD, B_MSD, h)
    u = np.array([[-3, 0.5 * K / M, 0.5 * D / M, -0.5 / M]])
    A = np.zeros((4, 4))
    A[0, :2] = np.exp(-4 * h), (1 - np.exp(-4 * h)) / 4
    A[1:3, 1:3] = Phi
    A[1:3] += Gam @ u
    A[3] = u
    close(lin.A, A, 1e-10)
    close(lin.B, np.vstack([[[0]], Gam, [[1]]]), 1e-10)
    close(lin.C, u, 1e-10)


def test_an_ideal_controller_around_an_fmu_is_continuous():
    plant = mass(position=0.0)

    @subsystem(sample_time=T)
    def controller(s, v):
        return Function(lambda s, v: -7 * s - 2 * v)(s, v)

    diagram = Diagram("d", plant(force=controller(plant.position, plant.velocity).named("u")))
    lin = diagram.continuous().linearize()
    assert lin.dt == 0.0
    close(lin.A, np.array([[0, 1], [-(K + 7) / M, -(D + 2) / M]]), 1e-9)
    L = lin.loop("u")
    assert L(10j)[()] == pytest.approx((7 + 2 * 10j) / (-M * 100 + D * 10j + K), rel=1e-12)
    with pytest.raises(OptionError, match=r"to run to t = 0\.1 s the FMU needs a communication step"):
        diagram.continuous().linearize(0.1)
    point = diagram.continuous().operating_point(0.1, step=T)
    close(diagram.continuous().linearize(point).A, lin.A, 1e-9)
    with pytest.raises(OptionError, match=r'found plants="step" for a continuous model'):
        diagram.continuous().linearize(plants="step")


@pytest.mark.parametrize("plants", ["equations", "step"])
def test_several_fmus_and_an_input_that_is_not_wired(plants):
    """The motor's torque pulls the mass, whose position comes back as a voltage; the load torque stays as it is."""
    motor = Fmu(dc_motor.build(), start={"load_torque": 0.0}, name="motor")
    spring = mass(position=0.0)
    pull = Gain(gain=40.0, name="gear")(motor.torque).named("pull")
    back = Gain(gain=-5.0, name="back")(spring.position)
    diagram = Diagram("d", spring(force=pull), motor(voltage=back.named("u")))
    A = np.zeros((5, 5))
    A[:2, :2], A[2:, 2:] = A_MSD, A_MOTOR
    A[1, 2], A[2, 0] = 40 * KM / M, -5 / L
    lin = diagram.linearize()
    assert [s.split(".")[0] for s in lin.states] == ["mass"] * 2 + ["motor"] * 3
    close(lin.A, A, 1e-9)
    # at steps each gets what the other put out at the last communication point
    (P1, G1), (P2, G2) = held(A_MSD, B_MSD, 1e-4), held(A_MOTOR, B_MOTOR, 1e-4)
    A = np.zeros((5, 5))
    A[:2, :2], A[2:, 2:] = P1, P2
    A[:2, [2]], A[2:, [0]] = 40 * KM * G1, -5 * G2[:, :1]
    lin = diagram.linearize(step=1e-4, plants=plants, inputs="u", outputs="pull")
    assert lin.dt == 1e-4
    close(lin.A, A, 1e-9 if plants == "equations" else 1e-6)
    close(lin.B[:, 0], np.concatenate([[0, 0], G2[:, 0]]), 1e-9 if plants == "equations" else 1e-6)
    close(lin.C, np.array([[0, 0, 40 * KM, 0, 0]]), 1e-9)


def test_a_slow_box_around_an_fmu_that_is_stepped_at_every_tick():
    plant = mass(position=0.0)

    @subsystem(sample_time=3 * T)
    def slow(s):
        return Gain(gain=-30.0)(s)

    @subsystem(sample_time=T)
    def fast(v):
        return Gain(gain=-2.0)(v)

    diagram = Diagram("d", plant(force=Sum(signs="++")(slow(plant.position).named("u"), fast(plant.velocity))))
    lin = diagram.linearize(outputs="u", inputs="u")
    Phi, Gam = held(A_MSD, B_MSD)
    inner = Phi + Gam @ np.array([[0, -2.0]])
    B = (np.linalg.matrix_power(inner, 2) + inner + np.eye(2)) @ Gam
    close(lin.A, np.linalg.matrix_power(inner, 3) + B @ np.array([[-30.0, 0]]), 1e-9)
    close(lin.B, B, 1e-9)
    assert lin.dt == pytest.approx(3 * T)


def test_outputs_on_the_move_are_those_at_the_tick_not_after_the_step():
    """The acceleration follows the friction's slope, which changes within a step of 20 ms."""
    h, model = 0.02, gantry.Gantry(gravity=0.0)
    start = {"external_force": (0.0, 0.0), "velocity": (0.02, 0.03), "gravity": 0.0}
    plant = Fmu(gantry.build(), start=start, name="plant")

    @subsystem(sample_time=h)
    def controller(a):
        return Function(lambda a: -0.5 * a + np.array([20.0, 10.0]))(a)

    diagram = Diagram("d", plant(motor_force=controller(plant.acceleration).named("u")))
    lin = diagram.linearize(h, inputs="u", outputs="u")
    m = np.array(model.mass)

    def acceleration(v, u):
        friction = model.coulomb_friction * np.tanh(v / model.friction_width) + model.viscous_friction * v
        return (u - friction) / m

    def go(state, d):
        v, before = state[:2], state[2:]
        u = -0.5 * acceleration(v, before) + np.array([20.0, 10.0])
        f = lambda t, v: acceleration(v, u + d)  # noqa: E731
        end = solve_ivp(f, (0, h), v, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        return np.concatenate([end, u + d, u])

    point = lin.point.plants["plant"]
    s0 = np.concatenate([point["state"]["velocity"], point["inputs"]["motor_force"]])

    def moved(e):
        return go(s0 + e[:4], e[4:]) - go(s0 - e[:4], -e[4:])

    d = 2e-5
    J = np.array([(8 * moved(d * e) - moved(2 * d * e)) / (12 * d) for e in np.eye(6)]).T
    order = [next(k for k, s in enumerate(lin.states) if s.startswith(n)) for n in ("plant.velocity", "held(")]
    order = [i + k for i in order for k in (0, 1)]
    assert lin.how["plant"] == "differences of steps"
    close(lin.A[np.ix_(order, order)], J[:4, :4], 1e-6)
    close(lin.C[:, order], J[4:, :4], 1e-6)
    close(lin.B[order], J[:4, 4:], 1e-6)


def test_an_fmu_that_allows_neither_says_so(monkeypatch):
    def refuse(self, *given, **more):
        raise FmuError("it can't be linearized in this way: no states.", block=self.label)

    monkeypatch.setattr(Fmu, "linear_model", refuse)
    diagram = around_the_mass(mass(position=0.0))
    with pytest.raises(FmuError, match=r"^mass: it can't be linearized in this way"):
        diagram.linearize(plants="equations")
    stepped = diagram.linearize(inputs="u", outputs="u")  # the step alone is enough
    for got, want in zip((stepped.A, stepped.B, stepped.C), model_around_the_mass(), strict=False):
        close(got, want, 1e-6)


# --- Fig. 3 ----------------------------------------------------------------------------------------------------------------

PATH = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
FREE = gantry.Gantry(coulomb_scale=0.0, viscous_scale=0.0)


def at_rest(theta=0.0, offset=0.0, *, model=FREE, plant=FREE, **rig):
    """Fig. 3 without admittance, at rest at a point of the path, beside it by an offset."""
    angle = 2 * np.pi * theta
    point = np.array([0.5 + 0.3 * np.cos(angle), 0.5 + 0.15 * np.sin(angle)])
    normal = frame(theta)[:, 1]

    def diagram(eta):
        return fig3(
            Fmu(gantry.build(), start=parameters(plant) | {"position": point + offset * normal}, name="plant"),
            PATH,
            Channel(reference=Reference(value=eta)),
            Channel(reference=Reference(value=offset)),
            model=model,
            rig=Rig(**rig),
        )

    eta = diagram(0.0).operating_point(0.0).values["controller.transverse_transform.eta"][0]
    return diagram(float(eta))


PLACES = [(0.0, 0.0), (0.07, 0.0), (0.2, 0.03), (0.31, -0.04), (0.5, 0.02), (0.83, -0.02)]


def phase_margin(L):
    def gain(w):
        return abs(L(np.exp(1j * w * T))[()]) - 1

    w = brentq(gain, 20.0, 1000.0, xtol=1e-13)
    return np.degrees(np.angle(L(np.exp(1j * w * T))[()])) % 360 - 180


def test_the_frictionless_loops_at_rest_have_the_known_margins():
    lin = at_rest().linearize()
    assert lin.is_equilibrium
    assert lin.point.residual < 1e-12
    assert phase_margin(lin.loop("v_par")) == pytest.approx(69.56012827, abs=1e-7)
    assert phase_margin(lin.loop("v_perp")) == pytest.approx(67.88699231, abs=1e-7)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("theta", "offset"), PLACES)
def test_with_matched_parameters_poles_are_those_asked_for_at_every_point_and_offset(theta, offset):
    ideal = at_rest(theta, offset).continuous().linearize()
    want = np.poly([-20.0] * 3 + [-40.0] * 3)
    close(np.poly(ideal.A) / want, np.ones(7), 1e-9)
    lin = at_rest(theta, offset).linearize()
    base = at_rest().linearize()
    keep = [[i for i, s in enumerate(m.states) if s not in m.memory] for m in (lin, base)]
    got, same = (np.poly(m.A[np.ix_(k, k)]) for m, k in zip((lin, base), keep, strict=True))
    assert np.abs(got - same).max() < 1e-9 * np.abs(same).max()
    assert lin.memory == ("controller.path_projection.foot",)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("theta", "offset"), PLACES)
def test_with_matched_parameters_the_directions_are_decoupled(theta, offset):
    L = at_rest(theta, offset).linearize().loop("v_par", "v_perp")
    for w in np.geomspace(1.0, 3000.0, 20):
        response = L(np.exp(1j * w * T))
        assert abs(response[0, 1]) < 1e-9 * abs(response[1, 1])
        assert abs(response[1, 0]) < 1e-9 * abs(response[0, 0])


def frame(theta):
    """Tangent and normal of the path, as columns."""
    angle = 2 * np.pi * theta
    tangent = np.array([-0.3 * np.sin(angle), 0.15 * np.cos(angle)])
    tangent /= np.hypot(*tangent)
    return np.column_stack([tangent, [-tangent[1], tangent[0]]])


def asked(s):
    """a2 s² + a1 s + a0 of both directions: 3 p, 3 p², p³."""
    return np.array([60 * s**2 + 1200 * s + 8000, 120 * s**2 + 4800 * s + 64000])


@pytest.mark.slow
@pytest.mark.parametrize(("theta", "worst"), [(0.0, 0.0), (0.07, 0.378)])
def test_a_mass_mismatch_couples_the_directions_and_moves_the_poles(theta, worst):
    """With plant masses m (1 + e) each double integrator is G / s², G = Nᵀ diag(1 / (1 + e)) N in path coordinates."""
    e = np.array([0.1, 0.0])
    diagram = at_rest(theta, plant=FREE.replace(equivalent_mass=FREE.equivalent_mass + e * FREE.mass))
    N = frame(theta)
    G = N.T @ np.diag(1 / (1 + e)) @ N
    ideal = diagram.continuous().linearize()
    L, sampled = (m.loop("v_par", "v_perp") for m in (ideal, diagram.linearize()))
    for w in (1.0, 10.0, 100.0):
        s = 1j * w
        close(L(s), np.diag(asked(s)) @ G / s**3, 1e-9)
    r = sampled(np.exp(1j * T))
    assert abs(r[1, 0] / r[0, 0]) == pytest.approx(worst, abs=1e-3)  # a tenth of one mass: 38 % at 1 rad/s
    s = 7.0 + 3.0j
    want = np.linalg.det(s**3 * np.eye(2) + np.diag(asked(s)) @ G)
    assert np.prod(s - ideal.poles) == pytest.approx(want, rel=1e-9)
    assert np.abs(np.poly(ideal.poles) / np.poly([-20.0] * 3 + [-40.0] * 3) - 1).max() > 0.02


def test_friction_that_the_controller_does_not_know_couples_and_damps():
    """At rest its slope is F_c / w + c_v of each axis: the double integrators become 1 / (s (s + slope / m))."""
    theta = 0.07
    rough = FREE.replace(coulomb_scale=1.0, viscous_scale=1.0)
    slope = (rough.coulomb_friction / rough.friction_width + rough.viscous_friction) / rough.mass
    poles = at_rest(theta, plant=rough).continuous().linearize().poles
    N, s = frame(theta), 7.0 + 3.0j
    want = np.linalg.det(s**3 * np.eye(2) + s**2 * N.T @ np.diag(slope) @ N + np.diag(asked(s)))
    assert np.prod(s - poles) == pytest.approx(want, rel=1e-8)
    assert slope == pytest.approx([182.2, 180.7], abs=0.1)
    assert np.abs(poles).max() > 180  # against 40


@pytest.mark.slow
def test_the_start_has_the_tool_as_every_later_tick():
    diagram = at_rest(tool_mass=2.0)
    first, later = diagram.linearize(), diagram.linearize(T)
    assert first.notes == later.notes == ()
    assert pytest.approx(later.A, abs=1e-9) == first.A
    assert {*at_rest().linearize().states} < {*first.states}  # the tool feels the force that was held
    rough = at_rest(encoder=1e-5).linearize(T, stairs="zero")
    assert "sensors.encoder.measured_position follows 'position' in steps only: it linearizes to zero" in rough.notes


def test_a_constant_may_drive_the_fmu():
    plant = mass(position=0.0)
    assert Diagram("d", plant(force=Constant(value=0.0))).linearize(step=T).dt == T


# --- how far an operating point is from rest --------------------------------------------------------------------------


def driven_motor(**start):
    motor = Fmu(dc_motor.build(), start=start, name="motor")
    return Diagram("driven", motor(voltage=Constant(value=1.0), load_torque=0.0))


def test_the_states_of_an_fmu_count_in_the_residual():
    point = driven_motor().operating_point(0.0, step=T)
    assert point.residual == pytest.approx(1.0 / L, rel=1e-12)  # di/dt = V/L from rest
    assert point.largest == "motor.current"


def test_the_residual_counts_a_step_where_an_fmu_tells_no_rates(monkeypatch):
    def refuse(self, **given):
        raise FmuError("no", block="motor")

    monkeypatch.setattr(Fmu, "linear_model", refuse)
    point = driven_motor().operating_point(0.0, step=T)
    assert point.residual == pytest.approx(held(A_MOTOR, B_MOTOR)[1][:, 0].max(), rel=1e-6)


def test_at_rest_the_residual_of_an_fmu_is_zero():
    diagram = Diagram("rest", Fmu(dc_motor.build(), name="motor")(voltage=Constant(value=0.0), load_torque=0.0))
    assert diagram.operating_point(0.0, step=T).residual == 0.0
