"""Outputs that fail between samples end runs in C at the step at which they end interpreted ones."""

import numpy as np
import pytest

from loopwright.blocks import Function, Integrator, PythonFunction, Sine, TransferFunction
from loopwright.diagrams import Diagram, NonFiniteError
from loopwright.diagrams.compiled.step_outputs import may_fail_at_steps

QUIET = {"progress": False}


def lag_and(function, **options):
    """A lag behind a sine, and a function of its output that nothing else depends on."""
    lag = TransferFunction(numerator=1.0, denominator=[0.01, 1.0], name="lag")
    return Diagram("lag", lag(Sine(frequency=1.0)()), Function(function, name="root")(lag.y).named("q"), **options)


@pytest.mark.parametrize("solver", ["auto", "RK23", "DOP853", "Radau"])
def test_a_root_of_a_negative_number_between_samples_is_an_error(solver):
    times = []
    for compiled in (False, True):
        with pytest.raises(NonFiniteError, match=r"root\.y") as caught:
            lag_and(lambda u: np.sqrt(u + 0.9)).simulate(10.0, step=1.0, solver=solver, compile=compiled, **QUIET)
        times.append(caught.value.t)
    w, tau = 2 * np.pi, 0.01  # the output is below -0.9 from here on, but for 1e-20 of the start
    crossing = (np.pi + np.arcsin(0.9 * np.hypot(1.0, w * tau)) + np.arctan(w * tau)) / w
    assert crossing <= times[0] < crossing + 0.05
    assert abs(times[1] - times[0]) <= 1e-9  # steps differ by rounding


def judge(made):
    """Say whether outputs of a diagram may fail at steps."""
    return may_fail_at_steps(made.simulation(step=1.0).flat)


@pytest.mark.parametrize(
    ("function", "fails"),
    [
        (lambda u: 1.0 / u, True),
        (lambda u: np.log(u + 2.0), True),
        (lambda u: np.exp(u), True),
        (lambda u: np.arccos(u), True),
        (lambda u: (u + 2.0) ** 1.5, True),
        (lambda u: u**3, False),
        (lambda u: u / 3.0, False),
        (lambda u: np.sin(u) + np.tanh(u), False),
    ],
)
def test_operations_that_may_fail_are_seen(function, fails):
    assert judge(lag_and(function)) is fails


def test_an_operation_that_the_rates_fail_with_is_not_looked_at_again():
    lag = TransferFunction(numerator=1.0, denominator=[0.01, 1.0], name="lag")
    root = Function(np.sqrt, name="root")
    assert not judge(Diagram("area", lag(Sine(frequency=1.0)()), Integrator(name="area")(root(lag.y + 2.0)).named("q")))


def test_grouped_code_is_looked_at_as_well():
    lags = [TransferFunction(numerator=1.0, denominator=[0.01, 1.0], name=f"lag{i}") for i in range(400)]
    driven = [lag(Sine(frequency=1.0, name="sine")()) for lag in lags[:1]]
    for lag in lags[1:]:
        driven.append(lag(driven[-1]))
    plain = Diagram("chain", driven[-1].named("y"))
    failing = Diagram("chain", driven[-1].named("y"), Function(np.sqrt, name="root")(driven[0] + 0.9).named("q"))
    assert [judge(plain), judge(failing)] == [False, True]


def test_a_function_that_python_evaluates_is_looked_at():
    lag = TransferFunction(numerator=1.0, denominator=[0.01, 1.0], name="lag")
    root = PythonFunction(lambda u: np.sqrt(u) if u > 0.0 else np.nan, name="root")
    assert judge(Diagram("lag", lag(Sine(frequency=1.0)()), root(lag.y).named("q")))
