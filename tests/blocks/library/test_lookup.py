"""Tables as blocks, against NumPy's and SciPy's interpolation."""

import pickle

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator, RegularGridInterpolator

from loopwright.blocks import GuardError, Lookup1D, Lookup2D, ParameterError, ShapeError
from loopwright.blocks.tracing.symbols import bundle
from support.switching import Driven

RNG = np.random.default_rng(4)
POINTS = np.array([-2.0, -0.5, 0.0, 1.0, 4.0])
VALUES = np.array([1.0, 3.0, -1.0, 0.0, 2.0])
TABLE = {"breakpoints": POINTS, "values": VALUES}
INSIDE = np.concatenate([POINTS, RNG.uniform(-2.0, 4.0, 60)])
ORACLES = {"cubic": CubicSpline, "monotone": PchipInterpolator}


def held(value):
    return lambda t: np.asarray(value, dtype=float)


def value(block, *u, sampled=False):
    run = Driven(block, sampled, **{name: held(v) for name, v in zip(block.inputs, u, strict=True)})
    made = run.outputs(0.0)["y"]
    value.guards = run.guards
    return made


def slope(block, *u):
    """The traced derivative of a scalar table."""
    traced = Driven(block, False, **{n: lambda t: 0.0 for n in block.inputs}).traced
    symbols = [ca.MX.sym(n) for n in block.inputs]
    y = traced.function(0.0, ca.MX(0, 1), *symbols, traced.pack(block, np.nan))[0]
    return np.array(ca.Function("slope", symbols, [ca.jacobian(y, ca.vertcat(*symbols))])(*u)).ravel()


# --- one input ----------------------------------------------------------------------------------------------------------


def test_a_linear_table_is_numpys():
    for u in INSIDE:
        assert value(Lookup1D(**TABLE), u) == pytest.approx(np.interp(u, POINTS, VALUES), abs=1e-14)


@pytest.mark.parametrize("interpolation", ORACLES)
def test_a_cubic_table_is_scipys_with_its_slope(interpolation):
    oracle, block = ORACLES[interpolation](POINTS, VALUES), Lookup1D(interpolation=interpolation, **TABLE)
    for u in INSIDE[:25]:
        assert value(block, u) == pytest.approx(float(oracle(u)), abs=1e-13)
        if u not in POINTS:
            assert slope(block, u) == pytest.approx(float(oracle(u, 1)), abs=1e-12)


@pytest.mark.parametrize("interpolation", ["linear", *ORACLES])
def test_beyond_its_ends_a_table_holds_or_goes_on(interpolation):
    hold = Lookup1D(interpolation=interpolation, **TABLE)
    assert [float(value(hold, u)) for u in (-9.0, 9.0)] == pytest.approx([1.0, 2.0], abs=1e-14)
    further = hold.replace(beyond="extrapolate")
    oracle = ORACLES.get(interpolation)
    for u in (-3.0, 5.5):
        end = 0 if u < 0 else -1
        line = VALUES[end] + (u - POINTS[end]) * (np.diff(VALUES) / np.diff(POINTS))[end]
        want = line if oracle is None else float(oracle(POINTS, VALUES)(u))
        assert value(further, u) == pytest.approx(want, rel=1e-12)


def test_a_vector_is_looked_up_entry_by_entry():
    u = np.array([-1.0, 0.5, 3.0])
    np.testing.assert_allclose(value(Lookup1D(**TABLE), u), np.interp(u, POINTS, VALUES), rtol=0, atol=1e-14)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_values_may_be_vectors(interpolation):
    rows = np.stack([VALUES, VALUES**2, POINTS], axis=1)
    block = Lookup1D(breakpoints=POINTS, values=rows, interpolation=interpolation)
    for u in INSIDE[:20]:
        want = [float(np.squeeze(value(block.replace(values=column), u))) for column in rows.T]
        np.testing.assert_allclose(value(block, u), want, rtol=0, atol=1e-13)
    with pytest.raises(
        ShapeError, match=r"lookup_1d\.u: found shape \(2,\); expected a scalar, since the values are vectors"
    ):
        value(block, np.zeros(2))


def test_leaving_the_table_is_an_error_where_asked_for():
    block = Lookup1D(beyond="error", **TABLE)
    for u, ok in ((-2.0, True), (4.0, True), (-2.001, False), (4.001, False), (np.nan, False)):
        value(block, u)
        assert bool(np.all(value.guards > 0)) == ok
    value(block, np.array([0.0, 5.0]))
    assert (value.guards > 0).tolist() == [True, True, True, False]
    traced = Driven(block, False, u=lambda t: np.zeros(2)).traced
    assert traced.guards == ("u[1] below", "u[1] above", "u[2] below", "u[2] above")
    error = block.guard_error("u[2] above", -1.0, bundle("u", {"u": np.array([0.0, 5.0])}), None)
    assert isinstance(error, GuardError)
    assert str(error).startswith(
        "u: found u[2] = 5, above the table's range; expected -2 to 4. Extend the table, or give"
    )
    error = block.guard_error("u below", -1.0, bundle("u", {"u": np.float64(-3.5)}), None)
    assert str(error).startswith("u: found u = -3.5, below the table's range; expected -2 to 4.")


def test_a_table_of_two_points_is_a_line():
    for interpolation in ("linear", *ORACLES):
        block = Lookup1D(breakpoints=(1.0, 3.0), values=(0.0, 4.0), interpolation=interpolation, beyond="extrapolate")
        assert value(block, 2.5) == pytest.approx(3.0, abs=1e-14)


# --- two inputs ---------------------------------------------------------------------------------------------------------

ROWS, COLUMNS = np.array([0.0, 1.0, 3.0]), np.array([-1.0, 0.0, 0.5, 2.0])
GRID = RNG.standard_normal((3, 4))


def test_a_table_of_two_inputs_is_scipys():
    oracle = RegularGridInterpolator((ROWS, COLUMNS), GRID, bounds_error=False, fill_value=None)
    block = Lookup2D(rows=ROWS, columns=COLUMNS, values=GRID, beyond="extrapolate")
    for a, b in (*RNG.uniform((-2.0, -3.0), (5.0, 4.0), (80, 2)), *((a, b) for a in ROWS for b in COLUMNS)):
        assert value(block, a, b) == pytest.approx(float(oracle((a, b))), abs=1e-13)


def test_its_slopes_are_those_of_the_cell():
    block = Lookup2D(rows=ROWS, columns=COLUMNS, values=GRID)
    a, b = 2.0, 0.2
    alpha, beta = 0.5, 0.4
    cell = GRID[1:, 1:3]
    want = [
        ((1 - beta) * (cell[1, 0] - cell[0, 0]) + beta * (cell[1, 1] - cell[0, 1])) / 2.0,
        ((1 - alpha) * (cell[0, 1] - cell[0, 0]) + alpha * (cell[1, 1] - cell[1, 0])) / 0.5,
    ]
    assert slope(block, a, b) == pytest.approx(want, abs=1e-14)


def test_beyond_its_edges_it_holds_or_stops():
    block = Lookup2D(rows=ROWS, columns=COLUMNS, values=GRID)
    assert value(block, 9.0, -9.0) == pytest.approx(GRID[-1, 0], abs=1e-15)
    assert value(block, 1.0, 9.0) == pytest.approx(GRID[1, -1], abs=1e-15)
    strict = block.replace(beyond="error")
    value(strict, 1.0, 2.5)
    assert (value.guards > 0).tolist() == [True, True, True, False]
    error = strict.guard_error("u2 above", -0.5, bundle("u", {"u1": np.float64(1.0), "u2": np.float64(2.5)}), None)
    assert str(error).startswith("u2: found u2 = 2.5, above the table's range; expected -1 to 2.")


@pytest.mark.parametrize("shape", [(2, 2), (2, 3), (3, 2)])
def test_small_tables_of_two_inputs(shape):
    values = RNG.standard_normal(shape)
    block = Lookup2D(rows=np.arange(shape[0]), columns=np.arange(shape[1]), values=values)
    assert value(block, 0.5, 0.5) == pytest.approx(values[:2, :2].mean(), abs=1e-15)


# --- all of them --------------------------------------------------------------------------------------------------------

FLAT = Lookup2D(rows=ROWS, columns=COLUMNS, values=GRID)


def test_what_is_no_number_passes_through():
    for beyond in ("hold", "extrapolate"):
        for interpolation in ("linear", *ORACLES):
            assert np.isnan(value(Lookup1D(interpolation=interpolation, beyond=beyond, **TABLE), np.nan))
        for given in ((np.nan, 0.0), (0.0, np.nan)):
            assert np.isnan(value(FLAT.replace(beyond=beyond), *given))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (
            lambda: Lookup1D(breakpoints=(0.0, 0.0), values=(1.0, 2.0)),
            r"breakpoints: found \[0\.0, 0\.0\]; expected at least two",
        ),
        (lambda: Lookup1D(breakpoints=(0.0,), values=(1.0,)), r"breakpoints: found \[0\.0\]; expected at least two"),
        (
            lambda: Lookup1D(breakpoints=(0.0, 1.0), values=(1.0, 2.0, 3.0)),
            r"values: found shape \(3,\) for 2 breakpoints",
        ),
        (
            lambda: Lookup1D(interpolation="spline", **TABLE),
            r"interpolation: found 'spline'; expected 'linear', 'cubic' or",
        ),
        (lambda: Lookup1D(beyond="holds", **TABLE), r"beyond: found 'holds'; expected 'hold', .*Did you mean 'hold'\?"),
        (
            lambda: FLAT.replace(values=GRID.T),
            r"values: found shape \(4, 3\); expected \(3, 4\), a row for each of rows",
        ),
        (
            lambda: FLAT.replace(columns=(3.0, 2.0, 1.0, 0.0)),
            r"columns: found \[3\.0, 2\.0, 1\.0, 0\.0\]; expected at least",
        ),
    ],
)
def test_tables_that_are_none_are_refused(make, text):
    with pytest.raises(ParameterError, match=text):
        make()


@pytest.mark.parametrize("block", [Lookup1D(interpolation="cubic", **TABLE), FLAT], ids=lambda b: type(b).__name__)
def test_they_are_values(block):
    assert pickle.loads(pickle.dumps(block)) == block
    assert block.replace() == block
    assert block.replace(beyond="error") != block
