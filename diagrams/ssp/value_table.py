"""Table of whole numbers in a wire, as a connection of an SSP has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import Array, Block, Input, Output, parameter


class ValueTable(Block):
    """Table of whole numbers: y is the number that the table has for u, and u itself where it has none.

    A mapping transformation of an SSP's connection is one (SSP 1.0, 5.2).
    """

    table: Mapping[float, float] = parameter(description="numbers of the output by those of the input")
    u = Input(shape=None, description="a whole number, of any shape")
    y = Output(shape=None, description="the number for it")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the number of the table."""
        found = 1.0 * u.u
        for source, target in self.table.items():
            found = np.where(u.u == source, target, found)
        return found
