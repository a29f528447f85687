"""Scalars in place of arrays, for FMI 2.0 and for importers that can't read arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from .model_spec import ModelSpec, Variable


def elements_of(variable: Variable) -> Iterator[Variable]:
    """Yield each element, row by row: ``s[1]``, ``s[2]``; ``m[1,2]``. FMI counts from 1 (FMI 2.0, 2.2.9)."""
    for index in np.ndindex(variable.shape):
        start = None if variable.start is None else float(np.asarray(variable.start)[index])
        element = replace(variable, shape=(), start=start)
        # This bypasses the check of names, since users may give no name with an index.
        object.__setattr__(element, "name", f"{variable.name}[{','.join(str(i + 1) for i in index)}]")
        yield element


def _scalars(variables: Iterable[Variable]) -> tuple[Variable, ...]:
    return tuple(e for v in variables for e in (elements_of(v) if v.shape else (v,)))


def scalarize(spec: ModelSpec) -> ModelSpec:
    """Return the model with every array replaced by its elements; the flat vectors, and so the equations, are the same.

    Returns: the model, with all variables of shape ``()``.
    """
    return replace(
        spec,
        inputs=_scalars(spec.inputs),
        outputs=_scalars(spec.outputs),
        parameters=_scalars(spec.parameters),
        states=_scalars(spec.states),
    )
