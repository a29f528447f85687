"""What a user's equations return and close over, and where NumPy and a trace part ways."""

import numpy as np
import pytest
from scipy.integrate import quad

from loopwright.blocks import (
    Block,
    Constant,
    DefinitionError,
    Ellipse,
    Event,
    Input,
    LoopwrightError,
    Output,
    Path,
    PathProjection,
    ShapeError,
    State,
    TraceError,
    UnitDelay,
    parameter,
)
from loopwright.blocks.tracing.equations import initial_state, start_shapes
from loopwright.blocks.tracing.symbols import bundle
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram


def shapes_of(block):
    return {name: port.shape if port.shape is not None else () for name, port in block.inputs.items()}


def traced(block, sampled=False, **options):
    return trace(block, shapes_of(block), sampled=sampled, **options)


def value(block, x=(), u=(), sampled=False, which=0, t=0.0, **options):
    found = traced(block, sampled, **options)
    p = found.pack(block, 1e-3 if sampled else np.nan)
    return np.ravel(np.array(found.function.call([t, list(x), *u, p])[which]))


# --- what equations close over ----------------------------------------------------------------------------------------

MASS = 2.0


def weigh(force):
    return force / MASS


class Body(Block):
    gravity = 1.0
    F = Input()
    v = State(output=True)
    a = Output()

    def derivative(self, t, x, u):
        return u.F / MASS

    def output(self, t, x, u):
        return weigh(u.F) * self.gravity


def accelerations(body, cache=None):
    found = trace(body, {"F": ()}, sampled=False, cache=cache)
    made = found.function.call([0.0, [0.0], 8.0, found.pack(body, np.nan)])
    return [float(np.ravel(np.array(m))[0]) for m in made[1:3]]


def test_a_changed_constant_counts_in_the_next_build(monkeypatch):
    assert accelerations(Body()) == [4.0, 4.0]
    monkeypatch.setitem(globals(), "MASS", 4.0)
    assert accelerations(Body()) == [2.0, 2.0]


def test_a_changed_class_attribute_counts_in_the_next_build(monkeypatch):
    assert accelerations(Body()) == [4.0, 4.0]
    monkeypatch.setattr(Body, "gravity", 3.0)
    assert accelerations(Body())[0] == 12.0


def test_a_redefined_helper_counts_in_the_next_build(monkeypatch):
    assert accelerations(Body()) == [4.0, 4.0]
    monkeypatch.setitem(globals(), "weigh", lambda force: 5.0 * force)
    assert accelerations(Body())[0] == 40.0


def test_within_one_build_equal_blocks_share_a_trace():
    cache = {}
    first, second = (trace(Body(), {"F": ()}, sampled=False, cache=cache) for _ in range(2))
    assert first is second
    assert trace(Body(), {"F": ()}, sampled=False, cache={}) is not first


def test_equal_blocks_of_a_users_class_are_traced_once_in_one_build_and_again_in_the_next():
    ran = []

    class Slow(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            ran.append(1)
            return 2.0 * u.u

    def chain(n):
        signal = Constant(value=1.0)
        for _ in range(n):
            signal = Slow()(signal)
        return Diagram("chain", signal)

    chain(2)
    once = len(ran)
    chain(20)
    assert len(ran) == 2 * once  # linear: the number of blocks doesn't count, each build does


BEND = 0.1


class Bean(Path):
    period = 2.0 * np.pi

    def sigma(self, theta, order=0):
        turn = order * np.pi / 2.0
        y = np.cos(theta + turn) + BEND * 2.0**order * np.cos(2.0 * theta + turn)
        return 0.3 * np.stack([y, np.sin(theta + turn)])


def test_the_librarys_own_blocks_share_traces_everywhere_unless_a_users_path_is_in_them():
    def project(path):
        return trace(PathProjection(path), {"position": (2,)}, sampled=True)

    ellipse = Ellipse(semi_axes=(0.3, 0.15))
    assert project(ellipse) is project(ellipse)
    assert project(Bean()) is not project(Bean())


def test_a_function_as_a_parameter_may_read_anything(monkeypatch):
    class Call(Block):
        function: object = parameter()
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return self.function(u.u)

    def function(u):
        return u / MASS

    assert value(Call(function=function), u=[8.0]) == [4.0]
    monkeypatch.setitem(globals(), "MASS", 4.0)
    assert value(Call(function=function), u=[8.0]) == [2.0]


# --- what they return -------------------------------------------------------------------------------------------------


def vector(equation):
    class V(Block):
        u = Input()
        y = Output(shape=(2,))

        def output(self, t, x, u):
            return equation(u.u)

    return V()


def two(equation):
    class W(Block):
        u = Input()
        a = Output()
        b = Output()

        def output(self, t, x, u):
            return equation(u.u)

    return W()


def states(equation):
    class S(Block):
        u = Input()
        r = State(output=True)
        s = State(output=True)

        def derivative(self, t, x, u):
            return equation(u.u)

    return S()


@pytest.mark.parametrize(
    ("block", "kind", "text"),
    [
        (vector(lambda u: [u, 2 * u]), TraceError, r"v\.y: .*a list of 2 for y; expected a value of shape \(2,\)"),
        (vector(lambda u: [u, 2 * u]), TraceError, r"return np\.stack\(\[…\]\)"),
        (vector(lambda u: (u, 2 * u)), TraceError, r"a tuple of 2 for y; .*return np\.stack"),
        (vector(lambda u: None), TraceError, r"v: its output returned nothing; expected the value of y.*return"),
        (
            vector(lambda u: u),
            ShapeError,
            r"v\.y: its output gives shape \(\); expected \(2,\).*np\.stack\(\[…\]\) of 2",
        ),
        (vector(lambda u: {"y": u}), TraceError, r"a dict of 1 \(y\) for y.*Return the value itself"),
        (vector(lambda u: "one"), TraceError, r"returned 'one' for y"),
        (vector(lambda u: np.stack([u, u, u])), ShapeError, r"v\.y: .*shape \(3,\); expected \(2,\) as declared"),
        (two(lambda u: None), TraceError, r"w: its output returned nothing; expected a tuple of 2: a, b"),
        (two(lambda u: u), TraceError, r"w: its output returned a single value; expected a tuple of 2: a, b"),
        (two(lambda u: 1.0), TraceError, r"returned a single value; expected a tuple of 2: a, b.*Write return a, b"),
        (two(lambda u: {"a": u, "b": u}), TraceError, r"returned a dict of 2 \(a, b\); expected a tuple of 2: a, b"),
        (two(lambda u: np.stack([u, u])), TraceError, r"an array of shape \(2,\); expected a tuple of 2: a, b"),
        (two(lambda u: (u, u, u)), TraceError, r"returned a tuple of 3; expected a tuple of 2: a, b"),
        (two(lambda u: (u, None)), TraceError, r"w\.b: its output returned nothing for b; expected one value"),
        (two(lambda u: (u, (u,))), TraceError, r"w\.b: .* a tuple of 1 for b; .*without brackets or a comma"),
        (states(lambda u: u), TraceError, r"s: its derivative returned a single value; expected a tuple of 2: r, s"),
        (states(lambda u: None), TraceError, r"s: its derivative returned nothing; expected a tuple of 2: r, s"),
    ],
)
def test_a_wrong_return_value_is_told(block, kind, text):
    with pytest.raises(kind, match=text):
        traced(block)


def test_a_list_for_several_outputs_and_plain_numbers_are_taken():
    assert value(two(lambda u: [u, 2 * u]), u=[3.0], which=1) == [6.0]
    assert list(value(vector(lambda u: [1.0, 2.0]), u=[3.0])) == [1.0, 2.0]


@pytest.mark.parametrize(
    ("made", "kind", "text"),
    [
        (lambda u: 1.0 - u, TraceError, r"g: its guards returned a single value; expected a dictionary.*'margin'"),
        (lambda u: None, TraceError, r"g: its guards returned nothing; expected a dictionary of expressions by name"),
        (lambda u: [1.0 - u], TraceError, r"returned a list of 1; expected a dictionary"),
        (lambda u: {1: u}, TraceError, r"expected a dictionary of expressions by name"),
        (lambda u: {"m": np.stack([u, u])}, ShapeError, r"guard 'm' is an array of shape \(2,\); expected a scalar"),
        (lambda u: {"m": None}, ShapeError, r"guard 'm' is nothing; expected a scalar"),
    ],
)
def test_guards_that_are_none(made, kind, text):
    class G(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return u.u

        def guards(self, t, x, u):
            return made(u.u)

    with pytest.raises(kind, match=text):
        traced(G())


def test_constants_that_are_no_dictionary():
    class C(Block):
        u = Input()
        y = State(output=True)

        def update(self, t, x, u):
            return u.u

        def constants(self, T, method):
            return 3.0

    with pytest.raises(TraceError, match=r"c: its constants returned a float; expected a dictionary"):
        traced(C(), sampled=True)


def with_initial(initial):
    class P(Block):
        u = Input(shape=(2,))
        last = State(start=(0.0, 0.0))
        count = State()
        y = Output(shape=(2,))

        def update(self, t, x, u):
            return u.u, x.count + 1.0

        def output(self, t, x, u):
            return x.last

    P.initial = initial
    return P()


@pytest.mark.parametrize(
    ("initial", "text"),
    [
        (lambda self, u: u.u, r"its initial returned an array of shape \(2,\); expected a tuple of 2: last, count"),
        (lambda self, u: None, r"its initial returned nothing; expected a tuple of 2: last, count"),
        (lambda self, u: (u.u[0], 0.0), r"last: its initial gives shape \(\); expected \(2,\)"),
        (lambda self, u: (u.u, "no"), r"count: its initial returned 'no' for count; expected numbers"),
    ],
)
def test_an_initial_state_of_the_wrong_size(initial, text):
    block = with_initial(initial)
    with pytest.raises((TraceError, ShapeError), match=text):
        initial_state(block, traced(block, sampled=True).states, bundle("u", {"u": np.ones(2)}))


def test_an_initial_state_is_flat():
    block = with_initial(lambda self, u: (2.0 * u.u, 5.0))
    found = initial_state(block, {"last": (2,), "count": ()}, bundle("u", {"u": np.ones(2)}))
    assert list(found) == [2.0, 2.0, 5.0]


# --- signatures and names ---------------------------------------------------------------------------------------------


def with_equation(name, function):
    class E(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return u.u

    setattr(E, name, function)
    return E()


@pytest.mark.parametrize(
    ("name", "function", "text"),
    [
        ("output", lambda self, u: u, r"e: found output\(self, u\); expected output\(self, t, x, u\), and T where"),
        ("output", lambda t, x, u: u, r"found output\(t, x, u\); expected output\(self, t, x, u\)"),
        ("output", lambda self, t, x, u, p: u, r"found output\(self, t, x, u, p\); expected output"),
        ("guards", lambda self: {}, r"found guards\(self\); expected guards\(self, t, x, u\)"),
        ("initial", lambda self, t, u: 0.0, r"found initial\(self, t, u\); expected initial\(self, u\)"),
        ("constants", lambda self: {}, r"found constants\(self\); expected constants\(self, T, method\)"),
        ("output", 3.0, r"its output is a single value; expected output\(self, t, x, u\).* Define it as a function"),
    ],
)
def test_an_equation_with_other_arguments(name, function, text):
    with pytest.raises(TraceError, match=text):
        traced(with_equation(name, function))


def test_a_jump_takes_what_has_fired():
    class J(Block):
        y = State(output=True)
        hit = Event()

        def derivative(self, t, x, u):
            return -1.0 + 0.0 * x.y

        def indicators(self, t, x, u):
            return x.y

        def jump(self, t, x, u):
            return x.y

    with pytest.raises(TraceError, match=r"found jump\(self, t, x, u\); expected jump\(self, t, x, u, fired\)"):
        traced(J())


def test_the_sample_time_may_be_an_argument_with_a_default():
    class H(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u, T=1.0):
            return u.u * T

    assert value(H(), u=[3.0]) == [3.0]
    assert value(H(), u=[3.0], sampled=True) == [0.003]


def hidden_output():
    class K(Block):
        u = Input()
        output = Output()

    return traced(K())


def hidden_update():
    class L(Block):
        update = Input()
        y = Output()

        def output(self, t, x, u):
            return u.update

    return traced(L())


@pytest.mark.parametrize(("define", "name"), [(hidden_output, "output"), (hidden_update, "update")])
def test_a_port_is_not_named_like_an_equation(define, name):
    with pytest.raises(DefinitionError, match=rf"a port can't be called '{name}'.*(rename the port|another name)"):
        define()


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("T", r"in equations T is the sample time in s\. Take another name, such as temperature or T_1"),
        ("inputs", "every block has an attribute of that name"),
        ("_x", "names that begin with an underscore are private"),
    ],
)
def test_a_port_whose_name_means_something_else_is_refused_by_an_error_that_says_why(name, why):
    for port in (Input(), Output(), State(start=300.0, output=True)):
        with pytest.raises(DefinitionError, match=rf"^Tank\.{name}: a port can't be called '{name}': {why}"):
            type("Tank", (Block,), {name: port})


# --- start values -----------------------------------------------------------------------------------------------------


def test_a_start_that_names_no_parameter():
    class A(Block):
        level: float = parameter(default=1.0)
        y = State(start="levle", output=True)

        def derivative(self, t, x, u):
            return -x.y

    with pytest.raises(DefinitionError, match=r"a\.y: found start='levle'; expected .* the name of a parameter: level"):
        traced(A())


def test_a_start_that_is_no_number():
    class A(Block):
        y = State(start={"a": 1}, output=True)

        def derivative(self, t, x, u):
            return -x.y

    with pytest.raises(DefinitionError, match=r"a\.y: found start=\{'a': 1\}.*expected numbers"):
        traced(A())


def like_nothing():
    class A(Block):
        u = Input()
        y = Output()
        last = State(like="v")

        def output(self, t, x, u):
            return x.last

        def update(self, t, x, u):
            return u.u

    return traced(A(), sampled=True)


def test_like_that_names_no_input():
    with pytest.raises(DefinitionError, match=r"last: found like='v'; expected an input"):
        like_nothing()


@pytest.mark.parametrize("shape", [(), (3,)])
def test_a_delays_initial_value_that_does_not_fit_its_input(shape):
    with pytest.raises(
        ShapeError, match=r"unit_delay\.initial_value: found a start value of shape \(2,\); expected a number, or shape"
    ):
        trace(UnitDelay(initial_value=(7, 8)), {"u": shape}, sampled=True)
    assert trace(UnitDelay(initial_value=(7, 8)), {"u": (2,)}, sampled=True).outputs == {"y": (2,)}


def test_the_shape_of_a_start_value_by_itself():
    assert start_shapes(UnitDelay(initial_value=(7, 8))) == [(2,)]
    assert start_shapes(UnitDelay()) == [()]


# --- NumPy beside the trace -------------------------------------------------------------------------------------------


def function_block(equation, **more):
    class F(Block):
        quantum: float = parameter(default=0.1)
        u = Input(shape=(2,))
        y = Output(shape=None)

        def output(self, t, x, u):
            return equation(self, t, u.u)

    for name, item in more.items():
        setattr(F, name, item)
    return F()


@pytest.mark.parametrize(
    "equation",
    [
        lambda b, t, u: np.round(u),
        lambda b, t, u: np.rint(u),
        lambda b, t, u: np.around(u[0]),
        lambda b, t, u: np.round(u[1] / b.quantum) * b.quantum,
        lambda b, t, u: np.round(u, 2),
        lambda b, t, u: np.round(3.0 * t),
        lambda b, t, u: np.round(b.quantum),
        lambda b, t, u: np.stack([np.rint(v) for v in u]),
        lambda b, t, u: np.rint(np.where(u > 0.0, u, 0.5)),
        lambda b, t, u: np.rint(np.stack([u[0], 1.0])),
        lambda b, t, u: np.rint(u @ u),
        lambda b, t, u: np.round(np.sum(u)),
    ],
)
def test_rounding_to_even_is_refused(equation):
    with pytest.raises(TraceError, match=r"f: it uses np\.round or np\.rint, .*halves.*np\.floor\(v \+ 0\.5\)"):
        traced(function_block(equation))


@pytest.mark.filterwarnings("ignore:numpy.fix is deprecated:DeprecationWarning")  # since NumPy 2.5
@pytest.mark.parametrize(
    "equation",
    [
        lambda b, t, u: np.floor(u / b.quantum + 0.5) * b.quantum,
        lambda b, t, u: np.sign(u) * np.floor(np.abs(u) + 0.5),
        lambda b, t, u: np.trunc(u),
        lambda b, t, u: np.ceil(u),
        lambda b, t, u: np.fix(u),
        lambda b, t, u: np.mod(t, b.quantum),
        lambda b, t, u: np.mod(u, 0.1),
        lambda b, t, u: u // 0.1,
        lambda b, t, u: np.sign(u),
        lambda b, t, u: np.heaviside(u, 0.5),
        lambda b, t, u: np.abs(u) ** 0.5,
        lambda b, t, u: u**3,
        lambda b, t, u: 1.0 / u,
        lambda b, t, u: u / np.sqrt(u @ u),
        lambda b, t, u: np.hypot(u[0], u[1]),
        lambda b, t, u: np.where(u > 0.0, np.log(np.where(u > 0.0, u, 1.0)), 0.0),
        lambda b, t, u: np.where(u > 0.5, 1.0, np.where(u < -0.5, -1.0, 0.0)),
        lambda b, t, u: np.maximum(u, 0.0) * np.minimum(u, 1.0),
        lambda b, t, u: np.clip(u, -0.5, 0.5),
        lambda b, t, u: np.arctan2(u[0], u[1]),
        lambda b, t, u: np.round(2.5) * u,
        lambda b, t, u: np.linalg.inv(np.stack([np.stack([u[0], 0.0]), np.stack([0.0, u[1]])])) @ u,
    ],
)
def test_no_false_alarm(equation):
    block = function_block(equation)
    for point in (np.array([0.7, 1.9]), np.array([-0.3, 2.6])):
        told = np.broadcast_to(equation(block, 0.0, point), (2,))
        np.testing.assert_allclose(np.broadcast_to(value(block, u=[point]), (2,)), told, rtol=1e-14)


def test_a_wrong_value_at_a_special_point_alone_is_found():
    class Z(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return np.where(u.u == 0.0, 1.0, 0.0) if not isinstance(u.u, np.float64) else 0.0 * u.u

    with pytest.raises(TraceError, match=r"z: its traced equation gives \[1\.\] for 'y' where NumPy gives \[0\.\]"):
        traced(Z())


def test_a_division_by_zero_at_a_special_point_is_no_failure():
    class D(Block):
        k: float = parameter(default=0.0)
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return u.u / self.k + (-1.0 * u.u) ** 0.5

    assert not np.isfinite(value(D(), u=[1.0]))[0]


def test_an_equation_that_runs_with_symbols_only():
    class N(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return u.u.to_casadi() and u.u

    with pytest.raises(LoopwrightError):
        traced(N())

    class M(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            u.u.to_casadi()
            return u.u

    with pytest.raises(TraceError, match=r"m: its output can be traced, but not be run with numbers: AttributeError"):
        traced(M())


# --- semi-implicit Euler of a nonlinear block -------------------------------------------------------------------------


class Chain(Block):
    """A chain of nonlinear oscillators: positions, then velocities."""

    count: int = parameter()
    force = Input()
    q = State(start=lambda block: 0.1 * np.arange(1, block.count + 1), output=True)
    v = State(start=lambda block: np.zeros(block.count), output=True)

    def derivative(self, t, x, u):
        left = np.concatenate([np.zeros(1), x.q[:-1]])
        return x.v + 0.1 * np.sin(x.q), -np.sin(x.q) - 0.2 * x.v**3 + 0.3 * (left - x.q) + u.force


def test_semi_implicit_euler_is_the_recurrence_written_by_hand():
    n, T, force = 3, 1e-3, 0.7
    block = Chain(count=n)
    q, v = np.array([0.4, -0.2, 0.9]), np.array([0.1, 0.3, -0.5])
    found = value(block, [*q, *v], [force], sampled=True, which=2, method="semi_implicit")
    for i in reversed(range(n)):  # velocities first, from the last on, each with what is renewed already
        left = q[i - 1] if i else 0.0
        v[i] += T * (-np.sin(q[i]) - 0.2 * v[i] ** 3 + 0.3 * (left - q[i]) + force)
    for i in reversed(range(n)):
        q[i] += T * (v[i] + 0.1 * np.sin(q[i]))
    np.testing.assert_allclose(found, [*q, *v], rtol=0, atol=1e-15)


def test_semi_implicit_euler_of_a_pendulum_keeps_its_energy():
    class Pendulum(Block):
        angle = State(start=2.0, output=True)
        rate = State(output=True)

        def derivative(self, t, x, u):
            return x.rate, -np.sin(x.angle)

    found = trace(Pendulum(), {}, sampled=True, method="semi_implicit")
    T, x = 0.01, np.array([2.0, 0.0])
    p = found.pack(Pendulum(), T)
    quarter = quad(lambda s: 1.0 / np.sqrt(1.0 - (np.sin(1.0) * np.sin(s)) ** 2), 0.0, np.pi / 2)[0]
    crossing = None
    for k in range(2000):
        after = np.ravel(np.array(found.function.call([0.0, x, p])[-2]))
        if crossing is None and after[0] < 0.0:
            crossing = (k + x[0] / (x[0] - after[0])) * T
        x = after
        assert abs(x[1] ** 2 / 2 - np.cos(x[0]) + np.cos(2.0)) < 0.02  # explicit Euler gains 0.1 in the same time
    assert crossing == pytest.approx(quarter, abs=2 * T)


def test_semi_implicit_euler_costs_at_most_the_square_of_the_states():
    sizes = [traced(Chain(count=n), True, method="semi_implicit").function.n_instructions() for n in (8, 16, 32)]
    assert sizes[2] - sizes[1] < 4.5 * (sizes[1] - sizes[0])
