"""Settings of a subsystem: its sample time, method, offset and delay, and the condition on which it acts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, SupportsFloat

from ...blocks.core import (
    Grid,
    SampleTimeError,
    Sheet,
    ShownAsTable,
    WiringError,
    brief,
    explain_calls,
    read_time,
)
from ...blocks.tracing import check_method

ENABLED, TRIGGERED = ("held", "reset"), ("rising", "falling", "both")
"""States of an enabled subsystem that is enabled again, and edges that trigger one."""
CONTROL_INPUTS = {"enabled": "enable", "triggered": "trigger", "": ""}
"""The input that decides whether a subsystem acts, by its kind of control."""


@explain_calls
@dataclass(frozen=True)
class SubsystemSettings:
    """Settings of a subsystem, or of the diagram itself (path "").

    Attributes
    ----------
    sample_time : Fraction or None
        Its own sample time in s; None where that of its surroundings holds.
    method : str or None
        Discretization of continuous blocks in it; None: as in its surroundings, see `Structure.method`.
    offset : Fraction
        Time of its first tick in s, where it has a sample time.
    delay : int
        Computational delay of its outputs in samples.
    control : str
        "enabled" or "triggered" for a subsystem that acts on a condition, else "".
    when : str
        For an enabled subsystem "held" or "reset": its states when it is enabled again. For a triggered one the edge:
        "rising", "falling" or "both".
    """

    path: str
    sample_time: Fraction | None
    method: str | None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    offset: Fraction = Fraction(0)
    delay: int = 0
    control: str = ""
    when: str = ""

    def __repr__(self) -> str:
        facts = [text for text in (self.rate, f"{self.control} ({self.when})" if self.control else "") if text]
        return f"<settings of {self.path or 'the diagram'}: {', '.join(facts) or 'those around it'}>"

    @property
    def rate(self) -> str:
        """Its sample time, offset and delay in words; "" where it has none."""
        if self.sample_time is None:
            return ""
        offset = f" from {float(self.offset):g} s on" if self.offset else ""
        delay = f", delay {self.delay}" if self.delay else ""
        return f"every {float(self.sample_time):g} s{offset}{delay}"

    @classmethod
    def of(
        cls,
        path: str,
        *,
        sample_time: float | Fraction | None = None,
        method: str | None = None,
        offset: float | Fraction = 0,
        delay: int = 0,
        enabled: str | None = None,
        triggered: str | None = None,
    ) -> SubsystemSettings:
        """Return checked settings; the keywords are those of `subsystem`."""
        if enabled is not None and triggered is not None:
            raise WiringError(
                "it is both enabled and triggered; put an enabled subsystem into a triggered one, or the reverse.",
                block=path,
            )
        for key, value, allowed in (("enabled", enabled, ENABLED), ("triggered", triggered, TRIGGERED)):
            if value is not None and value not in allowed:
                raise WiringError(
                    f"found {key}={value!r}; expected {' or '.join(map(repr, allowed))}. Give one of these.", block=path
                )
        control = "enabled" if enabled else "triggered" if triggered else ""
        given = cls(path, sample_time, method, (), (), offset, delay, control, enabled or triggered or "")  # type: ignore[arg-type]
        return given.checked()

    def changed(self, name: str, value: Any) -> SubsystemSettings:
        """Return the settings with another sample time, method, offset or delay, checked."""
        return replace(self, **{name: value}).checked()

    def checked(self) -> SubsystemSettings:
        """Return the settings with exact times; SampleTimeError: for those that can't be, or don't fit together."""
        if self.method is not None:
            check_method(self.method, self.path)
        time = None if self.sample_time is None else exact_time(self.sample_time, block=self.path)
        offset = _exact_offset(self.offset, time, block=self.path)
        return replace(self, sample_time=time, offset=offset, delay=_check_delay(self.delay, time, block=self.path))


class SubsystemTable(dict[str, SubsystemSettings], ShownAsTable):
    """Settings of subsystems by path, shown as a table."""

    def __repr__(self) -> str:
        return brief("subsystems", *(path for path in self if path), then='["path"].sample_time')

    def _sheet(self) -> Sheet:
        rows = [
            (path or "(the diagram)", one.rate, f"{one.control} {one.when}".strip(), ", ".join(one.inputs))
            for path, one in self.items()
        ]
        return Sheet("subsystems", (), (Grid("", ("path", "sample time", "control", "inputs"), tuple(rows)),))


def exact_time(value: SupportsFloat | str, *, block: str = "") -> Fraction:
    """Return a sample time as an exact fraction of a second: a Fraction as it is, a float as `read_time` reads it."""
    try:
        if isinstance(value, bool):
            raise TypeError
        time = value if isinstance(value, Fraction) else read_time(float(value))
    except (TypeError, ValueError, OverflowError):
        raise SampleTimeError(
            f"found the sample time {value!r}; expected seconds. Give a number, such as 1e-3.", block=block
        ) from None
    if float(value) <= 0:
        raise SampleTimeError(
            f"found a sample time of {float(value):g} s; expected a positive one. Give seconds, such as 1e-3.",
            block=block,
        )
    if time is None:
        raise SampleTimeError(
            f"found a sample time of {float(value)!r} s, which is neither a multiple of 1 ns nor a fraction with a "
            f"denominator up to 1,000,000. Give a Fraction, which is taken exactly, or round it"
            f"{f', for instance to {near!r}' if (near := round(float(value), 9)) else ''}.",
            block=block,
        )
    return time


def _exact_offset(value: SupportsFloat | str, sample_time: Fraction | None, *, block: str) -> Fraction:
    """Return an offset as an exact fraction of a second."""
    if isinstance(value, int | float | Fraction) and not isinstance(value, bool) and value == 0:
        return Fraction(0)
    offset = exact_time(value, block=block)
    if sample_time is None:
        raise SampleTimeError("it has an offset but no sample time; give it sample_time=….", block=block)
    if offset >= sample_time:
        raise SampleTimeError(
            f"found an offset of {float(offset):g} s; expected less than the sample time, {float(sample_time):g} s. "
            f"Give {float(offset % sample_time):g}, at which the later ticks are as well, or a longer sample time.",
            block=block,
        )
    return offset


def _check_delay(value: object, sample_time: Fraction | None, *, block: str) -> int:
    """Return a computational delay in samples, checked."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise SampleTimeError(
            f"found delay={value!r}; expected a whole number of samples, 0 or more. Give one, such as delay=1; a delay "
            "in seconds is TransportDelay(delay=…).",
            block=block,
        )
    if value and sample_time is None:
        raise SampleTimeError("it has a delay but no sample time; give it sample_time=….", block=block)
    return value
