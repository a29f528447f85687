"""Ctrl-C while CVODE's library in C integrates, and calls Python for rates and Jacobians."""

import os
import signal

import numpy as np
import pytest

from loopwright.blocks.interrupts import INTERRUPTS
from loopwright.diagrams.solvers import cvode
from loopwright.diagrams.solvers.base import Problem
from loopwright.diagrams.solvers.choose import make_solver

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends itself a signal")
CALLBACKS = ["_RATE", "_JACOBIAN"]


@pytest.fixture
def heard():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def oscillator(rate=lambda x: [x[1], -x[0]]):
    return Problem(2, lambda t, x: np.array(rate(x)), lambda t, x: np.array([[0.0, 1.0], [-1.0, 0.0]]), ["x", "v"])


def integrate(of):
    """Step until t = 20 s, which takes CVODE some hundred calls."""
    solver = make_solver("CVODE_BDF", of, rtol=1e-8)
    solver.restart(0.0, np.array([1.0, 0.0]), 20.0)
    while solver.step().t < 20.0:
        pass


@pytest.mark.parametrize("callback", CALLBACKS)
def test_an_interrupt_that_comes_as_cvode_calls_python_is_raised(monkeypatch, heard, callback):
    """Python would raise it at the first instruction of the function that C calls, where ctypes drops it."""
    entries, kind = [], getattr(cvode, callback)

    def entered(function):
        def enter(*arguments):
            entries.append(arguments[0])
            if len(entries) == 3:
                signal.raise_signal(signal.SIGINT)
            return function(*arguments)

        return kind(enter)

    monkeypatch.setattr(cvode, callback, entered)
    with pytest.raises(KeyboardInterrupt):
        integrate(oscillator())
    assert len(entries) == 3  # CVODE is told at once


def test_an_interrupt_within_the_rates_is_raised_and_another_run_is_as_ever(heard):
    calls = []

    def rate(x):
        calls.append(1)
        if len(calls) == 20:
            signal.raise_signal(signal.SIGINT)
        return [x[1], -x[0]]

    of = oscillator(rate)
    with pytest.raises(KeyboardInterrupt):
        integrate(of)
    assert len(calls) == 20
    assert not INTERRUPTS.heard
    integrate(of)
