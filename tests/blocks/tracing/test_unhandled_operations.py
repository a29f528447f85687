"""Operations that NumPy or CasADi hand back unhandled are errors of ours with a next step, and never a recursion."""

import sys
import traceback

import numpy as np
import pytest

from loopwright.blocks import Block, Input, Output, TraceError
from loopwright.blocks.tracing.numpy_check import record_rounding, watch
from loopwright.blocks.tracing.traced import trace
from loopwright.blocks.tracing.traced_functions import NotTracedError


def trace_equation(equation):
    class Rule(Block):
        u = Input(shape=(2,))
        y = Output(shape=None)

        def output(self, t, x, u):
            return equation(u.u)

    return trace(Rule(name="rule"), {"u": (2,)}, sampled=False)


def fix_with_a_condition(x):
    """Return whole numbers towards zero as NumPy 2.1 computes them: the second function takes where= and out=."""
    found = np.asanyarray(np.ceil(x, out=None))
    return np.floor(x, out=found, where=np.greater_equal(x, 0))


class HandedBack:
    """A ufunc of a NumPy that hands it back."""

    __name__ = "frobnicate"

    def __call__(self, *inputs, **options):
        return NotImplemented


@pytest.mark.parametrize(
    ("name", "equation"),
    [
        ("add", lambda u: np.add(1.0, 2.0, where=u[0] > 0.0)),
        ("add", lambda u: np.add(u, u, where=u > 0.0)),
        ("add", lambda u: np.add(1.0, 2.0, out=u)),
        ("add", lambda u: np.add(np.ones(2), 2.0, out=(u,))),
        ("add", lambda u: np.add(u, 1.0, out=np.zeros(2))),
        ("add.reduce", lambda u: np.add.reduce(np.ones(2), where=u > 0.0)),
        ("floor", lambda u: np.floor(np.array([0.5, -0.5]), where=u > 0.0)),
        ("interp", lambda u: np.interp(0.5, np.arange(2.0), fp=u)),
        ("cov", lambda u: np.cov(np.ones(2), y=u)),
    ],
)
def test_symbols_in_arguments_that_casadi_does_not_look_at_are_an_error_with_a_next_step(name, equation):
    with pytest.raises(TraceError, match=rf"rule: its output can't be traced in line .*np\.{name} can't be") as found:
        trace_equation(equation)
    assert "leave out=, where= and initial= out, and write np.where(condition, a, b)" in str(found.value)
    cause, frames = found.value, 0
    while cause is not None:
        assert not isinstance(cause, RecursionError)
        frames += len(traceback.extract_tb(cause.__traceback__))
        cause = cause.__cause__ or cause.__context__
    assert frames < 0.5 * sys.getrecursionlimit()


@pytest.mark.parametrize(
    "function",
    [
        fix_with_a_condition,
        lambda v: np.add(v, 2.0, out=watch(np.full(3, 7.0)), where=v > 0.0),
        lambda v: np.add.reduce(v, where=v > 0.0),
        lambda v: np.add.reduce(v, initial=watch(np.float64(4.0))),
        lambda v: np.sum(v, where=v > 0.0),
        lambda v: np.clip(v, watch(np.float64(-1.0)), 1.0, out=np.zeros(3), where=v < 2.0),
        lambda v: np.divmod(v, 0.7, out=(np.zeros(3), watch(np.zeros(3))))[1],
    ],
)
def test_watched_numbers_in_any_argument_give_numpys_results(function):
    numbers = np.array([-1.75, 0.25, 2.5])
    with record_rounding() as rounded:
        made = function(watch(numbers))
    np.testing.assert_array_equal(np.asarray(made), function(numbers))
    assert type(made) is type(watch(numbers))
    assert not rounded


def test_whole_numbers_towards_zero_by_a_condition():
    numbers = np.array([-1.75, 0.25, 2.5])
    np.testing.assert_array_equal(np.asarray(fix_with_a_condition(watch(numbers))), [-1.0, 0.0, 2.0])


def test_rounding_where_a_condition_holds_is_recorded():
    numbers = watch(np.array([0.5, -1.5]))
    with record_rounding() as rounded:
        made = np.rint(numbers, out=np.zeros(2), where=numbers > 0.0)
    assert rounded == ["rint"]
    np.testing.assert_array_equal(np.asarray(made), [0.0, 0.0])


def test_an_operation_that_numpy_hands_back_is_an_error():
    numbers = watch(np.ones(2))
    with pytest.raises(NotTracedError, match=r"^NumPy \S+ hands np\.frobnicate back\. Write it in sums"):
        numbers.__array_ufunc__(HandedBack(), "__call__", numbers)


def test_an_operation_that_numpy_hands_back_names_its_block():
    def equation(u):
        return u.__array_ufunc__(HandedBack(), "__call__", u) if type(u) is type(watch(np.ones(2))) else 2.0 * u

    with pytest.raises(TraceError, match=r"rule: its output .* hands np\.frobnicate back\. Write it in"):
        trace_equation(equation)


def test_an_operand_of_another_class_is_asked():
    class Foreign:
        def __array_ufunc__(self, ufunc, method, *inputs, **options):
            return ufunc.__name__, method, len(inputs)

    class Refusing:
        def __array_ufunc__(self, ufunc, method, *inputs, **options):
            return NotImplemented

    assert np.add(watch(np.ones(2)), Foreign()) == ("add", "__call__", 2)
    with pytest.raises(TypeError, match="all returned NotImplemented"):
        np.add(watch(np.ones(2)), Refusing())
