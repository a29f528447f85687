"""Derivatives by differences, for the tests of linearization."""

from dataclasses import replace

import numpy as np


def differences(f, x, d=1e-4):
    """The Jacobian by central differences of fourth order."""
    moves = d * np.eye(len(x))
    return np.array([(8 * (f(x + e) - f(x - e)) - (f(x + 2 * e) - f(x - 2 * e))) / (12 * d) for e in moves]).T


def by_simulation(diagram, t, period, **options):
    """Of the way from just before one tick to just before another: its derivative, and the way itself."""
    options = {"rtol": 1e-11, "atol": 1e-13, **options}
    point = diagram.operating_point(t, **options)
    with diagram.simulation(**options) as run:
        if t > 0:
            run.advance(t)
        state, flat = run.save(), run.flat

        def go(x):
            after = np.ravel(np.array(flat.at_tick(flat.acting(point.tick))(point.t, x, point.w, flat.p)[0]))
            run.restore(replace(state, x=after))
            run.advance(period)
            return run.view.x.copy()

        return differences(go, point.x), go(point.x) - point.x
