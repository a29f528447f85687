"""Step responses in a report: their distance from the linear model is that of each signal, and not of rounding."""

import numpy as np
import pytest

from loopwright.diagrams.measure import StepResponse
from loopwright.diagrams.report.section_steps import _deviation, _how


def response(outputs, y, linear, before=None, wire_before=0.0):
    """Return a response whose own signal is predicted exactly, beside signals that are given."""
    N = 5
    v, t = -np.ones(N), 0.1 * np.arange(N)
    y, linear = (np.outer(np.ones(N), np.atleast_1d(values)) for values in (y, linear))
    return StepResponse(
        wire="u", size=1.0, t=t, d=np.ones(N), v=v, outputs=outputs, y=y,
        before=np.zeros(len(outputs)) if before is None else np.asarray(before), wire_before=wire_before, moved=0.0,
        dt=0.1, held=True, prediction=np.column_stack([v, linear]),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("outputs", "y", "linear", "before", "deviation"),
    [
        (("f",), [2.0], [1.5], [0.0], 0.25),
        (("f[1]", "f[2]"), [4e-5, 0.4], [0.0, 0.4], [0.0, 43.0], 1e-4),  # entries of one signal share a scale
        (("f", "g"), [4e-5, 0.4], [0.0, 0.4], [0.0, 43.0], 1.0),  # two signals don't
        (("f",), [2e-14], [0.0], [43.0], 0.0),  # rounding of 43
    ],
)
def test_the_deviation_is_relative_to_the_signals_own_largest_change(outputs, y, linear, before, deviation):
    got = response(outputs, y, linear, before)
    assert _deviation(got) == pytest.approx(deviation, rel=1e-9, abs=1e-12)
    assert ("does not agree" in _how(got).method) == (deviation > 0.01)
    assert f"differs by {deviation:.2g} of" in _how(got)
