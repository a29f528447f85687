"""Symbols and columns: CasADi's values with NumPy's interface, and back; names of its scalar operations."""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from ..core import Shape, ShapeError
from .traced_array import as_traced

LARGE = 64 * 64
"""Entries of a matrix above which a product with it is one operation, and not one for each entry."""


def size(shape: Shape) -> int:
    """Return the number of entries of a shape."""
    return int(math.prod(shape))


@lru_cache(maxsize=4096)
def _tuple_type(kind: str, names: tuple[str, ...]) -> Any:
    return namedtuple(kind, names)


def bundle(kind: str, values: Mapping[str, Any]) -> Any:
    """Return a named tuple of states, inputs or outputs, as equations take it."""
    return _tuple_type(kind, tuple(values))(*values.values())


def has_large_product(function: Any) -> bool:
    """Whether a CasADi function multiplies a matrix of more than `LARGE` entries: that stays one operation."""
    if not function.is_a("MXFunction"):
        return False
    for k in range(function.n_instructions()):
        if function.instruction_id(k) == ca.OP_MTIMES:
            product = function.instruction_MX(k)
            if max(product.dep(1).numel(), product.dep(2).numel()) > LARGE:
                return True
    return False


def expand(function: Any) -> Any:
    """Return the function in scalar (SX) operations, each done once; unchanged with a table or a large matrix in it."""
    if has_large_product(function):
        return function
    try:
        scalar = function.expand()
    except RuntimeError:
        return function
    arguments = scalar.sx_in()
    return ca.Function(function.name(), arguments, ca.cse(scalar.call(arguments)))


def with_values(block: Any, values: Mapping[str, Any]) -> Any:
    """Return a copy of ``block`` with attributes replaced, without a call of its constructor."""
    copy = object.__new__(type(block))
    copy.__dict__.update(block.__dict__)
    nested: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        head, _, rest = name.partition(".")
        if rest:
            nested.setdefault(head, {})[rest] = value
        else:
            copy.__dict__[name] = value
    for head, inner in nested.items():
        copy.__dict__[head] = with_values(block.__dict__[head], inner)
    return copy


def with_zeros(column: Any, zero: np.ndarray) -> Any:
    """Return a flat CasADi column with zeros as structure: numbers in a small one, left out of a large one."""
    if len(zero) <= LARGE:
        return ca.vertcat(*(ca.MX(0.0) if z else column[i] for i, z in enumerate(zero)))
    kept = np.flatnonzero(~zero).tolist()
    return ca.MX(ca.Sparsity(len(zero), 1, [0, len(kept)], kept), column[kept])


def is_nonzero(value: Any) -> bool:
    """Whether a number is other than 0; a symbol in its place is, since exact zeros are structure."""
    return not value.to_casadi().is_zero() if isinstance(value, ArrayInterface) else bool(value != 0.0)


def wrap(flat: Any, shape: Shape) -> Any:
    """Give a flat CasADi column NumPy's interface, in C order."""
    if shape == ():
        return as_traced(ArrayInterface(flat, ndim=0))
    if len(shape) == 1:
        return as_traced(ArrayInterface(flat.T, ndim=1))
    if len(shape) == 2:
        return as_traced(ArrayInterface(ca.reshape(flat, shape[1], shape[0]).T, ndim=2))
    raise ShapeError(
        f"found a signal of shape {shape}; expected at most two dimensions. Wire its parts, such as signal[0]."
    )


def flat_column(value: Any) -> Any:
    """Return a traced value (or plain numbers) as a CasADi column in C order."""
    if isinstance(value, ArrayInterface):
        inner = value.to_casadi()
        return ca.vec(inner.T) if value.ndim == 2 else ca.vec(inner)
    return ca.MX(ca.DM(np.ravel(np.asarray(value, dtype=float))))


def count_uses(f: ca.Function) -> dict[int, int]:
    """Return the number of reads of each operation's result, of a scalar function; places of work are reused."""
    made: dict[int, int] = {}
    uses = dict.fromkeys(range(f.n_instructions()), 0)
    for k in range(f.n_instructions()):
        op = f.instruction_id(k)
        if op not in (ca.OP_CONST, ca.OP_INPUT):
            for i in f.instruction_input(k):
                uses[made[i]] += 1
        if op != ca.OP_OUTPUT:
            made[f.instruction_output(k)[0]] = k
    return uses


MATH_FUNCTIONS = {
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_SQRT: "sqrt",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_FABS: "fabs",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_ASINH: "asinh",
    ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh",
    ca.OP_ATAN2: "atan2",
    ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
    ca.OP_HYPOT: "hypot",
    ca.OP_ERF: "erf",
}
"""The functions of math.h, by CasADi's number of the operation."""
