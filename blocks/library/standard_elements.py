"""Linear elements by the names that control engineers have for them: PT1, PT2, lead-lag, notch, Butterworth.

All are linear in their states, so a sampled subsystem discretizes them exactly for an input that is held.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ..core import Array, Block, Input, Output, ParameterError, State, kinds, parameter, shorten
from .zero_pole import ContinuousCascade, Numbers


class PT1(Block):
    """First-order lag: T ẏ = K u − y, Y(s) = K / (T s + 1) U(s), element by element.

    Its step response reaches 63 % of the final value at T, its cut-off frequency is 1 / T in rad/s.
    """

    gain: float = parameter(default=1.0, description="gain K")
    time_constant: float = parameter(unit="s", above=0.0, description="time constant T")
    initial_value: Array = parameter(default=0.0, description="y at the start, a number or of the input's shape")
    u = Input(shape=None, description="input, of any shape")
    y = State(start="initial_value", like="u", output=True, description="the lagged signal")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return f"{self.gain:.4g} / {self.time_constant:.4g} s + 1"

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẏ."""
        return (self.gain * u.u - x.y) / self.time_constant


class PT2(Block):
    """Second-order lag: T² ÿ + 2 D T ẏ + y = K u, Y(s) = K / (T² s² + 2 D T s + 1) U(s), element by element.

    Its natural frequency is ω₀ = 1 / T in rad/s. With D < 1 it oscillates, and its step response overshoots by
    exp(−π D / √(1 − D²)).
    """

    gain: float = parameter(default=1.0, description="gain K")
    time_constant: float = parameter(unit="s", above=0.0, description="time constant T, 1 / ω₀")
    damping_ratio: float = parameter(minimum=0.0, description="damping ratio D")
    initial_value: Array = parameter(default=0.0, description="y at the start, a number or of the input's shape")
    u = Input(shape=None, description="input, of any shape")
    y = State(start="initial_value", like="u", output=True, description="the lagged signal")
    rate = State(like="u", description="T ẏ")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        T, D = self.time_constant, self.damping_ratio
        return f"{self.gain:.4g} / {T * T:.3g} s² + {2.0 * D * T:.3g} s + 1"

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return ẏ, and the rate of T ẏ."""
        T = self.time_constant
        return x.rate / T, (self.gain * u.u - x.y - 2.0 * self.damping_ratio * x.rate) / T


class LeadLag(Block):
    """Lead-lag element: Y(s) = K (T₁ s + 1) / (T₂ s + 1) U(s), element by element; it starts at rest for u = 0.

    With T₁ > T₂ it leads: the phase is largest, arcsin((T₁ − T₂) / (T₁ + T₂)), at 1 / √(T₁ T₂) in rad/s. With T₁ < T₂
    it lags.
    """

    gain: float = parameter(default=1.0, description="gain K at low frequencies")
    lead_time: float = parameter(unit="s", minimum=0.0, description="time constant of the numerator, T₁")
    lag_time: float = parameter(unit="s", above=0.0, description="time constant of the denominator, T₂")
    u = Input(shape=None, description="input, of any shape")
    y = Output(shape=None, description="output")
    slow = State(like="u", description="the input behind the lag")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return (
            f"{self.lead_time:.4g} s + 1 / {self.lag_time:.4g} s + 1" if self.gain == 1 else "K (T₁ s + 1) / T₂ s + 1"
        )

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the output."""
        return self.gain * (x.slow + self.lead_time / self.lag_time * (u.u - x.slow))

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the rate of the lag."""
        return (u.u - x.slow) / self.lag_time


class Notch(Block):
    """Notch filter: Y(s) = (s² + d b s + ω₀²) / (s² + b s + ω₀²) U(s), ω₀ = 2π f₀, b = 2π · bandwidth.

    It takes a narrow band out, around f₀, such as a resonance. At f₀ its gain is the depth d; of a full notch, d = 0,
    the gain is 1/√2 at two frequencies that are the bandwidth apart. Its quality factor, as `scipy.signal.iirnotch` has
    it, is f₀ / bandwidth.
    """

    frequency: float = parameter(unit="Hz", above=0.0, description="centre frequency f₀")
    bandwidth: float = parameter(unit="Hz", above=0.0, description="width of the band")
    depth: float = parameter(default=0.0, minimum=0.0, description="gain d at the centre; 0 takes it out in full")
    u = Input(description="input")
    y = Output(like="u", description="the filtered signal")
    x = State(shape=(2,), description="band-pass and low-pass state, in the frequency s / ω₀")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return f"notch {self.frequency:.4g} Hz"

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the input less the band."""
        width = self.bandwidth / self.frequency
        return u.u - (1.0 - self.depth) * width * x.x[0]

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the rates of the resonator ω₀ s / (s² + b s + ω₀²) and of its integral."""
        width = self.bandwidth / self.frequency
        return 2.0 * np.pi * self.frequency * np.stack([u.u - width * x.x[0] - x.x[1], x.x[0]])


_BANDS = {"lowpass": 1, "highpass": 1, "bandpass": 2, "bandstop": 2}


class Butterworth(ContinuousCascade):
    """Butterworth filter of any order, designed by `scipy.signal.butter` in continuous time; it starts at rest.

    The gain of a low-pass of order n is 1 / √(1 + (f / f_c)²ⁿ). A band-pass and a band-stop of order n have 2 n states.
    A sampled subsystem discretizes it exactly for an input that is held. For SciPy's digital design, by the bilinear
    transformation, use ``IIR.from_sos(scipy.signal.butter(4, 50.0, fs=1000.0, output="sos"))``.

    Raises
    ------
    ParameterError
        For another band, and for another number of cut-off frequencies than it has.
    """

    order: int = parameter(minimum=1, description="order n of the low-pass that it is made of")
    cutoff: Array = parameter(
        structural=True, above=0.0, unit="Hz", description="cut-off frequency f_c, or the lower and the upper one"
    )
    band: str = parameter(
        default="lowpass",
        description="'lowpass', 'highpass', 'bandpass' or 'bandstop'",
        kind=kinds.choice(*_BANDS),
    )
    gain: float = parameter(default=1.0, description="gain in the band")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return f"{self.band} {'–'.join(f'{f:.4g}' for f in np.atleast_1d(self.cutoff))} Hz"

    def check(self) -> None:
        """Refuse cut-off frequencies that don't make the band."""
        count = _BANDS[self.band]
        edges = np.atleast_1d(self.cutoff)
        if edges.shape != (count,) or np.any(np.diff(edges) <= 0.0):
            wanted = "one frequency" if count == 1 else "the lower and the upper frequency, such as (10.0, 20.0)"
            raise ParameterError(
                f"found {shorten(self.cutoff)} for a {self.band}; expected {wanted}. Give it in Hz.",
                port="cutoff",
            )

    def roots(self) -> tuple[Numbers, Numbers, Array]:
        """Return zeros, poles and gain."""
        zeros, poles, gain = _design(self.order, tuple(np.atleast_1d(self.cutoff).tolist()), self.band)
        return zeros, poles, self.gain * gain


@lru_cache(maxsize=128)
def _design(order: int, cutoff: tuple[float, ...], band: str) -> tuple[Numbers, Numbers, float]:
    from scipy.signal import butter

    edges = 2.0 * np.pi * np.array(cutoff if len(cutoff) > 1 else cutoff[0])
    zeros, poles, gain = butter(order, edges, band, analog=True, output="zpk")
    return tuple(map(complex, zeros)), tuple(map(complex, poles)), float(gain)


__all__ = ["PT1", "PT2", "Butterworth", "LeadLag", "Notch"]
