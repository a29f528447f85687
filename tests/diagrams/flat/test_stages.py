"""Staged schedules: blocks that are evaluated from outside split a diagram's functions, and change none of them."""

import pickle

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Constant,
    DiscreteStateSpace,
    Event,
    Gain,
    Input,
    Integrator,
    Output,
    ParameterError,
    SimulationError,
    State,
    StateSpace,
    parameter,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.flat.clocks import NONE
from loopwright.diagrams.flat.flat_layout import FlatLayout
from loopwright.diagrams.flat.stages import OpaqueStage, TracedStage
from loopwright.diagrams.flat.total_derivative import Derivative
from loopwright.diagrams.linearization.derivatives import LocalDerivatives
from loopwright.diagrams.linearization.taps import find_signal
from loopwright.diagrams.simulation.workspace import Workspace

RNG = np.random.default_rng(9)
A_P, B_P, C_P = RNG.normal(size=(3, 3)), RNG.normal(size=(3, 2)), RNG.normal(size=(2, 3))
A_Q, B_Q, C_Q, D_Q = RNG.normal(size=(2, 2)), RNG.normal(size=(2, 2)), RNG.normal(size=(2, 2)), RNG.normal(size=(2, 2))
A_R, B_R, C_R, D_R = RNG.normal(size=(2, 2)), RNG.normal(size=(2, 2)), RNG.normal(size=(2, 2)), RNG.normal(size=(2, 2))


class Matrices:
    """A linear block, evaluated from outside."""

    def __init__(self, A, B, C, D, *, slopes=True):
        self.next, self.y, self.slopes, self.asked = (A, B), (C, D), slopes, []

    def evaluate(self, names, t, x, u):
        self.asked.append((names, u.copy()))
        made = {"y": self.y[0] @ x + self.y[1] @ u, "next": self.next[0] @ x + self.next[1] @ u, "guards": np.zeros(0)}
        return np.concatenate([made[name] for name in names])

    def differentiate(self, names, t, x, u):
        if not self.slopes:
            return None
        rows = {"y": np.hstack(self.y), "next": np.hstack(self.next), "guards": np.zeros((0, x.size + u.size))}
        J = np.vstack([rows[name] for name in names])
        return np.hstack([np.zeros((len(J), 1)), J])


class Equations:
    """Any traced block, its equations called from outside."""

    def __init__(self, flat, path):
        self.trace, self.p = flat.checked.traced[path], flat.p[flat.parameters.slices[path]]
        self.functions = {}

    def function(self, names):
        if names not in self.functions:
            trace = self.trace
            if names[0] in ("indicators", "jump"):
                f, wanted = getattr(trace, names[0]), [0]
            else:
                every = [*trace.outputs, "next", "guards"]
                f, wanted = trace.function, [every.index(name) for name in names]
            n_u = [f.numel_in(i) for i in range(f.n_in()) if i > 1 and i != 2 + len(trace.inputs)]
            t, x, u = ca.MX.sym("t"), ca.MX.sym("x", f.numel_in(1)), ca.MX.sym("u", sum(n_u))
            columns = ca.vertsplit(u, [0, *np.cumsum(n_u).tolist()]) if n_u else []
            columns.insert(len(trace.inputs), ca.DM(self.p))
            made = ca.densify(ca.vertcat(*(f.call([t, x, *columns])[i] for i in wanted)))
            J = ca.densify(ca.jacobian(made, ca.vertcat(t, x, u)))
            self.functions[names] = ca.Function("outside", [t, x, u], [made, J])
        return self.functions[names]

    def evaluate(self, names, t, x, u):
        return np.ravel(np.array(self.function(names)(t, x, u)[0]))

    def differentiate(self, names, t, x, u):
        value = self.function(names)(t, x, u)[1]
        return np.array(value).reshape(value.shape)


def space(name, *matrices):
    return StateSpace(**dict(zip("ABCD", matrices, strict=False)), initial_state=1.0, name=name)


class Wave(Block):
    """r = (1, sin 2t)."""

    y = Output(shape=(2,))

    def output(self, t, x, u):
        """Return r."""
        return np.stack([1.0 + 0.0 * t, np.sin(2.0 * t)])


class Watch(Block):
    """Counts how often the first entry of u rises above a level."""

    level: float = parameter(default=0.3, description="level")
    u = Input(shape=(2,))
    above = Event("rising")
    count = State(discrete=True, output=True)

    def indicators(self, t, x, u):
        """Return what is watched."""
        return u.u[0] - self.level

    def jump(self, t, x, u, fired):
        """Count."""
        return x.count + fired.above * (1.0 + 0.5 * u.u[1])


def loop(*more):
    """u = R(s) (r - Q(s) y), y = P(s) u, where P alone has no feedthrough; r = (1, sin 2t)."""
    p, q, r = space("p", A_P, B_P, C_P), space("q", A_Q, B_Q, C_Q, D_Q), space("r", A_R, B_R, C_R, D_R)
    return Diagram("loop", p(r(Wave(name="wave") - q(p.y))), *(made(p.y) for made in more))


class WaveOutside:
    """The wave, evaluated from outside."""

    def evaluate(self, names, t, x, u):
        """Return r."""
        return np.array([1.0, np.sin(2.0 * t)])

    def differentiate(self, names, t, x, u):
        """Return dr/dt."""
        return np.array([[0.0], [2.0 * np.cos(2.0 * t)]])


OUTSIDE = {
    "wave": WaveOutside(),
    "p": Matrices(A_P, B_P, C_P, np.zeros((2, 2))),
    "q": Matrices(A_Q, B_Q, C_Q, D_Q),
    "r": Matrices(A_R, B_R, C_R, D_R),
}
CHOICES = [("p",), ("q",), ("r",), ("p", "r"), ("p", "q", "r"), ("wave",), ("p", "wave")]
choices = pytest.mark.parametrize("paths", CHOICES, ids="+".join)


def closed_loop():
    """dx/dt = A x + B r and the blocks' outputs y = C x + D r, the states in the order p, q, r."""
    yp = np.hstack([C_P, np.zeros((2, 4))])
    yq = np.hstack([D_Q @ C_P, C_Q, np.zeros((2, 2))])
    yr = np.hstack([np.zeros((2, 5)), C_R]) - D_R @ yq
    A = np.vstack([B_P @ yr, B_Q @ yp, -B_R @ yq])
    A[:3, :3] += A_P
    A[3:5, 3:5] += A_Q
    A[5:, 5:] += A_R
    B = np.vstack([B_P @ D_R, np.zeros((2, 2)), B_R])
    return A, B, np.vstack([yp, yq, yr]), np.vstack([np.zeros((4, 2)), D_R])


A, B, C, D = closed_loop()


def instants(flat, count=4):
    """Instants at which functions are compared: t, x, w, p."""
    rng = np.random.default_rng(1)
    for _ in range(count):
        yield rng.uniform(0.0, 3.0), rng.normal(size=flat.width), np.zeros(flat.plant_outputs.total), flat.p


def bound(function, arguments, evaluators):
    """Results of a function through its binding to vectors, evaluated twice; the vectors are written afterwards."""
    vectors = [np.zeros(np.size(v)) for v in arguments]
    made = function.bind(vectors, evaluators=evaluators)
    for vector, value in zip(vectors, arguments, strict=True):
        vector[:] = value
    made.call()
    made.call()
    return made.outputs


# --- the data ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [lambda: experiments.hand_guiding().diagram, lambda: loop(Watch(name="watch"))])
def test_a_diagram_of_traced_blocks_has_one_stage_for_everything(make):
    diagram = make()
    flat = diagram.flatten(None if diagram.has_clock else 1)
    for schedule in (flat.flow, flat.indicators, flat.jump, flat.at_tick(flat.acting(0)), flat.output(("r", "y"))):
        assert [type(stage) for stage in schedule.stages] == [TracedStage]
        assert schedule.width == 0
        assert schedule.function is schedule.stages[0].function
        assert schedule.function.n_in() == len(schedule.arguments)


def test_the_layout_is_pure_data():
    flat = loop(Watch(name="watch")).flatten(1)
    data = pickle.dumps(flat.layout)
    assert b"casadi" not in data
    layout = pickle.loads(data)
    assert type(layout) is FlatLayout
    assert layout.labels == flat.labels
    assert layout.states == flat.states
    assert layout.events == flat.events
    assert np.array_equal(layout.x0, flat.x0)


def test_only_what_later_stages_need_is_carried():
    flat = loop().flatten(1).with_apart("p")
    before, between = flat.flow.stages[0], flat.flow.stages[2]
    assert before.makes == slice(0, 7)  # the wave, states and inputs of p
    assert flat.flow.stages[1].makes == slice(7, 9)  # y of p
    assert between.makes == slice(9, 18)  # rates of q and r, states and inputs of p
    assert flat.flow.stages[3].makes == slice(18, 21)  # rates of p
    assert flat.flow.width == 21


def test_nobody_writes_into_a_flattened_diagram():
    flat = loop().flatten(1)
    for values in (flat.p, flat.x0, flat.continuous):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0
    with pytest.raises(AttributeError, match="cannot assign"):
        flat.p = flat.p.copy()
    assert np.array_equal(flat.pack("p", flat.table.blocks["p"]), flat.p[flat.parameters.slices["p"]], equal_nan=True)


def test_stages_follow_the_order_of_evaluation():
    flat = loop().flatten(1).with_apart("p")
    assert [type(stage) for stage in flat.flow.stages] == [
        TracedStage,
        OpaqueStage,
        TracedStage,
        OpaqueStage,
        TracedStage,
    ]
    assert [stage.names for stage in flat.flow.opaque] == [
        ("y", "guards"),
        ("next",),
    ]  # no feedthrough: rates come last
    evaluator = Matrices(A_P, B_P, C_P, np.zeros((2, 2)))
    flat.flow(*next(instants(flat)), evaluators={"p": evaluator})
    assert not evaluator.asked[0][1].any()  # its inputs are not known yet
    assert evaluator.asked[1][1].all()


# --- values ------------------------------------------------------------------------------------------------------------


@choices
@pytest.mark.parametrize("way", ["call", "bind"])
def test_the_flow_of_a_split_diagram_is_that_of_its_matrices(paths, way):
    flat = loop().flatten(1).with_apart(*paths)
    for at in instants(flat):
        dx = (flat.flow(*at, evaluators=OUTSIDE) if way == "call" else bound(flat.flow, at, OUTSIDE))[0]
        r = np.array([1.0, np.sin(2.0 * at[0])])
        np.testing.assert_allclose(dx, A @ at[1] + B @ r, rtol=1e-13, atol=1e-13)


@choices
def test_the_outputs_of_a_split_diagram_are_those_of_its_matrices(paths):
    flat = loop().flatten(1).with_apart(*paths)
    for at in instants(flat):
        x_next, _, log, ok = flat.at_tick(NONE)(*at, evaluators=OUTSIDE)
        r = np.array([1.0, np.sin(2.0 * at[0])])
        y = np.concatenate([log[flat.log.slices[f"{path}.y"]] for path in "pqr"])
        np.testing.assert_allclose(y, C @ at[1] + D @ r, rtol=1e-13, atol=1e-13)
        assert np.array_equal(x_next, at[1])
        assert ok == 1.0


@pytest.mark.drawn(5)
@pytest.mark.parametrize("paths", [*CHOICES, ("watch",), ("p", "watch")], ids="+".join)
def test_indicators_and_jumps_of_a_split_diagram_are_those_of_the_traced_one(paths):
    traced = loop(Watch(name="watch")).flatten(1)
    flat = traced.with_apart(*paths)
    evaluators = {**OUTSIDE, "watch": Equations(traced, "watch")}
    for t, x, w, p in instants(flat):
        y = (C @ x[:7] + D @ [1.0, np.sin(2.0 * t)])[:2]
        g, opened = flat.indicators(t, x, w, p, evaluators=evaluators)
        np.testing.assert_allclose(g, [y[0] - 0.3], rtol=1e-13)
        assert opened == 1.0
        for fired in (0.0, 1.0):
            expected = x.copy()
            expected[flat.states.of_block["watch"].slices["count"]] += fired * (1.0 + 0.5 * y[1])
            (after,) = flat.jump(t, x, w, p, [fired], evaluators=evaluators)
            np.testing.assert_allclose(after, expected, rtol=1e-13, atol=1e-13)


# --- derivatives -------------------------------------------------------------------------------------------------------


@choices
@pytest.mark.parametrize("way", ["call", "bind"])
def test_the_chained_jacobian_is_the_system_matrix(paths, way):
    flat = loop().flatten(1).with_apart(*paths)
    for at in instants(flat, 2):
        J = (flat.jacobian(*at, evaluators=OUTSIDE) if way == "call" else bound(flat.jacobian, at, OUTSIDE))[0]
        np.testing.assert_allclose(J.reshape(7, 7, order="F"), A, rtol=1e-12, atol=1e-12)


@choices
def test_outputs_have_chained_derivatives_by_states_and_time(paths):
    flat = loop().flatten(1).with_apart(*paths)
    slope = Derivative(flat.at_tick(NONE), [("x", [6, 0]), ("t", None)])
    for at in instants(flat, 2):
        values = slope(*at, evaluators=OUTSIDE)
        (x_next, by_x), log = (values[0], values[4]), flat.log
        assert np.array_equal(x_next, at[1])
        np.testing.assert_allclose(by_x, np.eye(7)[:, [6, 0]], atol=1e-14)
        rows = np.concatenate([np.arange(log.total)[log.slices[f"{path}.y"]] for path in "pqr"])
        np.testing.assert_allclose(values[8][rows], C[:, [6, 0]], rtol=1e-12, atol=1e-12)
        by_t = D @ [0.0, 2.0 * np.cos(2.0 * at[0])]
        np.testing.assert_allclose(values[9][rows, 0], by_t, rtol=1e-12, atol=1e-12)


@choices
def test_without_a_jacobian_of_its_own_a_block_is_differenced(paths):
    flat = loop().flatten(1).with_apart(*paths)
    matrices = {"p": (A_P, B_P, C_P, np.zeros((2, 2))), "q": (A_Q, B_Q, C_Q, D_Q), "r": (A_R, B_R, C_R, D_R)}
    evaluators = {p: OUTSIDE[p] if p == "wave" else Matrices(*matrices[p], slopes=False) for p in paths}
    (J,) = flat.jacobian(*next(instants(flat)), evaluators=evaluators)
    np.testing.assert_allclose(J, A, rtol=1e-9, atol=1e-9)


class Clocked(Matrices):
    """A linear block with a disturbance sin 3t at each output and rate."""

    def evaluate(self, names, t, x, u):
        return super().evaluate(names, t, x, u) + np.sin(3.0 * t)

    def differentiate(self, names, t, x, u):
        J = super().differentiate(names, t, x, u)
        if J is not None:
            J[:, 0] = 3.0 * np.cos(3.0 * t)
        return J


@pytest.mark.parametrize("slopes", [True, False])
def test_a_block_from_outside_that_depends_on_time_has_its_part_in_the_derivative_by_time(slopes):
    flat = loop().flatten(1).with_apart("p")
    evaluators = {"p": Clocked(A_P, B_P, C_P, np.zeros((2, 2)), slopes=slopes)}
    slope = Derivative(flat.flow, [("t", None)], values=False)
    for at in instants(flat, 2):
        disturbed = np.vstack([-B_P @ D_R @ D_Q, B_Q, -B_R @ D_Q]) @ np.ones(2)
        disturbed[:3] += 1.0
        expected = disturbed * 3.0 * np.cos(3.0 * at[0]) + B @ [0.0, 2.0 * np.cos(2.0 * at[0])]
        (by_t,) = slope(*at, evaluators=evaluators)
        np.testing.assert_allclose(by_t[:, 0], expected, rtol=1e-8 if not slopes else 1e-12, atol=1e-8)


def test_there_is_no_derivative_by_the_parameters_of_a_block_from_outside():
    flat = loop().flatten(1).with_apart("p")
    with pytest.raises(
        ParameterError, match="p: it is evaluated from outside, so that there is no derivative"
    ) as error:
        Derivative(flat.flow, [("p", None)])
    assert error.value.block == "p"
    split = loop().flatten(1).with_apart("wave")  # it has none
    by_p = Derivative(split.flow, [("p", None)], values=False)(*next(instants(split)), evaluators=OUTSIDE)[0]
    np.testing.assert_allclose(by_p, Derivative(loop().flatten(1).flow, [("p", None)])(*next(instants(split)))[1])


def test_what_may_depend_on_what_is_known_through_opaque_stages():
    flat = loop().flatten(1)
    assert np.array_equal(flat.flow.depends("dx", "x"), np.abs(A) > 0)
    split = flat.with_apart("r")
    assert np.array_equal(split.flow.depends("dx", "x"), np.abs(A) > 0)
    assert split.flow.depends("dx", "t").tolist() == [[True]] * 3 + [[False]] * 2 + [[True]] * 2
    known = Diagram("d", Integrator(name="i")(Gain(gain=2.0, name="g")(Constant(value=1.0)))).flatten(1)
    assert not known.flow.depends("dx", "t").any()
    assert known.with_apart("g").flow.depends("dx", "t").all()  # whatever is outside may depend on time


# --- where they are used ------------------------------------------------------------------------------------------------


@choices
def test_a_solver_runs_through_opaque_stages(paths):
    flat = loop().flatten(1).with_apart(*paths)
    workspace = Workspace(flat, OUTSIDE)
    flow, jacobian = workspace.flow(), workspace.jacobian()
    np.testing.assert_allclose(jacobian(0.3, np.arange(7.0)), A, rtol=1e-12, atol=1e-12)
    end = solve_ivp(lambda t, x: flow(t, x).copy(), (0.0, 1.0), flat.x0[:7], method="DOP853", rtol=1e-11, atol=1e-12)
    whole = np.zeros((10, 10))  # x, then 1, sin 2t, cos 2t
    whole[:7, :7], whole[:7, 7], whole[:7, 8] = A, B[:, 0], B[:, 1]
    whole[8, 9], whole[9, 8] = 2.0, -2.0
    exact = (expm(whole) @ [*flat.x0[:7], 1.0, 0.0, 1.0])[:7]
    np.testing.assert_allclose(end.y[:, -1], exact, rtol=1e-8, atol=1e-8)


@pytest.mark.drawn(4)
@choices
def test_linear_models_go_through_opaque_stages(paths):
    diagram = loop()
    flat = diagram.flatten(1).with_apart(*paths)
    measured = [find_signal(flat, name) for name in ("q.y", "r.y")]
    parts = LocalDerivatives(flat, [find_signal(flat, "p.y")], measured, (), evaluators=OUTSIDE)
    t, x, w, _ = next(instants(flat))
    found = parts.differentiate(NONE, t, x, w)
    np.testing.assert_allclose(found["dx", "x"], A, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found["y", "x"], C[2:], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found["y", "d"], np.vstack([D_Q, -D_R @ D_Q]), rtol=1e-12, atol=1e-12)
    by_d = np.vstack([-B_P @ D_R @ D_Q, B_Q, -B_R @ D_Q])
    np.testing.assert_allclose(found["dx", "d"], by_d, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("apart", ["g", "i"])
def test_an_algebraic_loop_is_solved_through_an_opaque_stage(apart):
    i, g = Integrator(name="i", initial_value=2.0), Gain(gain=-3.0, name="g")
    total = i.y + g.y  # s = x + g(s), so s = x / 4; dx/dt = s
    diagram = Diagram("d", i(total), g(total), loops="solve")
    traced = diagram.flatten(1)
    flat = traced.with_apart(apart)
    workspace = Workspace(flat, {apart: Equations(traced, apart)})
    assert workspace.flow()(0.0, np.array([2.0])) == pytest.approx(0.5, abs=1e-12)
    assert workspace.jacobian()(0.0, np.array([2.0])) == pytest.approx(0.25, abs=1e-12)


@pytest.mark.parametrize("on", [0.0, 1.0])
def test_a_block_from_outside_in_an_enabled_subsystem_holds_its_output_and_stays(on):
    @subsystem(enabled="held")
    def box(u):
        return space("p", A_P, B_P, C_P)(u)

    traced = Diagram("d", box(Wave(name="wave"), enable=Constant(value=on)).named("y")).flatten(1)
    flat = traced.with_apart("box.p")
    evaluators = {"box.p": Matrices(A_P, B_P, C_P, np.zeros((2, 2)))}
    for t, x, w, p in instants(flat):
        x[flat.gates.slices["box"]] = on
        expected = traced.flow(t, x, w, p)[0]
        assert expected.any() == bool(on)
        np.testing.assert_allclose(flat.flow(t, x, w, p, evaluators=evaluators)[0], expected, rtol=1e-13)
        log = [f.at_tick(NONE)(t, x, w, p, **more)[2] for f, more in ((flat, {"evaluators": evaluators}), (traced, {}))]
        np.testing.assert_allclose(*log, rtol=1e-13)
        slopes = [f.jacobian(t, x, w, p, **more)[0] for f, more in ((flat, {"evaluators": evaluators}), (traced, {}))]
        np.testing.assert_allclose(*slopes, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(slopes[0], on * A_P, atol=1e-12)


def test_a_tick_goes_through_a_sampled_block_from_outside():
    @subsystem(sample_time=0.5)
    def sampled(u):
        return DiscreteStateSpace(A=A_P, B=B_P, C=C_P, initial_state=1.0, name="p")(u)

    flat = Diagram("d", sampled(Wave(name="wave")).named("y")).flatten().with_apart("sampled.p")
    evaluators = {"sampled.p": Matrices(A_P, B_P, C_P, np.zeros((2, 2)))}
    x = flat.x0 + np.arange(flat.width)
    x_next, _, log, ok = flat.at_tick(flat.acting(0))(0.25, x, [], flat.p, evaluators=evaluators)
    np.testing.assert_allclose(x_next[:3], A_P @ x[:3] + B_P @ [1.0, np.sin(0.5)], rtol=1e-13)
    np.testing.assert_allclose(log[flat.log.slices["sampled.p.y"]], C_P @ x[:3], rtol=1e-13)
    assert ok == 1.0


@pytest.mark.drawn(1)
@pytest.mark.parametrize("make", [experiments.path_following, experiments.hand_guiding])
def test_the_papers_diagram_with_all_its_blocks_outside_is_the_same_function(make):
    experiment = make()
    traced = experiment.diagram.flatten()
    run = experiment.diagram.simulate(0.5, progress=False)
    flat = traced.with_apart(*traced.checked.traced)
    evaluators = {path: Equations(traced, path) for path in traced.checked.traced}
    acting = flat.acting(0)
    tick, whole = flat.at_tick(acting), traced.at_tick(acting)
    assert len(tick.opaque) >= len(traced.checked.traced)
    slopes = [Derivative(s, [("x", None), ("w", None)]) for s in (tick, whole)]
    for k in (1, 200, 450):
        at = run.t[k], run.data[k, flat.log.total :], run.data[k, : flat.plant_outputs.total], flat.p
        for mine, theirs in zip(tick(*at, evaluators=evaluators), whole(*at), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)
        for mine, theirs in zip(slopes[0](*at, evaluators=evaluators), slopes[1](*at), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-10, atol=1e-10 * (1.0 + np.abs(theirs).max()))


@choices
def test_a_missing_evaluator_is_named(paths):
    flat = loop().flatten(1).with_apart(*paths)
    at = next(instants(flat))
    given = {path: OUTSIDE[path] for path in paths[1:]}
    for use in (
        lambda: flat.flow(*at, evaluators=given),
        lambda: bound(flat.flow, at, given),
        lambda: flat.jacobian(*at, evaluators=given),
        lambda: flat.flow.function,
    ):
        with pytest.raises(SimulationError, match="it is evaluated from outside") as error:
            use()
        assert error.value.block in paths
