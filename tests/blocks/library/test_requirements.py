"""Requirements and stop conditions: what breaks them, when, and what is said."""

import pickle

import numpy as np
import pytest

from loopwright.blocks import GuardError, ParameterError, Requirement, ShapeError, SimulationError, StopCondition
from loopwright.blocks.tracing.symbols import bundle
from support.switching import Driven, at_ticks, in_time

T = 0.1


def holds(block, u):
    """Whether the guard of a requirement is met."""
    run = Driven(block, True, T, u=lambda t: np.asarray(u, dtype=float))
    run.outputs(0.0)
    return bool(np.all(run.guards > 0.0))


def test_bounds_may_be_reached_and_not_passed():
    block = Requirement("stays within", lower=-1.0, upper=2.0)
    assert [holds(block, u) for u in (-1.0, 0.0, 2.0)] == [True] * 3
    assert [holds(block, u) for u in (np.nextafter(-1.0, -2.0), np.nextafter(2.0, 3.0), np.nan)] == [False] * 3
    assert holds(Requirement("x", upper=2.0), -1e9)
    assert not holds(Requirement("x", lower=0.0), -1e-300)


def test_every_entry_counts():
    block = Requirement("stays below", upper=2.0)
    assert holds(block, [1.0, 2.0])
    assert not holds(block, [1.0, 2.0 + 1e-12])
    assert not holds(block, [1.0, np.nan])


def test_without_bounds_the_signal_must_stay_true():
    assert [holds(Requirement("x"), u) for u in (0.0, 0.5, 0.6, 1.0, np.nan)] == [False, False, True, True, False]


def test_the_error_names_the_requirement_and_the_value():
    block = Requirement("the contact force stays below 50 N", upper=50.0)
    error = block.guard_error("requirement", -1.0, bundle("u", {"u": np.float64(50.25)}), None).at(
        block="cell.force", t=1.5
    )
    assert isinstance(error, GuardError)
    assert isinstance(error, SimulationError)
    assert str(error).startswith(
        "cell.force, t = 1.5 s: the requirement 'the contact force stays below 50 N' is violated: found u = 50.25; "
        "expected at most 50."
    )
    both = Requirement("x", lower=1.0, upper=2.0).guard_error(
        "requirement", -1.0, bundle("u", {"u": np.zeros(2)}), None
    )
    assert "found u = [0.0, 0.0]; expected at least 1 and at most 2." in str(both)
    assert "expected true (above 0.5)" in str(
        Requirement("x").guard_error("r", -1.0, bundle("u", {"u": np.zeros(1)}), None)
    )


def test_a_recorded_violation_has_no_guard_and_keeps_its_first_time():
    block = Requirement("stays below 1", upper=1.0, on_violation="record")
    u = [0.0, 1.0, 1.5, 0.0, 3.0, 0.0]
    made = at_ticks(block, T, 6, u=lambda t: u[round(t / T)])
    assert made["violated"].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(made["violated_at"], [-1.0, -1.0, 0.2, 0.2, 0.2, 0.2], rtol=0, atol=1e-15)
    assert not Driven(block, True, T, u=lambda t: 0.0).traced.guards


@pytest.mark.parametrize(("bounds", "first"), [({"upper": 0.5}, np.pi / 6), ({"lower": -0.5}, 7 * np.pi / 6)])
def test_in_continuous_time_the_violation_is_an_event(bounds, first):
    outputs, log = in_time(Requirement("x", on_violation="record", **bounds), 12.0, u=np.sin)
    assert log[0][0] == pytest.approx(first, abs=1e-14)
    assert [float(outputs(first + d)["violated"]) for d in (-1e-9, 1e-9)] == [0.0, 1.0]
    assert float(outputs(12.0)["violated_at"]) == pytest.approx(first, abs=1e-14)
    assert outputs(0.0)["violated_at"] == -1.0


def test_an_error_is_landed_on_as_well():
    assert in_time(Requirement("x", upper=0.5), 2.0, u=np.sin)[1] == [(pytest.approx(np.pi / 6, abs=1e-14), ("above",))]
    assert in_time(Requirement("x"), 2.0, u=np.cos)[1] == [(pytest.approx(np.pi / 3, abs=1e-14), ("below",))]


def test_a_violation_at_the_start_is_seen():
    block = Requirement("x", upper=1.0, on_violation="record")
    for made in (
        in_time(block, 0.1, u=lambda t: 2.0)[0](0.05),
        {k: v[0] for k, v in at_ticks(block, T, 1, u=lambda t: 2.0).items()},
    ):
        assert (float(made["violated"]), float(made["violated_at"])) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Requirement(" "), r"requirement\.requirement: found no text; expected the requirement in words"),
        (
            lambda: Requirement("x", on_violation="recrd"),
            r"on_violation: found 'recrd'; expected 'error' or 'record'\. Did",
        ),
        (
            lambda: Requirement("x", lower=2.0, upper=1.0),
            r"lower: found lower=2 above upper=1; expected it at or below",
        ),
        (lambda: Requirement(3.0), r"Requirement\.requirement: found 3\.0; expected a text"),
    ],
)
def test_a_requirement_that_is_none_is_refused(make, text):
    with pytest.raises(ParameterError, match=text):
        make()


def test_a_vector_is_refused_in_a_continuous_frame():
    with pytest.raises(
        ShapeError, match=r"requirement\.u: found shape \(2,\); expected a scalar in a continuous subsystem"
    ):
        Driven(Requirement("x", upper=1.0), False, u=lambda t: np.zeros(2))


# --- stop ---------------------------------------------------------------------------------------------------------------


def test_a_stop_condition_says_when_the_run_ends():
    assert StopCondition.stops == "stopped"
    assert at_ticks(StopCondition(), T, 4, u=lambda t: float(t > 0.15))["stopped"].tolist() == [0.0, 0.0, 1.0, 1.0]
    outputs, log = in_time(StopCondition(), 2.0, u=np.sin)
    assert [t for t, _ in log] == pytest.approx([np.pi / 6], abs=1e-14)
    assert [float(outputs(np.pi / 6 + d)["stopped"]) for d in (-1e-9, 1e-9)] == [0.0, 1.0]
    assert in_time(StopCondition(), 0.1, u=lambda t: 1.0)[0](0.0)["stopped"] == 1.0
    assert np.isnan(at_ticks(StopCondition(), T, 1, u=lambda t: np.nan)["stopped"][0])


@pytest.mark.parametrize("block", [Requirement("x", upper=1.0), StopCondition()], ids=lambda b: type(b).__name__)
def test_they_are_values(block):
    assert pickle.loads(pickle.dumps(block)) == block
    assert block.replace() == block
