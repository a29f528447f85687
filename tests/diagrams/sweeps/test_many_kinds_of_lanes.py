"""Tables, algebraic loops and large diagrams go side by side in lanes: near closed forms, and near single runs."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, RegularGridInterpolator
from scipy.optimize import brentq

from loopwright.blocks import (
    DiscreteTransferFunction,
    Gain,
    Lookup1D,
    Lookup2D,
    PiecewiseLinear,
    Sine,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from support.lanes import QUIET, T, loop

LANES = 4
POINTS, VALUES = np.array([-1.0, -0.2, 0.3, 1.2]), np.array([2.0, -0.5, 0.25, 1.0])
GRID = np.array([[0.0, 1.0, -1.0], [2.0, 0.5, 1.0], [-1.0, 0.0, 3.0]])
SCALES = (0.3, 0.7, 1.0, 1.6, 2.2)


def sampled(inside, *, frequency=1.7, **options):
    """A diagram of a sine of some gain, and a subsystem that it goes through."""
    box = subsystem(sample_time=T, name="box")(inside)
    u = Gain(gain=1.0, name="scale")(Sine(frequency=frequency, name="wave"))
    return Diagram("sampled", u.named("u"), box(u).named("y"), **options)


def side_by_side(diagram, table, duration=0.5, signals=("u", "y")):
    """Return a sweep in lanes; all its runs go side by side."""
    found = diagram.sweep(None, duration, samples=table, signals=signals, lanes=LANES, workers=1, **QUIET)
    assert DIFFER in found.messages, found.messages
    assert not [text for text in found.messages if "Not side by side" in text]
    return found


@pytest.mark.parametrize(
    ("options", "exact"),
    [
        ({"interpolation": "linear"}, lambda u: np.interp(u, POINTS, VALUES)),
        ({"interpolation": "cubic"}, lambda u: CubicSpline(POINTS, VALUES)(np.clip(u, -1.0, 1.2))),
        ({"interpolation": "cubic", "beyond": "extrapolate"}, CubicSpline(POINTS, VALUES)),
    ],
)
def test_tables_are_looked_up_in_every_lane_as_by_scipy(options, exact):
    table = Lookup1D(breakpoints=POINTS, values=VALUES, name="table", **options)
    found = side_by_side(sampled(lambda u: table(u)), [{"scale.gain": k} for k in SCALES])
    assert np.abs(found["y"] - exact(found["u"])).max() <= 1e-13 * np.abs(found["y"]).max()


def test_tables_of_two_inputs_and_over_time_are_looked_up_in_every_lane():
    surface = Lookup2D(rows=(-1.0, 0.0, 1.0), columns=(-2.0, 0.5, 2.0), values=GRID, name="surface")
    ramp = PiecewiseLinear(times=(0.0, 0.2, 0.35), values=(1.0, -1.0, 0.5), name="ramp")
    found = side_by_side(sampled(lambda u: surface(u1=u, u2=ramp.y)), [{"scale.gain": k} for k in SCALES])
    v = np.interp(found.outcomes[0].t, (0.0, 0.2, 0.35), (1.0, -1.0, 0.5))
    exact = RegularGridInterpolator(((-1.0, 0.0, 1.0), (-2.0, 0.5, 2.0)), GRID)
    for u, y in zip(found["u"], found["y"], strict=True):
        assert np.abs(y - exact(np.stack([np.clip(u, -1.0, 1.0), v], axis=1))).max() <= 1e-14


def test_a_table_has_the_bits_of_a_single_compiled_run():
    table = Lookup1D(breakpoints=POINTS, values=VALUES, interpolation="monotone", name="table")
    diagram = sampled(lambda u: table(u), frequency=0.0)  # a sine of no frequency: u has the bits of its phase
    diagram = diagram.replace({"wave.phase": 1.0})
    table = [{"scale.gain": k} for k in SCALES]
    found, alone = (
        diagram.sweep(None, 0.1, samples=table, signals=["u", "y"], workers=1, lanes=lanes, **QUIET)
        for lanes in (LANES, False)
    )
    same = found["u"] == alone["u"]
    assert same.any()
    assert found["y"][same].tobytes() == alone["y"][same].tobytes()


def test_a_run_that_leaves_its_table_fails_as_a_single_one_and_harms_no_other():
    table = Lookup1D(breakpoints=POINTS, values=VALUES, beyond="error", name="table")
    diagram = sampled(lambda u: table(u))
    found = side_by_side(diagram, [{"scale.gain": k} for k in (0.5, 1.1, 0.9, 0.2, 0.3)])
    assert [f.index for f in found.failures] == [1]
    with pytest.raises(Exception, match="below the table's range") as info:
        diagram.replace({"scale.gain": 1.1}).simulate(0.5, **QUIET)
    assert found.failures[0].message == str(info.value)
    assert np.abs(found["y"][2] - np.interp(found["u"][2], POINTS, VALUES)).max() <= 1e-14


def implicit(u):
    """y = u − k y³, with k = 0.8."""
    k = Gain(gain=0.8, name="k")
    y = u - k.y
    k(y * y * y)
    return y


def test_algebraic_loops_are_solved_in_every_lane():
    diagram = sampled(implicit, loops="solve")
    found = side_by_side(diagram, [{"scale.gain": s, "k.gain": k} for s, k in ((1, 0.8), (3, 0.5), (0.1, 7.0))], 0.2)
    for sample, u, y in zip(found.samples, found["u"], found["y"], strict=True):
        k = sample.parameters["box.k.gain"]
        exact = [brentq(lambda v, now=now, k=k: v + k * v**3 - now, -9, 9, xtol=1e-15, rtol=1e-14) for now in u]
        assert np.abs(y - exact).max() <= 1e-12


def coupled(u):
    """y = u − a z, z = y + b y, w = z − c y, which come round in two loops of several values."""
    a, b, c = (Gain(gain=g, name=name) for g, name in ((0.3, "a"), (0.2, "b"), (0.7, "c")))
    y = u - a.y
    z = y + b.y - 0.5 * c.y
    a(z), b(y), c(z)
    return z


def test_coupled_loops_of_several_values_are_the_solution_of_their_equations():
    table = [
        {"a.gain": a, "b.gain": b, "c.gain": c} for a, b, c in ((0.3, 0.2, 0.7), (-2.0, 5.0, 0.1), (0.0, 1.0, -3.0))
    ]
    found = side_by_side(sampled(coupled, loops="solve"), table)
    for row, u, z in zip(table, found["u"], found["y"], strict=True):
        a, b, c = row.values()
        y = np.linalg.solve([[1.0, a], [-1.0 - b, 1.0 + 0.5 * c]], np.stack([u, 0.0 * u]))
        np.testing.assert_allclose(z, y[1], rtol=0, atol=1e-13 * np.abs(z).max())


def test_a_loop_that_is_not_determined_fails_as_a_single_run_and_harms_no_other():
    def around(u):
        k = Gain(gain=0.5, name="k")
        y = u - k.y
        k(y)
        return y

    diagram = sampled(around, loops="solve")
    gains = (0.5, -1.0, 2.0, -0.9)
    found = side_by_side(diagram, [{"k.gain": k} for k in gains])
    assert [f.index for f in found.failures] == [1]
    with pytest.raises(Exception, match="algebraic loop") as info:
        diagram.replace({"k.gain": -1.0}).simulate(0.5, **QUIET)
    assert found.failures[0].message == str(info.value)
    for i in (0, 2, 3):
        np.testing.assert_allclose(found["y"][i], found["u"][i] / (1.0 + gains[i]), rtol=0, atol=1e-12)


def look(run):
    """The largest residual, and the numbers of samples and of columns that a run has."""
    return np.array([run.residual.max(), len(run.residual), len(run.t), run.data.shape[1]])


def test_a_run_in_a_lane_has_the_residual_of_its_own_loops():
    diagram, table = sampled(implicit, loops="solve"), [{"scale.gain": s} for s in (1.0, 3.0, 0.0)]
    options = {"samples": table, "reduce": {"look": look}, "workers": 1, **QUIET}
    found, alone = (diagram.sweep(None, 0.2, lanes=lanes, **options)["look"] for lanes in (LANES, False))
    np.testing.assert_array_equal(found[:, 1:], alone[:, 1:])
    assert np.all(found[:, 0] <= 1e-9)  # as of a loop that counts as solved
    assert found[2, 0] == alone[2, 0]


def test_loops_around_a_plant_are_near_single_runs():
    def around(u):
        half = Gain(gain=0.5, name="half")
        y = u - half.y
        half(y)
        return y

    diagram, table = loop(more=around, loops="solve"), [{"kp.gain": k} for k in (0.5, 1.0, 2.5)]
    found = side_by_side(diagram, table, signals=("x", "u"))
    for row, x in zip(table, found["x"], strict=True):
        single = diagram.replace(row).simulate(0.5, **QUIET)["x"]
        assert np.abs(x - single).max() <= 1e-12 * np.abs(single).max()


def test_large_diagrams_go_side_by_side_as_groups_of_blocks():
    """A cascade of 60 filters, and 40 of vectors of 20: more than 2000 operations, of few kinds of blocks."""
    pole = 0.4

    def inside(u):
        y = u
        for i in range(60):
            y = DiscreteTransferFunction(numerator=(1.0 - pole,), denominator=(1.0, -pole), name=f"f{i}")(y)
        wide = Gain(gain=np.ones(20), name="spread")(u)
        for i in range(40):
            kept = UnitDelay(initial_value=np.zeros(20), name=f"kept{i}")
            wide = 0.5 * wide + 0.5 * kept.y
            kept(wide)
        return y, wide

    box = subsystem(sample_time=T, name="box")(inside)
    u = Gain(gain=1.0, name="scale")(Sine(frequency=1.7, name="wave"))
    y, wide = box(u)
    diagram = Diagram("cascade", u.named("u"), y.named("y"), wide.named("wide"))
    found = side_by_side(diagram, [{"scale.gain": k} for k in SCALES], 0.6, ("u", "y", "wide"))
    from scipy.signal import lfilter

    for u, y, wide in zip(found["u"], found["y"], found["wide"], strict=True):
        late, mixed = u, u
        for _ in range(60):
            late = np.concatenate([[0.0], lfilter([1.0 - pole], [1.0, -pole], late)[:-1]])
        for _ in range(40):
            mixed = lfilter([0.5], [1.0, -0.5], mixed)
        assert np.abs(y - late).max() <= 1e-12
        assert np.abs(wide - mixed[:, None]).max() <= 1e-12
