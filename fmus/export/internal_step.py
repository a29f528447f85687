"""The step of an exported model's integrator: chosen by the fastest mode at the start values, or compared with it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace

import casadi as ca
import numpy as np

from .model_spec import ModelSpec, Variable

LONGEST = 1e-3
"""Longest step in s that is chosen."""
FINE = 0.1
"""Step in time constants of the fastest mode that is chosen at most: rk4 is then off by FINE⁴/120 = 8e-7 of the mode in
each of its time constants."""
COARSE = 0.5
"""Step in time constants above which rk4 is said to be coarse: off by more than 5e-4 of the mode in each of its time
constants; it is unstable from 2.8 on."""
SHORTEST = 1e-5
"""Shortest step in s that is chosen: a model that needs shorter ones gets the implicit integrator."""
ROUNDING = 1e-6
"""Relative error of an eigenvalue, far above that of linear algebra, by which no step changes."""


def find_fastest_mode(spec: ModelSpec) -> float:
    """Return the size of the largest eigenvalue of the Jacobian at the start values in 1/s; NaN where it has none."""
    n = sum(v.size for v in spec.continuous)
    if not n:
        return 0.0
    try:
        f = spec.derivative
        t, x, u, p = (ca.MX.sym(name, *f.size_in(i)) for i, name in enumerate("txup"))
        jacobian = ca.Function("jacobian", [t, x, u, p], [ca.jacobian(f(t, x, u, p), x)])
        found = np.asarray(jacobian(0.0, _start(spec.states), _start(spec.inputs), _start(spec.parameters)))[:, :n]
    except (RuntimeError, NotImplementedError):  # an operation that CasADi can't differentiate
        return math.nan
    return float(np.max(np.abs(np.linalg.eigvals(found)))) if np.all(np.isfinite(found)) else math.nan


def choose_internal_step(spec: ModelSpec) -> ModelSpec:
    """Return a model with an integrator that resolves its fastest mode at the start values.

    That is rk4 with a step of at most `FINE` time constants of this mode, or rodas if that is below `SHORTEST`.
    """
    fastest = find_fastest_mode(spec)
    if not fastest * LONGEST > FINE * (1.0 + ROUNDING):
        return replace(spec, internal_step=LONGEST)
    if fastest * SHORTEST > FINE * (1.0 + ROUNDING):
        return replace(spec, integrator="rodas", internal_step=LONGEST)
    return replace(spec, internal_step=_round_down(FINE / fastest))


def compare_internal_step(spec: ModelSpec) -> ModelSpec:
    """Return a model whose step is described as coarse, and warn, where it is too long for the fastest mode."""
    fastest = find_fastest_mode(spec)
    if spec.integrator != "rk4" or not fastest * spec.internal_step > COARSE:
        return spec
    said = (
        f"It is coarse: {fastest * spec.internal_step:.2g} time constants of the fastest mode at the start values "
        f"({fastest:.3g} 1/s)"
    )
    step = f"internal_step={_round_down(FINE / fastest):g} resolves it, or integrator='rodas'"
    warnings.warn(f"{spec.name}, internal_step: found {spec.internal_step:g} s. {said}; {step}.", RuntimeWarning, 4)
    return replace(spec, step_note=f". {said}; {step}")


def _round_down(step: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten up to a step."""
    step *= 1.0 + ROUNDING
    power = 10.0 ** math.floor(math.log10(step))
    return float(f"{max(k for k in (1.0, 2.0, 5.0) if k * power <= step) * power:.3g}")


def _start(variables: Iterable[Variable]) -> np.ndarray:
    values = [np.asarray(v.flat_start or [0.0] * v.size, dtype=float) for v in variables]
    return np.concatenate(values) if values else np.zeros(0)
