"""Symbols inside the blocks of a drawing: a value, a transfer function, a characteristic, a waveform.

A block of a user's own says it by the property ``drawn_inside``; " / " makes a fraction of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np

from ...blocks import (
    FIR,
    IIR,
    PID,
    And,
    Backlash,
    BandLimitedNoise,
    Block,
    Clock,
    Compare,
    Constant,
    Counter,
    DeadZone,
    Delay,
    DiscreteIntegrator,
    DiscreteStateSpace,
    DiscreteTransferFunction,
    DiscreteZeroPoleGain,
    EdgeDetector,
    Encoder,
    FilteredDerivative,
    Function,
    Gain,
    Hold,
    Integrator,
    Latch,
    LimitedIntegrator,
    Lookup1D,
    Maximum,
    Minimum,
    MovingAverage,
    Not,
    Or,
    PadeDelay,
    Product,
    Quantizer,
    RateLimiter,
    Reference,
    Relay,
    ResettableIntegrator,
    Saturation,
    StateSpace,
    Switch,
    TransferFunction,
    TransportDelay,
    UnitConversion,
    UnitDelay,
    ZeroPoleGain,
)
from ...blocks.core import Source
from .shapes import GREY, INK, text_at, width_of

LONGEST = 22
"""Number of characters above which a polynomial is written as b(s) or a(s)."""

Curve = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Symbol:
    """The inside of a block: a line of text, a fraction, or a curve."""

    text: str = ""  # or the numerator
    below: str = ""  # the denominator; empty for a line of text
    curve: Curve = ()  # points, each from -1 to 1, y upwards
    axes: bool = False  # it has axes through the middle, as a characteristic has

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in pixels."""
        if self.curve:
            return 34.0, 24.0
        return max(width_of(self.text, 10.5), width_of(self.below, 10.5)) + 4, 30.0 if self.below else 14.0

    def draw(self, x: float, y: float) -> str:
        """Return it as SVG, around a middle."""
        if self.curve:
            cross = f"M{x - 17:g} {y:g}h34M{x:g} {y - 12:g}v24"
            axes = f'<path class="lw-axes" d="{cross}" stroke="{GREY}" stroke-width="0.5"/>'
            path = "L".join(f"{round(x + 16 * a, 1):g} {round(y - 11 * b, 1):g}" for a, b in self.curve)
            stroke = f'<path class="lw-curve" d="M{path}" fill="none" stroke="{INK}" stroke-width="1.3"/>'
            return axes * self.axes + stroke
        if not self.below:
            return text_at(x, y + 3.5, self.text, 10.5, anchor="middle")
        half = self.size[0] / 2
        bar = f'<path class="lw-curve" d="M{x - half:g} {y:g}h{2 * half:g}" stroke="{INK}" stroke-width="0.8"/>'
        return (
            text_at(x, y - 4, self.text, 10.5, anchor="middle")
            + bar
            + text_at(x, y + 12, self.below, 10.5, anchor="middle")
        )


def symbol_of(block: Block) -> Symbol | None:
    """Return what is drawn inside a block; None for nothing."""
    text = block.drawn_inside
    if text:
        above, _, below = text.partition(" / ")
        return Symbol(above, below)
    return _symbol(block)


@singledispatch
def _symbol(block: Block) -> Symbol | None:
    return None


# --- symbols that are the same for all blocks of a kind -------------------------------------------------------------

_LOW, _HIGH = ((-1.0, -0.7), (-0.45, -0.7)), ((0.45, 0.7), (1.0, 0.7))
_STAIRS = Symbol(
    curve=tuple((x, 0.4 * i) for i in range(-2, 3) for x in (0.4 * i - 0.2, 0.4 * i + 0.2)),
    axes=True,
)
_ZIGZAG = tuple((-1.0 + 0.1 * i, 0.85 * math.sin(7.3 * i * i + 1.1 * i)) for i in range(21))
_HYSTERESIS = ((-1.0, -0.7), (0.35, -0.7), (0.35, 0.7), (1.0, 0.7), (-0.35, 0.7), (-0.35, -0.7))
_FIXED: dict[type[Block], Symbol] = {
    And: Symbol("∧"),
    Or: Symbol("∨"),
    Not: Symbol("¬"),
    Minimum: Symbol("min"),
    Maximum: Symbol("max"),
    Product: Symbol("×"),
    Clock: Symbol("t"),
    Counter: Symbol("count"),
    Latch: Symbol("S R"),
    Hold: Symbol("hold"),
    UnitDelay: Symbol("z⁻¹"),
    FIR: Symbol("Σ bₖ z⁻ᵏ"),
    IIR: Symbol("b(z)", "a(z)"),
    StateSpace: Symbol("ẋ = A x + B u"),
    DiscreteStateSpace: Symbol("x⁺ = A x + B u"),
    Integrator: Symbol("1", "s"),
    LimitedIntegrator: Symbol("1", "s"),
    ResettableIntegrator: Symbol("1", "s"),
    Quantizer: _STAIRS,
    Encoder: _STAIRS,
    Relay: Symbol(curve=_HYSTERESIS, axes=True),
    Backlash: Symbol(curve=((-0.9, -0.7), (-0.3, -0.7), (0.9, 0.7), (0.3, 0.7), (-0.9, -0.7)), axes=True),
    RateLimiter: Symbol(curve=((-1.0, -0.7), (-0.5, -0.7), (0.5, 0.7), (1.0, 0.7))),
    Switch: Symbol(curve=((-1.0, 0.6), (-0.5, 0.6), (0.5, 0.0), (1.0, 0.0))),
    EdgeDetector: Symbol(curve=((-1.0, -0.7), (0.0, -0.7), (0.0, 0.7), (1.0, 0.7))),
    BandLimitedNoise: Symbol(curve=_ZIGZAG),
}
for _kind, _shown in _FIXED.items():
    _symbol.register(_kind, lambda block, shown=_shown: shown)

# --- numbers and polynomials ----------------------------------------------------------------------------------------


def _number(value: Any) -> str:
    """Write a number, or the size of a matrix."""
    array = np.asarray(value)
    if array.dtype == object or array.ndim > 1 or array.size > 3:
        return " × ".join(map(str, array.shape)) if array.ndim > 1 else f"{array.size} numbers"
    texts = [f"{float(v):.4g}".replace("-", "−") for v in array.ravel()]
    return texts[0] if array.ndim == 0 or array.size == 1 else f"({', '.join(texts)})"


def _power(variable: str, exponent: int) -> str:
    digits = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return "" if exponent == 0 else variable if exponent == 1 else variable + digits


def _polynomial(coefficients: Any, variable: str, *, name: str) -> str:
    """Write a polynomial, highest power first; one that is long by a name."""
    values = np.atleast_1d(np.asarray(coefficients, dtype=float))
    out = ""
    for i, value in enumerate(values):
        power = _power(variable, len(values) - 1 - i)
        if not value:
            continue
        size = "" if abs(value) == 1 and power else f"{abs(value):.3g}"
        sign = "−" if value < 0 else ""
        joined = f" {sign or '+'} " if out else sign
        out += f"{joined}{size}{' ' if size and power else ''}{power}"
    return (out or "0") if len(out) <= LONGEST else f"{name}({variable})"


def _roots(values: Sequence[complex], variable: str, *, name: str) -> str:
    """Write a product of factors; one that is long by a name."""
    out = ""
    for root in np.atleast_1d(np.asarray(values)):
        if np.iscomplex(root):
            return f"{name}({variable})"
        real = float(np.real(root))
        out += variable if not real else f"({variable} {'−' if real > 0 else '+'} {abs(real):.3g})"
    return (out or "1") if len(out) <= LONGEST else f"{name}({variable})"


def _factored(block: Any, variable: str) -> Symbol:
    zeros, poles = _roots(block.zeros, variable, name="b"), _roots(block.poles, variable, name="a")
    gain = "" if block.gain == 1 and zeros != "1" else _number(block.gain)
    return Symbol((gain if zeros == "1" else f"{gain} {zeros}".strip()) or "1", "" if poles == "1" else poles)


# --- linear blocks --------------------------------------------------------------------------------------------------


@_symbol.register(Gain)
def _(block: Any) -> Symbol:
    return Symbol(_number(block.gain))


@_symbol.register(Constant)
@_symbol.register(Reference)
def _(block: Any) -> Symbol:
    return Symbol(_number(block.value))


@_symbol.register(FilteredDerivative)
def _(block: Any) -> Symbol:
    return Symbol("s", f"{_number(block.time_constant)} s + 1")


@_symbol.register(TransferFunction)
def _(block: Any) -> Symbol:
    return _fraction(block, "s")


@_symbol.register(DiscreteTransferFunction)
def _(block: Any) -> Symbol:
    return _fraction(block, "z")


def _fraction(block: Any, variable: str) -> Symbol:
    below = _polynomial(block.denominator, variable, name="a")
    return Symbol(_polynomial(block.numerator, variable, name="b"), "" if below == "1" else below)


@_symbol.register(ZeroPoleGain)
def _(block: Any) -> Symbol:
    return _factored(block, "s")


@_symbol.register(DiscreteZeroPoleGain)
def _(block: Any) -> Symbol:
    return _factored(block, "z")


@_symbol.register(DiscreteIntegrator)
def _(block: Any) -> Symbol:
    above, below = {"forward": ("T", "z − 1"), "backward": ("T z", "z − 1")}.get(
        block.method, ("T (z + 1)", "2 (z − 1)")
    )
    return Symbol(above if block.gain == 1 else f"{_number(block.gain)} {above}", below)


@_symbol.register(MovingAverage)
def _(block: Any) -> Symbol:
    return Symbol(f"mean of {block.samples}")


@_symbol.register(Delay)
def _(block: Any) -> Symbol:
    return Symbol(_power("z", -int(block.steps)))


@_symbol.register(TransportDelay)
def _(block: Any) -> Symbol:
    return Symbol(f"exp(−{_number(block.delay)} s)")


@_symbol.register(PadeDelay)
def _(block: Any) -> Symbol:
    return Symbol(f"≈ exp(−{_number(block.delay)} s)")


@_symbol.register(PID)
def _(block: Any) -> Symbol:
    letters = [letter for letter, gain in (("P", block.kp), ("I", block.ki), ("D", block.kd)) if gain]
    return Symbol("".join(letters) or "0")


# --- characteristics ------------------------------------------------------------------------------------------------


def _characteristic(function: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> Symbol | None:
    """Draw y over u."""
    u = np.linspace(low, high, 65)
    with np.errstate(all="ignore"):
        y = np.asarray(function(u), dtype=float)
    size = float(np.max(np.abs(y))) if y.shape == u.shape and np.all(np.isfinite(y)) else 0.0
    if not size:
        return None
    reach = max(abs(low), abs(high))
    return Symbol(curve=tuple(zip((u / reach).tolist(), (0.9 * y / size).tolist(), strict=True)), axes=True)


def _limits(block: Any) -> tuple[float, float] | None:
    """Return the limits of a block of scalars; None where they are vectors."""
    if block.limit is not None:
        low, high = -np.asarray(block.limit), np.asarray(block.limit)
    else:
        low, high = np.asarray(block.lower), np.asarray(block.upper)
        low = -np.abs(high) if block.lower is None else low
        high = np.abs(low) if block.upper is None else high
    return (float(low), float(high)) if np.ndim(low) == np.ndim(high) == 0 else None


def _around(limits: tuple[float, float]) -> float:
    return 1.8 * max(abs(limits[0]), abs(limits[1])) or 1.0


@_symbol.register(Saturation)
def _(block: Any) -> Symbol | None:
    limits = _limits(block)
    if limits is None:
        return Symbol(curve=(*_LOW, *_HIGH), axes=True)
    reach = _around(limits)
    return _characteristic(lambda u: np.clip(u, *limits), -reach, reach)


@_symbol.register(DeadZone)
def _(block: Any) -> Symbol | None:
    limits = _limits(block)
    if limits is None:
        return Symbol(curve=((-1.0, -0.7), (-0.4, 0.0), (0.4, 0.0), (1.0, 0.7)), axes=True)
    reach = 2.0 * max(abs(limits[0]), abs(limits[1])) or 1.0
    return _characteristic(lambda u: u - np.clip(u, *limits), -reach, reach)


def _centred(values: np.ndarray) -> np.ndarray:
    """Scale values to -1 to 1."""
    low, high = float(values.min()), float(values.max())
    return np.asarray((2.0 * values - (high + low)) / ((high - low) or 1.0))


@_symbol.register(Lookup1D)
def _(block: Any) -> Symbol | None:
    points, values = np.asarray(block.breakpoints, dtype=float), np.asarray(block.values, dtype=float)
    if values.ndim > 1:
        return Symbol("table")
    x, y = _centred(points), 0.9 * _centred(values)
    step = max(len(x) // 64, 1)
    return Symbol(curve=tuple(zip(x[::step].tolist(), y[::step].tolist(), strict=True)))


# --- comparisons and functions ----------------------------------------------------------------------------------------


@_symbol.register(Compare)
def _(block: Any) -> Symbol:
    return Symbol(block.relation.replace(">=", "≥").replace("<=", "≤"))


@_symbol.register(Function)
def _(block: Any) -> Symbol | None:
    name = getattr(block.function, "__name__", "")
    return Symbol(f"{name}(…)") if name.isidentifier() else None


@_symbol.register(UnitConversion)
def _(block: Any) -> Symbol | None:
    units = block.from_unit, block.to_unit
    return Symbol(" → ".join(units)) if all(isinstance(unit, str) for unit in units) else None


# --- sources --------------------------------------------------------------------------------------------------------


@_symbol.register(Source)
def _(block: Any) -> Symbol | None:
    """Draw the waveform of a source, from its own equation."""
    end = _until(block)
    if not end:
        return None
    times = np.linspace(0.0, end, 97)
    with np.errstate(all="ignore"):
        values = [np.ravel(np.asarray(block.output(t, None, None), dtype=object))[0] for t in times.tolist()]
    y = np.asarray(values, dtype=float)
    if not np.all(np.isfinite(y)) or y.max() == y.min():
        return None
    scaled = 1.7 * (y - y.min()) / (y.max() - y.min()) - 0.85
    points = list(zip((2.0 * times / end - 1.0).tolist(), scaled.tolist(), strict=True))
    kept = [p for i, p in enumerate(points) if not 0 < i < 96 or not points[i - 1][1] == p[1] == points[i + 1][1]]
    return Symbol(curve=tuple(kept))


def _until(block: Any) -> float:
    """Return the time up to which the waveform of a source is drawn."""
    for name, factor in (("period", 2.0), ("duration", 1.0), ("frequency", 1.5)):
        value = getattr(block, name, None)
        if isinstance(value, (int, float)) and value > 0:
            return factor / value if name == "frequency" else factor * float(value)
    known = [float(t) for t in np.ravel(block.instants()) if math.isfinite(t) and t > 0]
    if known:
        return 1.3 * max(known)
    slope = getattr(block, "slope", None)
    return 1.0 if slope else 0.0
