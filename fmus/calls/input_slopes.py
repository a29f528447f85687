"""Slopes of real inputs within a step (FMI 2.0, 4.2.1; FMI 3.0, 4.2.2)."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import numpy as np

from ...blocks.core import Layout
from .loaded_fmu import LoadedFmu


class InputSlopes:
    """Slopes of real inputs, by their differences from the step before (FMI 2.0, 4.2.1; FMI 3.0, 4.2.2).

    ``last`` holds time in s and values of these inputs at the step before, NaN without one. ``line`` is there in FMI
    3.0, where the FMU asks for its inputs within a step: start, status, values and slopes; before, a call sets the
    slopes.
    """

    def __init__(self, fmu: LoadedFmu, ports: Sequence[str], u: np.ndarray):
        fmi, is_new = fmu.fmi, fmu.description.fmi.startswith("3")
        places = Layout.of({port: v.shape for port, v in fmu.inputs.items()}).slices
        variables = {port: fmu.inputs[port] for port in ports}
        with_slopes = {
            port: v for port, v in variables.items() if v.type == "Float64" and (v.intermediate or not is_new)
        }
        self.places = np.concatenate([np.zeros(0, dtype=np.int64), *(np.r_[places[port]] for port in with_slopes)])
        self._u, n = u, self.places.size
        references = [r for v in with_slopes.values() for r in v.references]
        self.last = np.full(1 + n, math.nan)
        self.line = fmi.slope_line(references, n) if n and is_new else None
        self.slopes = fmi.allocate(n, ctypes.c_double) if self.line is None else self.line[2 + n :]
        self.calls = [] if not n or self.line is not None else [fmi.slopes_call(references, self.slopes)]

    def take(self, t: float) -> None:
        """Take the slopes from the step before to the present inputs, at a time in s."""
        now, last, n = self._u[self.places], self.last, self.places.size
        self.slopes[:] = (now - last[1:]) / (t - last[0]) if t > last[0] else 0.0
        if self.line is not None:
            self.line[0], self.line[2 : 2 + n] = t, now
        last[0], last[1:] = t, now

    def take_status(self) -> int:
        """Return the worst status of setting inputs within steps since it was asked for last."""
        if self.line is None:
            return 0
        status, self.line[1] = int(self.line[1]), 0.0
        return status
