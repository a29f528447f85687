"""Functions as blocks: traced ones, and any Python callable, with derivatives by differences and errors that tell."""

import functools
import math
import pickle

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    Event,
    Function,
    Input,
    LoopwrightError,
    Output,
    ParameterError,
    PythonFunction,
    ShapeError,
    SimulationError,
    Sine,
    State,
    TraceError,
    parameter,
)
from loopwright.blocks.tracing.opaque_equations import raise_failure
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram, subsystem


def flat(column):
    return np.ravel(np.array(column)).tolist()


def traced(block, shapes=None, **options):
    return trace(block, shapes or dict.fromkeys(block.inputs, ()), **{"sampled": False, **options})


def run_of(call, duration=0.5, step=0.1):
    return Diagram("functions", call).simulate(duration, step=step, progress=False)


def product(a, b):
    return a * b


# --- functions that are traced ----------------------------------------------------------------------------------------


def test_a_numpy_function_is_a_block():
    source = Sine(frequency=0.5, name="source")
    run = run_of(Function(np.exp, name="f")(source))
    np.testing.assert_allclose(run["f.y"], np.exp(np.sin(np.pi * run.t)), rtol=1e-14)


def test_inputs_are_named_after_the_arguments():
    assert list(Function(product).inputs) == ["a", "b"]
    assert list(Function(lambda force, speed, gain=2.0: gain * force * speed).inputs) == ["force", "speed"]
    assert list(Function(np.sin).inputs) == ["u"]
    assert list(Function(np.arctan2).inputs) == ["u1", "u2"]
    assert list(Function(np.linalg.norm, arguments="v").inputs) == ["v"]


def test_it_is_traced_and_differentiated_exactly():
    found = traced(Function(lambda a, b: a * np.sin(b)))
    assert found.function.is_a("SXFunction")
    slope = found.function.jacobian()(0.0, [], 2.0, 0.7, found.pack(Function(product), np.nan), *[0.0] * 3)
    assert float(slope[2]) == math.sin(0.7)
    assert float(slope[3]) == 2.0 * math.cos(0.7)


def test_vectors_and_several_results():
    block = Function(lambda p: (np.sum(p * p), p[::-1]), results=("square", "turned"), name="f")
    run = run_of(block(Constant(value=(1.0, 2.0, 3.0))), 0.1)
    assert run["f.square"].tolist() == [14.0, 14.0]
    assert run["f.turned"].tolist() == [[3.0, 2.0, 1.0]] * 2
    square, turned = block(Constant(value=(1.0, 2.0, 3.0)))
    assert (square.port, turned.port) == ("square", "turned")
    assert block.replace(arguments="q").inputs.keys() == {"q"}


def test_its_name_is_the_functions():
    assert Function(product).label == "product"
    assert Function(np.sin).label == "sin"
    assert Function(lambda u: u).label == "function"
    assert Function(product, name="power").label == "power"


def branching(u):
    return 1.0 if u > 0.0 else 2.0


class Branching:
    def __call__(self, u):
        return branching(u)


@pytest.mark.parametrize(
    "function",
    [branching, Branching(), functools.partial(lambda gain, u: gain * branching(u), 2.0), lambda u: branching(u)],
    ids=["function", "object", "partial", "lambda"],
)
def test_what_can_not_be_traced_is_found_in_the_users_own_lines(function):
    line = branching.__code__.co_firstlineno + 1
    with pytest.raises(TraceError, match=rf"line {line} of .*test_functions\.py, 'return 1\.0 if u > 0") as error:
        traced(Function(function, arguments="u"))
    assert "Write np.where(condition, a, b) for if" in str(error.value)
    assert "or take PythonFunction, which is not traced" in str(error.value)


def test_a_function_of_c_has_no_line():
    with pytest.raises(TraceError, match="its output can't be traced: a symbol is no number.* np.sin for math.sin"):
        traced(Function(math.sin, arguments="u"))


def test_what_traces_wrongly_or_not_at_all_is_refused():
    with pytest.raises(TraceError, match=r"function: its output can't be traced"):
        traced(Function(lambda u: math.sin(u)))
    with pytest.raises(TraceError, match="it uses np.round"):
        traced(Function(lambda u: np.round(u)))
    with pytest.raises(TraceError, match="its output returned a tuple of 2; expected the value of y|expected a number"):
        traced(Function(lambda u: (u, u)))


def test_two_are_equal_where_the_function_is_the_same():
    assert Function(product) == Function(product)
    assert Function(product) != Function(lambda a, b: a * b)
    assert Function(product) != PythonFunction(product)
    assert Function(product) != Function(product, results="z")
    for block in (Function(product), Function(np.sin), PythonFunction(product, results={"z": ()})):
        assert pickle.loads(pickle.dumps(block)) == block


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"function": 3}, r"function\.function: found 3; expected a function, such as np\.sin"),
        ({"function": lambda *u: u}, r"arguments: found the function .* can't be found; expected names for the inputs"),
        ({"function": lambda: 1.0}, "can't be found"),
        ({"function": product, "results": "a"}, r"results: found 'a', the name of an input too; expected another"),
        ({"function": product, "results": "name"}, "found 'name'; expected names"),
        ({"function": product, "results": "function"}, "found 'function'; expected names"),
        ({"function": product, "results": "2y"}, "found '2y'; expected names"),
        (
            {"function": product, "results": {"y": "big"}},
            r"found 'big' as the shape of 'y'; expected one such as \(3,\)",
        ),
    ],
)
def test_wrong_definitions_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        Function(**arguments)


# --- any callable -----------------------------------------------------------------------------------------------------


def collatz(n):
    """Steps to 1: loops and branches, no trace."""
    n, steps = round(float(n)), 0
    while n != 1:
        n, steps = (n // 2 if n % 2 == 0 else 3 * n + 1), steps + 1
    return steps


def test_any_callable_is_a_block():
    run = run_of(PythonFunction(collatz, name="f")(Constant(value=27.0)))
    assert run["f.y"].tolist() == [111.0] * 6


def test_it_runs_beside_traced_blocks_and_in_sampled_subsystems():
    @subsystem(sample_time=0.1)
    def box(u):
        return (2.0 * PythonFunction(lambda u: math.exp(u), name="f")(u)).named("y")

    run = Diagram("boxed", box(Sine(frequency=0.5))).simulate(1.0, step=0.05, progress=False)
    want = 2.0 * np.exp(np.sin(np.pi * np.floor(run.t / 0.1 + 1e-9) * 0.1))
    np.testing.assert_allclose(run["y"], want, rtol=1e-14)


def test_shapes_come_from_one_trial_or_are_declared():
    calls = []

    def norm_and_direction(force):
        calls.append(force.copy())
        return math.hypot(*force), force / math.hypot(*force)

    block = PythonFunction(norm_and_direction, results=("size", "direction"))
    found = traced(block, {"force": (2,)})
    assert found.outputs == {"size": (), "direction": (2,)}
    assert [c.tolist() for c in calls] == [[1.0, 0.5]]
    calls.clear()
    declared = block.replace(arguments={"force": (2,)}, results={"size": (), "direction": 2})
    assert declared.inputs["force"].shape == (2,)
    found = traced(declared, {"force": (2,)})
    assert not calls
    p = found.pack(declared, np.nan)
    size, direction, *_ = found.function(0.0, [], [3.0, 4.0], p)
    assert (float(size), flat(direction)) == (5.0, [0.6, 0.8])


def test_matrices_go_in_and_out_as_they_are():
    block = PythonFunction(lambda A: np.linalg.inv(A) @ np.diag([1.0, 2.0]), name="f")
    run = run_of(block(Constant(value=((1.0, 2.0), (3.0, 5.0)))), 0.1)
    np.testing.assert_allclose(run["f.y"][0], [[-5.0, 4.0], [3.0, -2.0]], rtol=1e-13)


def test_every_output_counts_as_fed_through_from_every_input():
    found = traced(PythonFunction(lambda a, b: (a, b), results=("c", "d")))
    assert all(found.depends[name] >= {"a", "b"} for name in ("c", "d"))


def test_its_derivatives_are_differences_that_hold_seven_digits():
    def smooth(a, v):
        return math.exp(math.sin(3.0 * a)) * v[0], np.array([v[1] ** 3, a / (1.0 + v[0] ** 2), 1e4 * v[1]])

    found = traced(PythonFunction(smooth, results=("y", "z")), {"a": (), "v": (2,)})
    rng = np.random.default_rng(3)
    for a, v in [(0.4, rng.standard_normal(2)), (-300.0, 1e3 * rng.standard_normal(2)), (0.0, np.array([0.0, 1.0]))]:
        jacobian = found.function.jacobian()
        made = jacobian(0.0, [], a, v, [np.nan], 0.0, np.zeros(3), [], [])
        names = [f"{o}_{i}" for o in ("y", "z") for i in ("t", "x", "a", "v", "p")]
        got = {n: np.array(m) for n, m in zip(names, made, strict=False)}
        e = math.exp(math.sin(3.0 * a))
        np.testing.assert_allclose(got["y_a"], [[3.0 * math.cos(3.0 * a) * e * v[0]]], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(got["y_v"], [[e, 0.0]], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(got["z_a"][:, 0], [0.0, 1 / (1 + v[0] ** 2), 0.0], rtol=1e-7, atol=1e-12)
        want = [[0.0, 3 * v[1] ** 2], [-2 * a * v[0] / (1 + v[0] ** 2) ** 2, 0.0], [0.0, 1e4]]
        np.testing.assert_allclose(got["z_v"], want, rtol=1e-7, atol=1e-9)


# --- opaque blocks with states ----------------------------------------------------------------------------------------


class Tank(Block):
    """A tank whose level falls as Python says, with numbers that are parameters."""

    opaque = True
    outlet: float = parameter(default=0.6)
    inflow = Input()
    level = State(start=1.0, output=True)
    hours = State(start=0.0)
    flow = Output()

    def derivative(self, t, x, u):
        return u.inflow - (self.outlet * math.sqrt(x.level) if x.level > 0.0 else 0.0), 1.0 / 3600.0

    def output(self, t, x, u):
        return self.outlet * math.sqrt(max(x.level, 0.0))

    def guards(self, t, x, u):
        return {"space": 5.0 - float(x.level)}


def test_an_opaque_block_with_rates_is_discretized():
    tank = Tank(name="tank", outlet=0.5)
    for method in ("forward", "trapezoidal"):

        @subsystem(sample_time=0.1, method=method)
        def box(u):
            return tank(u)

        run = Diagram("tanks", box(Constant(value=0.1))).simulate(1.0, progress=False)
        level, rows = 1.0, []
        for _ in range(11):
            rows.append(level)
            rate = 0.1 - 0.5 * math.sqrt(level)
            new = level + 0.1 * rate
            for _ in range(100 if method == "trapezoidal" else 0):
                new = level + 0.05 * (rate + 0.1 - 0.5 * math.sqrt(new))
            level = new
        np.testing.assert_allclose(run["tank.level"], rows, rtol=1e-9)
        np.testing.assert_allclose(run["tank.flow"], 0.5 * np.sqrt(rows), rtol=1e-9)


def test_the_numbers_of_an_opaque_block_are_those_of_the_run():
    found = traced(Tank())
    for outlet in (0.6, 2.0):
        p = Tank(outlet=outlet).parameters["outlet"]
        made = found.function(0.0, [4.0, 0.0], 1.0, [p, np.nan])
        assert float(made[1]) == 2.0 * outlet
        assert flat(made[2]) == [1.0 - 2.0 * outlet, 1.0 / 3600.0]
        assert flat(made[3]) == [1.0]
    assert found.guards == ("space",)
    assert found.depends["level"] == {"x"}


class Counter(Block):
    """Counts how often its input has risen above a level: jumps in a continuous subsystem, an update in a sampled one."""

    opaque = True
    u = Input()
    count = State(discrete=True, output=True)
    above = State(discrete=True)
    up = Event("rising")

    def indicators(self, t, x, u):
        return float(u.u) - 1.0

    def jump(self, t, x, u, fired):
        if fired.up > 0.5:
            return x.count + 1.0, 1.0
        return x.count, x.above

    def update(self, t, x, u, T=None):
        above = 1.0 if u.u > 1.0 else 0.0
        return x.count + (1.0 if above > x.above else 0.0), above


def test_an_opaque_block_may_have_events():
    found = traced(Counter())
    assert float(found.indicators(0.0, [0, 0], 1.5, [np.nan])) == 0.5
    assert flat(found.jump(0.0, [2, 0], 1.5, [np.nan], [1])) == [3.0, 1.0]
    assert flat(found.jump(0.0, [2, 0], 1.5, [np.nan], [0])) == [2.0, 0.0]
    found = traced(Counter(), sampled=True)
    assert (found.advance, found.indicators) == ("update", None)
    assert flat(found.function(0.0, [2, 0], 1.5, [0.1])[1]) == [3.0, 1.0]


# --- errors -----------------------------------------------------------------------------------------------------------


def test_an_exception_is_kept_with_its_cause_and_gives_nan():
    def broken(u):
        if u > 2.0:
            raise KeyError("no such entry")
        return u

    found = traced(PythonFunction(broken))
    p = [np.nan]
    assert float(found.function(0.0, [], 1.5, p)[0]) == 1.5
    assert not found.failures
    assert math.isnan(float(found.function(0.25, [], 3.0, p)[0]))
    with pytest.raises(SimulationError) as caught:
        raise_failure(found.failures, "box.broken")
    assert str(caught.value) == (
        "box.broken, t = 0.25 s: its output failed: KeyError: 'no such entry'. Its inputs then: u = 3.0. "
        "Correct the function."
    )
    assert isinstance(caught.value.__cause__, KeyError)
    assert not found.failures
    raise_failure(found.failures, "box.broken")  # nothing to raise


def test_the_last_failure_is_kept():
    def broken(u):
        raise ValueError(f"not {u}")

    found = traced(PythonFunction(broken, results={"y": ()}))
    for u in (1.0, 2.0, 3.0):
        found.function(0.0, [], u, [np.nan])
    assert len(found.failures) == 1
    with pytest.raises(SimulationError, match=r"ValueError: not 3\.0"):
        raise_failure(found.failures, "broken")


def test_an_interrupt_is_kept_as_it_is():
    def stopped(u):
        if u > 0.0:
            raise KeyboardInterrupt
        raise ValueError

    found = traced(PythonFunction(stopped, results={"y": ()}))
    found.function(0.0, [], 1.0, [np.nan])
    found.function(0.0, [], -1.0, [np.nan])
    with pytest.raises(KeyboardInterrupt):
        raise_failure(found.failures, "stopped")


def test_another_shape_than_at_first_is_an_error():
    found = traced(PythonFunction(lambda u: np.zeros(2 if u > 3.0 else 1)))
    assert np.isnan(flat(found.function(0.0, [], 4.0, [np.nan])[0])).all()
    with pytest.raises(
        SimulationError, match=r"f\.y, t = 0 s: .*its output gives shape \(2,\); expected \(1,\)"
    ) as caught:
        raise_failure(found.failures, "f")
    assert isinstance(caught.value.__cause__, ShapeError)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda u: 1.0 / (u - 1.0).item() / 0, "its output failed when it was tried with 1, 1/2.*ZeroDiv"),
        (lambda u: None, "its output returned nothing; expected the value of y"),
        (lambda u: "high", "its output returned a str for y; expected numbers"),
    ],
)
def test_a_trial_that_fails_says_so_when_the_diagram_is_built(function, message):
    with pytest.raises(TraceError, match=f"function.*: {message}"):
        traced(PythonFunction(function))


def test_an_argument_too_many_is_an_error_that_tells_all():
    with pytest.raises(LoopwrightError, match="failed when it was tried .*TypeError"):
        traced(PythonFunction(product, arguments="a"))
