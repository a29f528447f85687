"""First-order hold: a sampled signal becomes straight lines."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from ...blocks.core import Gain, Signal, check_name, explain_calls
from ...blocks.library import Sawtooth, UnitDelay
from .subsystem_settings import exact_time
from .subsystems import subsystem


@explain_calls
def first_order_hold(
    u: Any, sample_time: float | Fraction, *, offset: float | Fraction = 0, name: str = "first_order_hold"
) -> Signal:
    """Return a sampled signal, continued from each tick along the line through the last two samples.

    y(t) = u[k] + (u[k] − u[k − 1]) / T (t − t_k) from t_k to the next tick. It is a subsystem of a sampled part, which
    makes the slope, and of a sawtooth, the time since the tick; linear models over a period have its true effect.
    A zero-order hold is what every wire from a sampled subsystem has anyway.

    Åström and Wittenmark, Computer-Controlled Systems, 3rd edition, 7.5.

    Parameters
    ----------
    u : signal
        Signal to hold, of any shape: sampled here, so it may be a continuous one.
    sample_time : float or Fraction
        Sample time T in s, that of the subsystem where the signal comes from.
    offset : float or Fraction
        Time of the first tick in s, as that subsystem has it.
    name : str
        Name of the subsystem.

    Raises
    ------
    SampleTimeError
        As `subsystem`.

    Examples
    --------
    >>> from loopwright import Diagram
    >>> from loopwright.blocks import Ramp
    >>> from loopwright.diagrams import first_order_hold
    >>> line = first_order_hold(Ramp(slope=2.0), 0.1)
    >>> Diagram("d", line.named("y")).simulate(0.2, step=0.05, progress=False)["y"].round(12).tolist()
    [0.0, 0.0, 0.2, 0.3, 0.4]
    """
    T = exact_time(sample_time, block=check_name(name))

    def hold(u: Any) -> Any:
        change = u - UnitDelay(name="last")(u)
        return {"value": Gain(gain=1.0, name="value")(u), "slope": Gain(gain=float(1 / T), name="slope")(change)}

    def around(u: Any) -> Any:
        held = subsystem(sample_time=T, offset=offset, name="samples")(hold)(u)
        half = float(T / 2)
        since = Sawtooth(amplitude=half, bias=half, period=float(T), delay=float(offset), name="since")
        return held["value"] + held["slope"] * since

    result: Signal = subsystem(name=name)(around)(u)._signal()
    return result
