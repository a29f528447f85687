"""Operators and NumPy's functions on signals: NumPy's numbers, units that follow, names, kinks and events."""

import pickle

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    DeadZone,
    Function,
    Gain,
    Input,
    Minimum,
    Output,
    Power,
    Saturation,
    ShapeError,
    Sine,
    Stack,
    Switch,
    UnitError,
    Wall,
)
from loopwright.blocks.core.numpy_functions import RULES
from loopwright.diagrams import Diagram, check_block, subsystem

A, B = np.array([0.3, -0.7, 0.9]), np.array([0.5, 0.4, -0.6])
M = np.array([[1.0, 2.0, 0.5], [0.0, -1.0, 3.0]])
OPERATIONS = {
    "quotient": lambda a, b: a / b,
    "inverse": lambda a, b: 1.0 / a,
    "by array": lambda a, b: np.array([1.0, 2.0, 3.0]) / a,
    "square": lambda a, b: a**2,
    "inverse square": lambda a, b: a**-2,
    "power": lambda a, b: np.abs(a) ** b,
    "exponential": lambda a, b: 2.0**a,
    "abs": lambda a, b: abs(a),
    "plus": lambda a, b: +a,
    "below": lambda a, b: 1.0 * (a < b),
    "at most": lambda a, b: 1.0 * (a <= 0.3),
    "above": lambda a, b: 1.0 * (np.array([0.0, -1.0, 0.0]) > a),
    "at least": lambda a, b: 1.0 * (a >= b),
    "logic": lambda a, b: 1.0 * (((a > 0) & (b > 0)) | ~(a > 0)),
    "sin": lambda a, b: np.sin(a),
    "exp": lambda a, b: np.exp(a),
    "sqrt": lambda a, b: np.sqrt(np.square(a)),
    "minimum": lambda a, b: np.minimum(a, b),
    "maximum": lambda a, b: np.maximum(0.1, b),
    "hypot": lambda a, b: np.hypot(a, 2.0),
    "arctan2": lambda a, b: np.arctan2(a, b),
    "clip": lambda a, b: np.clip(a, -0.5, 0.5),
    "clip by signals": lambda a, b: np.clip(a, -abs(b), 0.8),
    "where": lambda a, b: np.where(a > 0, a, b),
    "stack": lambda a, b: np.stack([a, b]),
    "stack along the last axis": lambda a, b: np.stack([a, b], axis=1),
    "stack of entries": lambda a, b: np.stack([a[0], b[2]]),
    "concatenate": lambda a, b: np.concatenate([a, b, [7.0]]),
    "sum": lambda a, b: np.sum(a),
    "sum along an axis": lambda a, b: np.sum(np.stack([a, b]), axis=0),
    "mean": lambda a, b: np.mean(a),
    "norm": lambda a, b: np.linalg.norm(a),
    "max": lambda a, b: np.max(a),
    "matrix": lambda a, b: M @ a,
    "dot matrix": lambda a, b: np.dot(M, a),
    "row": lambda a, b: np.array([1.0, 2.0, 3.0]) @ a,
    "inner": lambda a, b: a @ b,
    "dot": lambda a, b: np.dot(a, b),
    "from the right": lambda a, b: a @ M.T,
    "cross": lambda a, b: np.cross(a, b),
    "outer": lambda a, b: np.outer(a, b),
    "polyval": lambda a, b: np.polyval([1.0, -2.0, 0.5], a),
    "broadcast": lambda a, b: M / a,
    "reshape": lambda a, b: np.reshape(a, (3, 1)) / b,
    "lists": lambda a, b: a * [2.0, 4.0, 8.0] / [1.0, 2.0, 3.0],
}


def test_operators_and_functions_have_numpys_numbers():
    a, b = Constant(value=A, name="a"), Constant(value=B, name="b")
    names = {key: f"r{i}" for i, key in enumerate(OPERATIONS)}

    @subsystem(sample_time=0.1)
    def box(a, b):
        return tuple(f(a, b).named(names[key]) for key, f in OPERATIONS.items())

    diagram = Diagram("d", *box(a, b))
    run = diagram.simulate(0.1, progress=False)
    again = pickle.loads(pickle.dumps(diagram)).simulate(0.1, progress=False)
    for key, operation in OPERATIONS.items():
        want = np.asarray(operation(A, B), dtype=float)
        found = run[f"box.{names[key]}"][-1]
        assert found.shape == want.shape, key
        np.testing.assert_allclose(found, want, rtol=1e-14, atol=1e-16, err_msg=key)
        assert np.array_equal(again[f"box.{names[key]}"][-1], found), key


@pytest.mark.slow
@pytest.mark.parametrize("function", [f for f in RULES if isinstance(f, np.ufunc)], ids=lambda f: f.__name__)
def test_blocks_of_numpys_functions_keep_the_contract(function):
    away = {"shapes": {"u1": (3,), "u2": (3,)}} if function is np.matmul else {}
    ranges = {np.arccosh: (1.1, 3.0)}.get(function, (0.1, 0.9))
    block = Function(function)
    check_block(block, **away, **({} if away else {"inputs": dict.fromkeys(block.inputs, ranges)}))
    numbers = [np.array([1.3, 1.7, 2.1]) if function is np.arccosh else np.array([0.3, 0.7, 0.2])] * len(block.inputs)
    run = Diagram("d", block(*numbers).named("y")).simulate(0.1, step=0.1, progress=False)
    np.testing.assert_allclose(run["y"][-1], function(*numbers), rtol=1e-14)


# --- units -----------------------------------------------------------------------------------------------------------


class Pair(Block):
    """Two entries, each in a unit."""

    units: object
    u = Input()

    @property
    def outputs(self):
        return {"y": Output(shape=(2,), unit=self.units, name="y")}

    def output(self, t, x, u):
        return np.stack([u.u, u.u])


def of(unit):
    return Constant(value=0.5, unit=unit) if isinstance(unit, str) else Pair(units=unit)(0.5)


def alternating_sum(n):
    """T - T + T …, where each second one comes later: until then a sum may be a temperature or a difference."""
    total = of("degC")
    for _ in range(n):
        late = Saturation(limit=100.0)(Saturation(limit=100.0)(total))
        total = total - late + late
    return total


@pytest.mark.parametrize(
    ("make", "unit"),
    [
        (lambda: of("m") / of("s"), "m/s"),
        (lambda: of("m/s") / of("s"), "m/s2"),
        (lambda: of("N") * of("m"), "N.m"),
        (lambda: of("N.m") / of("m"), "N"),
        (lambda: of("m") / of("m"), "1"),
        (lambda: of("m") ** 2, "m2"),
        (lambda: of("m2") ** 0.5, "m"),
        (lambda: of("m") ** 0.5, None),
        (lambda: of("s") ** -1, "1/s"),
        (lambda: np.sqrt(of("m2/s2")), "m/s"),
        (lambda: np.reciprocal(of("V/A")), "A/V"),
        (lambda: abs(of("m")), "m"),
        (lambda: np.hypot(of("m"), of("m")), "m"),
        (lambda: np.minimum(of("m"), of("m")), "m"),
        (lambda: np.clip(of("m"), 0.0, 1.0), "m"),
        (lambda: np.where(of("m") > of("m"), of("N"), of("N")), "N"),
        (lambda: np.where(of("m") > 0.0, Constant(value=1.0), of("N")), "N"),
        (lambda: np.sin(of("rad")), "1"),
        (lambda: np.sin(np.radians(of("deg"))), "1"),
        (lambda: np.arcsin(of("1")), "rad"),
        (lambda: np.arctan2(of("m"), of("m")), "rad"),
        (lambda: np.stack([of("m"), of("m")]), "m"),
        (lambda: np.stack([of("m"), of("s")]), ("m", "s")),
        (lambda: Stack(count=3)(of(("m", "m")), of("s"), of(("s", "s"))[1]), ("m", "m", "s", "s")),
        (lambda: Stack()(of("m"), Constant(value=2.0)), None),
        (lambda: Stack()(of("degC") - of("degC"), of("degC")), ("K", "degC")),
        (lambda: np.sum(of(("m", "m"))), "m"),
        (lambda: of(("m", "rad")) / of("s"), ("m/s", "rad/s")),
        (lambda: of("m") / Constant(value=2.0), None),
        (lambda: 2.0 * of("m"), None),
        (lambda: of("K") * of("W"), "K.W"),
        (lambda: of("degC") - of("degC"), "K"),
        (lambda: of("degC") + of("degC"), None),
        (lambda: of("degC") + 2.0, "degC"),
        (lambda: 2.0 + of("degC"), "degC"),
        (lambda: of("degC") - 2.0, None),
        (lambda: (of("degC") - of("degC")) * of("W/K"), "W"),
        (lambda: of("degC") + Saturation(limit=1.0)(of("degC") - of("degC")), "degC"),
        (lambda: of(("degC", "m")) - of(("degC", "m")), ("K", "m")),
        (lambda: alternating_sum(20), "degC"),
        (lambda: np.mean(of(("degC", "degC"))), "degC"),
        (lambda: np.sum(of(("degC", "degC"))), None),
        (lambda: np.ptp(of(("degC", "degC"))), "K"),
        (lambda: np.minimum(of("degC"), of("degC")), "degC"),
        (lambda: Saturation(limit=0.1)(of("degC")).excess, "K"),
        (lambda: DeadZone(limit=0.1)(of("degC")), "K"),
        (lambda: of("degC") * of("W"), None),
    ],
)
def test_units_follow(make, unit):
    assert Diagram("d", make().named("y")).simulate(0.1, step=0.1, progress=False).unit("y") == unit


def test_an_angle_in_a_product_counts_with_and_without_rad():
    """The speed r ω of a wheel is in m/s, though ω is in rad/s; an arc r ω t is a length, and no number."""
    speed = (of("m") * of("rad/s")).named("v")
    wall = Wall(stiffness=1.0, damping=1.0, point=0.0, normal=1.0)
    Diagram("d", wall(position=of("m"), velocity=speed))
    with pytest.raises(UnitError, match=r"are of different dimensions"):
        Diagram("d", wall(position=speed, velocity=of("m/s")))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: np.sin(of("deg")), r"sin_of_constant\.u: constant\.y is in deg; expected rad or 1, as np\.sin takes"),
        (lambda: np.sin(of("s")), r"constant\.y is in s; expected rad or 1"),
        (lambda: np.exp(of("m")), r"is in m; expected 1 or rad, as np\.exp takes a pure number"),
        (
            lambda: np.hypot(of("m"), of("mm")),
            r"u2: constant_2\.y is in mm; expected m as u1 is, .*Gain\(gain=0\.001\)",
        ),
        (lambda: of("m") < of("s"), r"constant_2\.y is in s; .* in m: .*different dimensions"),
        (lambda: np.minimum(of("m"), of("mm")), r"differ by a factor of 0\.001"),
        (
            lambda: np.where(1.0 * of("m") > 0.0, of("m"), of("s")),
            r"otherwise: constant_4\.y is in s; constant_3\.y next to it is in m",
        ),
        (lambda: of("1") ** of("s"), r"u2: constant_2\.y is in s; expected 1, as np\.power takes a pure number as exp"),
        (lambda: np.arcsin(of("rad")), r"expected 1, as np\.arcsin"),
    ],
)
def test_units_that_do_not_fit_are_refused(make, text):
    with pytest.raises(UnitError, match=text):
        Diagram("d", make().named("y"))


# --- blocks and their names --------------------------------------------------------------------------------------------


def test_operators_make_the_blocks_of_the_library_with_readable_paths():
    a, b = Gain(gain=1.0, name="a")(2.0), Gain(gain=1.0, name="b")(3.0).named("speed")
    made = {
        "a_over_speed": (a / b, Function(np.divide)),
        "square_of_a": (a**2, Power(exponent=2)),
        "abs_of_a": (abs(a), Function(np.absolute)),
        "sin_of_a": (np.sin(a), Function(np.sin)),
        "least_of_a_and_speed": (np.minimum(a, b), Minimum()),
        "limited_a": (np.clip(a, 0.0, 1.0), Saturation(lower=0.0, upper=1.0)),
        "a_if_a_above_speed_else_speed": (np.where(a > b, a, b), Switch()),
        "a_and_speed": (np.concatenate([a, b]), Stack()),
        "sum_of_a": (np.sum(a), Function(np.sum, arguments=("u",))),
    }
    diagram = Diagram("d", *(signal for signal, _ in made.values()))
    for path, (_, block) in made.items():
        assert diagram.blocks[path] == block, path
    long = a
    for _ in range(8):
        long = long / b
    assert max(map(len, Diagram("d", long).blocks)) <= 48


def test_a_list_of_signals_is_a_vector_wherever_one_is_expected():
    a, b = Constant(value=2.0, name="a"), Constant(value=3.0, name="b")
    K = np.array([[1.0, 10.0]])
    run = Diagram("d", Gain(gain=K, name="k")([a, b]), (K @ np.stack([a, b])).named("y")).simulate(
        0.1, step=0.1, progress=False
    )
    assert run["k.y"][-1].tolist() == run["y"][-1].tolist() == [32.0]


def test_rows_of_different_shapes_are_refused():
    with pytest.raises(ShapeError, match=r"u2: found shape \(2,\) next to \(3,\); expected rows of one shape"):
        Diagram("d", np.stack([Constant(value=A), Constant(value=A[:2])]))


def test_a_row_times_a_vector_is_their_inner_product():
    """A row times a vector was an element-by-element gain, without a word."""
    run = Diagram("d", (np.array([1.0, 2.0]) @ Constant(value=(3.0, 4.0))).named("y")).simulate(
        0.1, step=0.1, progress=False
    )
    assert run["y"][-1] == 11.0


# --- events, kinks, slopes ---------------------------------------------------------------------------------------------


def test_comparisons_are_events_that_a_run_locates():
    wave = Sine(frequency=0.25, name="wave")  # sin(πt/2): above 0.5 from 1/3 s to 5/3 s
    run = Diagram("d", np.where(wave > 0.5, wave, 0.0).named("y")).simulate(2.0, progress=False, rtol=1e-10)
    times = [e.t for e in run.events if e.block == "wave_above_constant"]
    np.testing.assert_allclose(times, [1 / 3, 5 / 3], atol=1e-9)


def test_a_kink_is_found_at_the_operating_point_and_slopes_are_exact_beside_it():
    u = Constant(value=0.0, name="u")
    y = abs(np.stack([u, u])).named("y")
    model = Diagram("d", y).linearize(inputs=["u.y"], outputs=["y"])
    assert any("abs_of_u_and_u" in str(finding) for finding in model.findings)
    for value in (0.3, -0.7):
        u = Constant(value=value, name="u")
        both = np.stack([abs(u), np.minimum(u, 0.0), u**3, np.sin(u) / np.exp(u)]).named("y")
        model = Diagram("d", both).linearize(inputs=["u.y"], outputs=["y"])
        want = [np.sign(value), float(value < 0), 3 * value**2, np.exp(-value) * (np.cos(value) - np.sin(value))]
        np.testing.assert_allclose(model.system.D[:, 0], want, rtol=1e-14)
