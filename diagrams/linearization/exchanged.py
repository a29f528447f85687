"""FMUs in model exchange at an operating point: instances for linear models and trims alone."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import Finding, FmuError, Layout
from ...fmus.fmu_block import (
    Derivation,
    DerivativeMethod,
    FmuLinearization,
    check_exchange_slopes,
    find_exchange_slopes,
)
from ..flat import Evaluators, FlatDiagram
from ..model_exchange import ModelExchangeEvaluator
from ..results import OperatingPoint
from ..wiring import join
from .left_out_effects import CoarseValues, InexactDerivatives, RefutedDerivatives

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu


KEPT = 2**20
"""Bytes of derivatives of an FMU that are kept at an operating point."""


class PointEvaluator(ModelExchangeEvaluator):
    """Evaluator of one FMU at an operating point; it notes how its derivatives are computed."""

    def __init__(self, flat: FlatDiagram, path: str):
        super().__init__(flat, path)
        self._fmu = cast("Fmu", flat.table.blocks[path])
        self._inputs = Layout.of(dict(flat.checked.traced[path].inputs))
        self._wired = [port for port in self._inputs.slices if (path, port) in flat.table.wires]
        self.error = 0.0
        """Largest known error of a derivative so far; 0 where the FMU computes them."""
        self.noise = 0.0
        """The same error, relative to the largest derivative next to it."""
        exchange = self._fmu.description.exchange
        directional = exchange is not None and exchange.has_derivatives
        self.derivation = Derivation(
            DerivativeMethod.DIRECTIONAL if directional else DerivativeMethod.DIFFERENCES, "model_exchange"
        )
        """Method by which the derivatives are computed."""
        self._checked, self._differenced = set[tuple[str, ...]](), set[tuple[str, ...]]()
        self._derivatives: dict[tuple[object, ...], np.ndarray] = {}

    def differentiate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of `evaluate`; the FMU's own is held against differences where it is asked for first.

        Where it is plainly wrong, differences replace it from then on. The last ones are kept: the loops at all
        wires, and the slopes along all parameters, ask for them at the same instants.
        """
        key = names, t, x.tobytes(), u.tobytes(), self.derivation.refuted
        known = self._derivatives.pop(key, None)
        made = self._differentiate(names, t, x, u) if known is None else known
        if made is not None:
            self._derivatives[key] = made
            if len(self._derivatives) * made.nbytes > KEPT:
                del self._derivatives[next(iter(self._derivatives))]
        return made

    def _differentiate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        made = super().differentiate(names, t, x, u)
        if made is None or names in self._checked:
            return made
        self._checked.add(names)
        if names in self._differenced or self.block.is_built_here:
            return made
        found = check_exchange_slopes(
            self._fmu, self._wired, lambda x, u: self.evaluate(names, t, x, u), x, u, made[:, 1:]
        )
        if found.is_wrong:
            self.derivation = found.describe(self.derivation)
            return super().differentiate(names, t, x, u)
        if not self.derivation.gap >= found.gap:
            self.derivation = found.describe(self.derivation)
        self._note(float(np.max(found.error, initial=0.0, where=np.isfinite(found.error))), made[:, 1:])
        return made

    def slopes(self, ports: Sequence[str], *, rates: bool, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the FMU's own derivatives; None where they are refuted."""
        return None if self.derivation.refuted else super().slopes(ports, rates=rates, t=t, x=x, u=u)

    def _note(self, error: float, J: np.ndarray) -> None:
        self.error = max(self.error, error)
        if error:
            self.noise = max(self.noise, error / float(np.max(np.abs(J), initial=error)))

    def differences(
        self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray, scale: float = 1.0
    ) -> np.ndarray:
        """Return the derivative of `evaluate` by (x, u), by differences whose error is estimated."""
        if x.size and not self._fmu.description.states:  # its states have no names by which they could be moved
            found = super().differences(names, t, x, u)
            error = float(np.abs(found - super().differences(names, t, x, u, 2.0)).max(initial=0.0))
            coarseness = 0.0
        else:
            made = find_exchange_slopes(self._fmu, self._wired, lambda x, u: self.evaluate(names, t, x, u).copy(), x, u)
            found, error, coarseness = made.J, float(np.max(made.error, initial=0.0)), made.find_coarseness()
        self._note(error, found)
        self._differenced.add(names)
        worst = max(coarseness, self.derivation.coarseness)
        self.derivation = replace(self.derivation, method=DerivativeMethod.DIFFERENCES, coarseness=worst)
        return found


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


def load_evaluators(flat: FlatDiagram, at: OperatingPoint) -> Mapping[str, PointEvaluator]:
    """Return new evaluators of the FMUs in model exchange at an operating point, as `evaluators_at` does."""
    held, stack = _Held(), ExitStack()
    weakref.finalize(held, stack.close)
    for path in flat.in_model_exchange:
        block = cast("Fmu", flat.table.blocks[path])
        evaluator = held[path] = PointEvaluator(flat, path)
        try:
            made = block.replace(start={**block.start, **settable(block, states_at(flat, at, path))})
            instance = stack.enter_context(made.exchange(evaluator._wired, start_time=at.t))
            instance.exchange(_inputs_at(flat, at, path))
            instance.begin_exchange()
            if instance.ends_run:
                raise FmuError(
                    f"the FMU asks to end the simulation (terminateSimulation) at t = {at.t:.9g} s, so it has no "
                    "linear model there. Choose another operating point."
                )
        except FmuError as error:
            error.at(block=path)
            raise
        evaluator.load(instance)
    return held


def linearize_exchanged(flat: FlatDiagram, at: OperatingPoint, path: str) -> FmuLinearization:
    """Return the linear model of the equations of an FMU in model exchange at a point."""
    block = cast("Fmu", flat.table.blocks[path])
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
