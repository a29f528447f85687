"""Functions in the form in which they are evaluated fastest: scalar operations, each of them done once."""

from __future__ import annotations

from threading import Lock
from typing import Any

import casadi as ca

from ...blocks.tracing import has_large_product

_EXPANDING = Lock()  # the option of CasADi that says whether to simplify is one for all threads


def share_terms(function: Any, name: str | None = None) -> Any:
    """Return a function, under another name if one is given, in which each operation on scalars is done once.

    Its results are the same ones to the last bit. A function of matrices has no other operations than before.
    """
    name = function.name() if name is None else name
    if not function.is_a("SXFunction"):
        symbols = function.mx_in()
        return ca.Function(name, symbols, function.call(symbols))
    symbols = function.sx_in()
    return ca.Function(name, symbols, ca.cse(function.call(symbols)))


def speed_up(function: Any, *, simplify: bool = True) -> Any:
    """Return a function in the form that is evaluated fastest: scalar operations.

    Where a block looks up a table, or multiplies a large matrix, it is returned unchanged. To ``simplify`` the
    operations of all blocks together, such as a sum with a zero, may change the sign of a zero, and rounding where a
    value is added and subtracted again. Else the results are those of the blocks, one by one.
    """
    if has_large_product(function):
        return function
    with _EXPANDING:
        ca.GlobalOptions.setSimplificationOnTheFly(simplify)
        try:
            return function.expand()
        except RuntimeError:
            return function
        finally:
            ca.GlobalOptions.setSimplificationOnTheFly(True)
