"""The functions of a diagram's blocks, each made once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from ...blocks.tracing import GUARDS, NEXT, Traced, has_large_product
from .program import Cells


class BlockFunctions:
    """The traced equations of a diagram's blocks, and functions of parts of them.

    An instant may evaluate some outputs of a block before its other ones: these have a separate function. Blocks of
    equal structure share their traces. ``inlined`` writes out functions that are no scalar operations, so that lookups
    are found.
    """

    def __init__(self, traced: Mapping[str, Traced], *, inlined: bool = False):
        self.traced, self.inlined = traced, inlined
        self._parts: dict[tuple[int, tuple[str, ...]], Any] = {}

    def of(self, path: str, names: tuple[str, ...]) -> Any:
        """Return the function (t, x, one column per input, p) of some outputs of a block, `NEXT` and `GUARDS`."""
        trace = self.traced[path]
        every = (*trace.outputs, NEXT, GUARDS)
        if names == every:
            return trace.function
        key = (id(trace), names)
        if key not in self._parts:
            f = trace.function
            self._parts[key] = f.slice("block", list(range(f.n_in())), [every.index(n) for n in names])
        return self._parts[key]

    def of_events(self, path: str, name: str) -> Any:
        """Return the function of a block's ``"indicators"`` or ``"jump"``, with p as the last argument."""
        trace = self.traced[path]
        function = getattr(trace, name)
        if name == "indicators":
            return function
        key = (id(trace), (name,))
        if key not in self._parts:
            scalar = function.is_a("SXFunction")
            given = function.sx_in() if scalar else function.mx_in()
            *before, p, fired = given
            self._parts[key] = ca.Function("block_jump", [*before, fired, p], function.call(given))
        return self._parts[key]


def call_block(function: Any, arguments: Sequence[Any], *, inlined: bool = False) -> list[Any]:
    """Call a block's function; one with a product with a large matrix is written out in place of the call.

    ``inlined`` writes out all that are no scalar operations.

    The derivative of a call has a direction for every parameter, thus for every entry of the matrix.
    """
    if isinstance(arguments[0], Cells):
        return [*arguments[0].program.call(function, arguments)]
    written_out = has_large_product(function) or (inlined and not function.is_a("SXFunction"))
    symbolic = any(isinstance(argument, ca.MX) for argument in arguments)
    made: list[Any] = function.call([*arguments], symbolic and written_out, False)
    return made
