"""Comparison, logic, switch, edges, latch and counter, at ticks and by events, against Python's own logic."""

import operator
import pickle
from itertools import product

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import (
    And,
    Compare,
    Counter,
    EdgeDetector,
    Latch,
    Not,
    Or,
    ParameterError,
    SampleTimeError,
    ShapeError,
    Switch,
)
from support.switching import Driven, at_ticks, in_time

RNG = np.random.default_rng(5)
T = 0.1
RELATIONS = {">": operator.gt, "<": operator.lt, ">=": operator.ge, "<=": operator.le}


def of(value):
    return lambda t: value


def bits(n, size=()):
    made = (RNG.random((n, *size)) < 0.4).astype(float)
    return lambda t: made[round(t / T)], made


# --- comparison ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("relation", RELATIONS)
def test_a_comparison_is_pythons_at_ties_too(relation):
    a, b = np.array([-1.0, 0.0, 1.0, 2.0, 2.0]), np.array([-1.0, 1.0, 0.0, 2.0, 3.0])
    y = at_ticks(Compare(relation), T, 1, u1=of(a), u2=of(b))["y"][0]
    assert y.tolist() == [float(RELATIONS[relation](p, q)) for p, q in zip(a, b, strict=True)]
    for p, q in zip(a, b, strict=True):
        assert in_time(Compare(relation), 0.1, u1=of(p), u2=of(q))[0](0.0)["y"] == float(RELATIONS[relation](p, q))


@pytest.mark.parametrize("relation", RELATIONS)
def test_a_comparison_changes_at_the_crossing(relation):
    outputs, log = in_time(Compare(relation), 4.0, u1=lambda t: np.sin(2.0 * t), u2=lambda t: 0.1 * t)
    for t in RNG.uniform(0.0, 4.0, 300):
        assert outputs(t)["y"] == float(RELATIONS[relation](np.sin(2.0 * t), 0.1 * t))
    roots = [brentq(lambda t: np.sin(2.0 * t) - 0.1 * t, *bracket, xtol=1e-15) for bracket in ((1.0, 2.0), (3.0, 4.0))]
    assert [t for t, _ in log if t > 1e-9] == pytest.approx(roots, abs=1e-14)  # both sides are equal at t = 0, too


def test_a_comparison_is_with_zero_unless_told_and_takes_scalars_beside_vectors():
    assert at_ticks(Compare("<"), T, 1, u1=of(np.array([-1.0, 1.0])))["y"][0].tolist() == [1.0, 0.0]
    assert at_ticks(Compare(), T, 1, u1=of(1.5), u2=of(np.array([1.0, 2.0])))["y"][0].tolist() == [1.0, 0.0]


def test_an_unknown_relation_is_refused():
    with pytest.raises(ParameterError, match=r"compare\.relation: found '=='; expected one of >, <, <=, >=\. Equality"):
        Compare("==")


# --- and, or, not, switch -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("sampled", [True, False], ids=["sampled", "continuous"])
def test_and_or_follow_the_truth_table_at_once(count, sampled):
    for values in product((0.0, 1.0), repeat=count):
        given = {f"u{i + 1}": of(value) for i, value in enumerate(values)}
        assert Driven(And(count=count), sampled, T, **given).outputs(0.0)["y"] == float(all(values))
        assert Driven(Or(count=count), sampled, T, **given).outputs(0.0)["y"] == float(any(values))


def test_true_is_above_one_half():
    u = of(np.array([-3.0, 0.0, 0.5, 0.5 + 1e-12, 7.0]))
    truth = [0.0, 0.0, 0.0, 1.0, 1.0]
    assert at_ticks(And(count=1), T, 1, u1=u)["y"][0].tolist() == truth
    assert at_ticks(Or(count=1), T, 1, u1=u)["y"][0].tolist() == truth
    assert at_ticks(Not(), T, 1, u=u)["y"][0].tolist() == [1.0 - v for v in truth]
    assert at_ticks(Switch(), T, 1, condition=u, then=of(2.0), otherwise=of(-1.0))["y"][0].tolist() == [
        2.0 if v else -1.0 for v in truth
    ]


def test_a_switch_gives_one_branch_whatever_the_other_is():
    y = at_ticks(Switch(), T, 1, condition=of(1.0), then=of(np.array([1.0, 2.0])), otherwise=of(np.nan))["y"][0]
    assert y.tolist() == [1.0, 2.0]
    y = at_ticks(Switch(), T, 1, condition=of(0.0), then=of(np.full(2, np.nan)), otherwise=of(4.0))["y"][0]
    assert y.tolist() == [4.0, 4.0]


def test_the_solver_lands_where_a_condition_changes():
    _, log = in_time(Switch(), 3.0, condition=lambda t: float(t >= 1.234), then=np.sin, otherwise=of(0.0))
    assert log == [(pytest.approx(1.234, abs=1e-15), ("change",))]
    _, log = in_time(And(), 3.0, u1=lambda t: float(t >= 1.0), u2=lambda t: float(t < 2.0))
    assert log == [(pytest.approx(1.0, abs=1e-15), ("change1",)), (pytest.approx(2.0, abs=1e-15), ("change2",))]


# --- edges --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("edge", "sign"), [("rising", 1), ("falling", -1), ("both", 0)])
def test_an_edge_is_one_at_the_tick_of_the_change_only(edge, sign):
    signal, u = bits(200, (2,))
    y = at_ticks(EdgeDetector(edge=edge), T, len(u), u=signal)["y"]
    change = np.diff(u, axis=0, prepend=u[:1])
    np.testing.assert_array_equal(y, (change == sign) if sign else (change != 0))
    assert 20 < y.sum() < 300


def test_the_first_tick_shows_an_edge_only_where_the_value_before_is_told():
    assert at_ticks(EdgeDetector(), T, 2, u=of(1.0))["y"].tolist() == [0.0, 0.0]
    assert at_ticks(EdgeDetector(initial_value=0.0), T, 2, u=of(1.0))["y"].tolist() == [1.0, 0.0]


def test_an_edge_has_no_place_in_continuous_time():
    with pytest.raises(
        SampleTimeError, match="edge_detector: a sampled block is in a continuous subsystem; put it into"
    ):
        Driven(EdgeDetector(), False, u=np.sin)


def test_an_unknown_edge_is_refused():
    with pytest.raises(ParameterError, match=r"edge_detector\.edge: found 'risng'; expected 'rising', .*mean 'rising'"):
        EdgeDetector(edge="risng")


# --- latch and counter --------------------------------------------------------------------------------------------------


def test_a_latch_keeps_what_it_was_set_to_and_reset_goes_first():
    (set_, s), (reset, r) = bits(200, (2,)), bits(200)
    y = at_ticks(Latch(), T, 200, set=set_, reset=reset)["y"]
    kept = np.zeros(2)
    for k in range(200):
        kept = np.array([0.0 if r[k] else 1.0 if s[k, i] else kept[i] for i in range(2)])
        np.testing.assert_array_equal(y[k], kept)


def test_a_latch_keeps_a_short_pulse_by_events():
    pulse = lambda t: float(0.5 <= t < 0.5 + 2e-2)  # noqa: E731
    outputs, log = in_time(Latch(), 3.0, set=pulse, reset=lambda t: float(2.0 <= t < 2.1))
    assert [outputs(t)["y"] for t in (0.49, 0.5, 1.9, 2.0, 2.9)] == [0.0, 1.0, 1.0, 0.0, 0.0]
    assert [t for t, _ in log] == pytest.approx([0.5, 0.52, 2.0, 2.1], abs=1e-14)


def test_a_latch_is_set_once_the_reset_that_went_first_is_over():
    given = {"set": lambda t: float(1.0 <= t < 3.0), "reset": lambda t: float(0.5 <= t < 2.0)}
    outputs, _ = in_time(Latch(), 4.0, **given)
    assert [outputs(t)["y"] for t in (0.9, 1.5, 2.0, 3.5)] == [0.0, 0.0, 1.0, 1.0]


def test_a_latch_may_begin_set():
    assert at_ticks(Latch(initial_value=1.0), T, 2, set=of(0.0))["y"].tolist() == [1.0, 1.0]


def test_a_counter_counts_what_becomes_true():
    (signal, u), (_, r) = bits(300), bits(300)
    rare = r * (np.arange(300) % 17 == 0)
    y = at_ticks(Counter(), T, 300, u=signal, reset=lambda t: rare[round(t / T)])["y"]
    count = 0
    for k in range(300):
        count = 0 if rare[k] else count + (k > 0 and u[k] > u[k - 1])
        assert y[k] == count
    assert y.max() > 3


def test_a_counter_counts_by_events():
    square = lambda t: float(np.sin(2.0 * np.pi * t) > 0.0)  # noqa: E731
    outputs, _ = in_time(Counter(), 6.0, u=lambda t: square(t - 0.25), reset=lambda t: float(3.6 <= t < 3.7))
    counts = [float(outputs(t)["y"]) for t in (0.1, 0.3, 1.3, 2.3, 3.3, 3.65, 4.0, 4.3, 5.3)]
    assert counts == [0, 1, 2, 3, 4, 0, 0, 1, 2]


# --- all of them --------------------------------------------------------------------------------------------------------

ALL = [Compare("<"), And(), Or(), Not(), Switch(), Latch(), Counter(), EdgeDetector()]


@pytest.mark.parametrize("block", ALL, ids=lambda b: type(b).__name__)
def test_what_is_no_number_passes_through(block):
    first, *others = block.inputs
    given = {first: of(np.array([np.nan, 1.0]))} | dict.fromkeys(others, of(0.0))
    y = at_ticks(block, T, 1, **given)["y"][0]
    assert np.isnan(y).tolist() == [True, False]


@pytest.mark.parametrize("block", ALL[:7], ids=lambda b: type(b).__name__)
def test_a_vector_is_refused_in_a_continuous_frame(block):
    given = dict.fromkeys(block.inputs, of(np.zeros(2)))
    with pytest.raises(ShapeError, match=r"found shape \(2,\); expected a scalar in a continuous subsystem, where it"):
        Driven(block, False, **given)


@pytest.mark.parametrize("block", [Latch(), Counter()], ids=lambda b: type(b).__name__)
def test_a_reset_of_another_shape_is_refused(block):
    first = next(iter(block.inputs))
    with pytest.raises(ShapeError, match=rf"\.reset: found shape \(3,\); expected a scalar, or \(2,\) as {first} has"):
        Driven(block, True, T, **{first: of(np.zeros(2)), "reset": of(np.zeros(3))})


@pytest.mark.parametrize("block", ALL, ids=lambda b: type(b).__name__)
def test_they_are_values(block):
    assert pickle.loads(pickle.dumps(block)) == block
    assert block.replace() == block
