"""FMUs in model exchange at an operating point: instances for linear models and trims alone."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import Finding, FmuError, Layout, OptionError, Wanted
from ...fmus.fmu_block import (
    Derivation,
    EquationSlopes,
    Fmu,
    FmuLinearization,
    LocalEquations,
    refuse_end,
)
from ..flat import Evaluators, FlatDiagram
from ..model_exchange import ModelExchangeEvaluator
from ..results import OperatingPoint
from ..wiring import join
from .left_out_effects import CoarseValues, InexactDerivatives, RefutedDerivatives

if TYPE_CHECKING:
    from ...fmus.calls import ModelExchangeInstance


KEPT = 2**20
"""Bytes of derivatives of an FMU that are kept at an operating point."""


class PointEvaluator(ModelExchangeEvaluator):
    """Evaluator of one FMU at an operating point, whose slopes are those of `EquationSlopes`."""

    def __init__(self, flat: FlatDiagram, path: str):
        super().__init__(flat, path)
        self._fmu = cast("Fmu", flat.table.blocks[path])
        self._wired = [port for port in flat.checked.traced[path].inputs if (path, port) in flat.table.wires]
        self.error = 0.0
        """Largest known error of a derivative so far; 0 where the FMU computes them."""
        self.noise = 0.0
        """The same error, relative to the largest derivative next to it."""
        self._derivatives: dict[tuple[object, ...], np.ndarray] = {}

    @cached_property
    def _slopes(self) -> EquationSlopes:
        exchange, about = self._fmu.description.exchange, self._fmu.description
        has_own = exchange is not None and exchange.has_derivatives and bool(about.states or not exchange.state_count)
        return EquationSlopes("model_exchange", has_own=has_own, is_built_here=self.block.is_built_here)

    @property
    def derivation(self) -> Derivation:
        """Method by which the derivatives are computed."""
        return self._slopes.derivation

    def differentiate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of `evaluate` by (t, x, u), NaN by t; None: it has none.

        The last ones are kept: the loops at all wires, and the slopes along all parameters, ask for them at the same
        instants.
        """
        key = names, t, x.tobytes(), u.tobytes(), self.derivation.refuted
        known = self._derivatives.pop(key, None)
        made = super().differentiate(names, t, x, u) if known is None else known
        if made is not None:
            self._derivatives[key] = made
            if len(self._derivatives) * made.nbytes > KEPT:
                del self._derivatives[next(iter(self._derivatives))]
        return made

    def find_slopes(self, names: tuple[str, ...], wanted: Wanted, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the derivative of `evaluate` by (x, u), and note its error."""
        about, block = self._fmu.description, cast("ModelExchangeInstance", self.block)
        if x.size and not about.states:  # its states have no names by which they could be moved
            J, coarse = (self.differences(names, t, x, u, scale) for scale in (1.0, 2.0))
            error = np.abs(J - coarse)
        else:
            equations = LocalEquations.in_exchange(block, wanted, t, x, u)
            J, error = self._slopes.find(equations, lambda: block.own_slopes(wanted, t, x, u), wanted)
        worst = float(np.max(error, initial=0.0, where=np.isfinite(error)))
        self.error = max(self.error, worst)
        if worst:
            self.noise = max(self.noise, worst / float(np.max(np.abs(J), initial=worst)))
        return J


_KNOWN: WeakKeyDictionary[OperatingPoint, tuple[FlatDiagram, Mapping[str, PointEvaluator]]] = WeakKeyDictionary()


class _Held(dict[str, PointEvaluator]):
    """Evaluators whose instances are freed when nothing refers to them any more."""


def evaluators_at(flat: FlatDiagram, at: OperatingPoint) -> Evaluators | None:
    """Return the evaluators of the FMUs in model exchange at an operating point; None without such FMUs.

    Each point has its own instances, with the discrete states there.
    """
    if not flat.in_model_exchange:
        return None
    known = _KNOWN.get(at)
    if known is None or known[0] is not flat:
        known = _KNOWN[at] = (flat, load_evaluators(flat, at))
    return known[1]


def pass_on(at: OperatingPoint, variant: OperatingPoint) -> OperatingPoint:
    """Let a variant of a point, with the same states, use its instances; return the variant."""
    if at in _KNOWN:
        _KNOWN[variant] = _KNOWN[at]
    return variant


def derivations_at(
    flat: FlatDiagram, at: OperatingPoint, others: Mapping[str, Derivation]
) -> tuple[dict[str, Derivation], float]:
    """Return how FMUs were differentiated at a point, and the largest estimated error of those in model exchange.

    ``others`` are the methods of the other FMUs.
    """
    found = cast("Mapping[str, PointEvaluator]", evaluators_at(flat, at) or {})
    return {**{path: e.derivation for path, e in found.items()}, **others}, max(
        (e.error for e in found.values()), default=0.0
    )


def findings_on(derivations: Mapping[str, Derivation]) -> list[Finding]:
    """Return findings on the FMUs whose derivatives are not exact, or whose values are too coarse for differences."""
    found: list[Finding] = []
    for path, d in sorted(derivations.items()):
        if d.gap != 0.0:
            found.append(RefutedDerivatives(path, d.gap) if d.refuted else InexactDerivatives(path, d.gap))
        if d.coarseness:
            found.append(CoarseValues(path, d.coarseness))
    return found


def noise_of(evaluators: Evaluators | None) -> tuple[float, float]:
    """Return the largest known error of derivatives of FMUs in model exchange, by itself and relative to them."""
    known = [e for e in (evaluators or {}).values() if isinstance(e, PointEvaluator)]
    return max((e.error for e in known), default=0.0), max((e.noise for e in known), default=0.0)


def fmu_at(flat: FlatDiagram, path: str) -> Fmu:
    """Return the FMU with a path. Raises `OptionError` where the block is another that a run steps or calls."""
    block = flat.table.blocks[path]
    if not isinstance(block, Fmu):
        raise OptionError(
            f"found a {type(block).__name__}, which a run steps or calls and is no FMU: it has no linear model; "
            "expected an FMU, or a block with equations. Write it as a block with ``opaque = True``, whose equations "
            "may be any Python, or measure the loop with diagram.frequency_response(…).",
            block=path,
        )
    return block


def load_evaluators(flat: FlatDiagram, at: OperatingPoint) -> Mapping[str, PointEvaluator]:
    """Return new evaluators of the FMUs in model exchange at an operating point, as `evaluators_at` does."""
    held, stack = _Held(), ExitStack()
    weakref.finalize(held, stack.close)
    for path in flat.in_model_exchange:
        block = fmu_at(flat, path)
        evaluator = held[path] = PointEvaluator(flat, path)
        try:
            made = block.replace(start={**block.start, **settable(block, states_at(flat, at, path))})
            instance = stack.enter_context(made.exchange(evaluator._wired, start_time=at.t))
            instance.exchange(_inputs_at(flat, at, path))
            instance.begin_exchange()
            refuse_end(instance, at.t)
        except FmuError as error:
            error.at(block=path)
            raise
        evaluator.load(instance)
    return held


def linearize_exchanged(flat: FlatDiagram, at: OperatingPoint, path: str) -> FmuLinearization:
    """Return the linear model of the equations of an FMU in model exchange at a point."""
    block = fmu_at(flat, path)
    shapes = Layout.of(dict(flat.checked.traced[path].inputs))
    inputs = shapes.split(_inputs_at(flat, at, path))
    return block.linear_model(t=at.t, state=states_at(flat, at, path), inputs=inputs, interface="model_exchange")


def states_at(flat: FlatDiagram, at: OperatingPoint, path: str) -> dict[str, np.ndarray]:
    """Return the states of an FMU in model exchange at a point, by its names: continuous ones from x, then others."""
    known = dict(at.exchanged.get(path, {}).get("state", {}))
    return {**known, **flat.states.of_block[path].split(at.x)}


def settable(block: Fmu, states: Mapping[str, Any]) -> dict[str, Any]:
    """Return those states that an FMU takes as start values; the others are set when it runs."""
    about = block.description
    return {n: v for n, v in states.items() if n in about.names and about.find(n).initial == "exact"}


def _inputs_at(flat: FlatDiagram, at: OperatingPoint, path: str) -> np.ndarray:
    """Return all inputs of an FMU at a point, flat."""
    known = at.exchanged.get(path, {}).get("inputs", {})
    parts = []
    for port, shape in flat.checked.traced[path].inputs.items():
        wire = flat.table.wires.get((path, port))
        value = known.get(port)
        if wire is not None:
            signal = np.asarray(at.values.get(join(wire.block, wire.port), np.nan), dtype=float)
            if np.all(np.isfinite(signal)):
                value = signal if wire.index is None else signal[wire.index]
        parts.append(np.broadcast_to(np.asarray(0.0 if value is None else value, dtype=float), shape).ravel())
    return np.concatenate([np.zeros(0), *parts])
