"""Functions of a diagram in stages: traced ones, and between them blocks that an evaluator evaluates."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..flat import OpaqueStage, Schedule
from .bound_functions import BlockBinder, BoundFunction, CompiledFunction, FunctionInC, TickStructure, address_of
from .model_exchange_in_c import StageStructure
from .runtime import load_runtime


class _ScheduleInC(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), ("stages", ctypes.c_void_p)]


@dataclass(frozen=True, eq=False)
class Staged(FunctionInC):
    """A schedule whose traced stages, in their order, are functions in C."""

    schedule: Schedule
    functions: Sequence[CompiledFunction]

    @property
    def calls_python(self) -> bool:
        """Whether Python evaluates some of its functions."""
        return any(function.calls_python for function in self.functions)

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time; ``bind_block`` binds the stages between."""
        assert bind_block is not None
        schedule, functions = self.schedule, iter(self.functions)
        c = np.zeros(schedule.width)
        vectors = [*arguments, c] if schedule.width else [*arguments]
        made, seen, kept = (StageStructure * len(schedule.stages))(), set[str](), list[Any]()
        for i, stage in enumerate(schedule.stages):
            if isinstance(stage, OpaqueStage):
                made[i] = bind_block(stage, arguments[0], c, again=stage.path in seen)
                seen.add(stage.path)
                continue
            kept.append(next(functions).bind(vectors, results if stage is schedule.last else [c[stage.makes]]))
            made[i].f = kept[-1].structure
        found = _ScheduleInC(len(made), ctypes.addressof(made))
        address, last = address_of(load_runtime(), "loopwright_stages"), made[len(made) - 1].f.results
        structure = TickStructure(address, None, last, ctypes.addressof(found), None)
        return BoundFunction(structure, arguments, results, found, c, [self, *kept, made])

    def hand_over(self, to: Any) -> None:
        """Let generated code of the same stages take over."""
        for one, other in zip(self.functions, to.functions, strict=True):
            one.hand_over(other)
