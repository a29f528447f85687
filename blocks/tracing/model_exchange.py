"""Blocks in model exchange, in the place of a trace: their ports, and what depends on what."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ..core import Block, SampleTimeError, Shape
from .equations import start_values
from .numpy_check import GUARDS, NEXT
from .symbols import size
from .traced import Traced


def describe_model_exchange(block: Block, shapes: Mapping[str, Shape], *, sampled: bool) -> Traced:
    """Return the description of a block whose class says ``in_model_exchange``, for inputs of the given shapes."""
    if sampled:
        raise SampleTimeError(
            "a solver integrates its states (model exchange), and it is in a sampled subsystem, which has no solver. "
            "Put it outside of it, or take an FMU with co-simulation.",
            block=block.label,
        )
    starts = start_values(block, shapes)
    states = {name: v.shape for name, v in starts.items()}
    outputs = {name: port.shape or () for name, port in block.outputs.items()}
    sizes = {**{name: size(s) for name, s in outputs.items()}, NEXT: sum(map(size, states.values())), GUARDS: 0}
    t, x, p = ca.MX.sym("t"), ca.MX.sym("x", sizes[NEXT]), ca.MX.sym("p", 1)
    u = [ca.MX.sym(f"u{i}", size(s)) for i, s in enumerate(shapes.values())]
    known = {"t": t, "x": x, **dict(zip(shapes, u, strict=True))}
    # The functions have the ports and the structure of dependencies. Their values are NaN: an evaluator gives them.
    results, depends = [], {}
    # Dependences are read from the sparsity of these functions, as for every block; so each result is NaN, and
    # depends on what the FMU declares.
    for name, rows in sizes.items():
        patterns = {} if name == GUARDS else block.dependence(name)
        column = ca.MX.zeros(rows) if not rows else ca.MX.ones(rows) * np.nan
        for of, symbol in known.items():
            pattern = np.asarray(patterns.get(of, np.zeros((rows, symbol.numel()), dtype=bool)))
            if pattern.any():
                column += ca.MX(ca.DM(_sparse(pattern))) @ symbol
        results.append(column)
        depends[name] = frozenset(of for of, pattern in patterns.items() if np.any(pattern))
    function = ca.Function("model_exchange", [t, x, *u, p], results)
    n = len(block.events)
    fired = ca.MX.sym("fired", n)
    indicators = ca.Function("indicators", [t, x, *u, p], [ca.MX.ones(n) * np.nan])
    jump = ca.Function("jump", [t, x, *u, p, fired], [x * np.nan])
    return Traced(
        function=function,
        inputs=dict(shapes),
        outputs=outputs,
        states=states,
        guards=(),
        depends=depends,
        advance="derivative",
        system_matrix=None,
        method="exact",
        indicators=indicators if n else None,
        jump=jump,
    )


def _sparse(pattern: np.ndarray) -> Any:
    rows, columns = np.nonzero(pattern)
    return ca.DM.triplet(rows.tolist(), columns.tolist(), ca.DM([np.nan] * len(rows)), *pattern.shape)
