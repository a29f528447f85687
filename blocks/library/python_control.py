"""Linear systems from python-control, and back. Its import takes over a second, so it is imported when needed."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from ..core import Block, GuardError, ParameterError, SampleTimeError, kinds, parameter, shorten


def check_system(cls: type[Block], system: Any, kind: str) -> dict[str, Any]:
    """Refuse all but a system of this kind and of the block's time; return the keyword ``dt`` of a discrete one."""
    # a block is in discrete time if it is a `FixedSampleTime`; a system with dt=None may be in either
    import control

    wanted = getattr(control, kind)
    if not isinstance(system, wanted):
        other = isinstance(system, control.StateSpace | control.TransferFunction)
        step = f"Convert it: control.{'ss' if kind == 'StateSpace' else 'tf'}(system)." if other else "Give one."
        if not other and isinstance(system, control.NonlinearIOSystem):
            step = "Write its equations as a Block, or take its linear model: control.linearize(system, x0, u0)."
        raise ParameterError(
            f"found a {type(system).__name__}; expected a control.{kind}. {step}", block=cls.__name__, port="system"
        )
    dt, discrete = system.dt, issubclass(cls, FixedSampleTime)
    if dt is not None and (dt == 0) == discrete:
        found, expected = ("continuous", "discrete") if discrete else ("discrete", "continuous")
        other_class = cls.__name__.removeprefix("Discrete") if discrete else f"Discrete{cls.__name__}"
        step = f"Use {other_class}" + (", or sample it: control.sample_system(system, T)." if discrete else ".")
        raise ParameterError(
            f"found a system in {found} time (dt={dt!r}); expected {expected} time. {step}",
            block=cls.__name__,
            port="system",
        )
    if not discrete:
        return {}
    return {"dt": None if dt is None or dt is True else float(dt)}


def names_of(system: Any) -> dict[str, tuple[str, ...]]:
    """Return the names that a user gave to a system's signals, without those that python-control makes up."""
    found = {"input_names": system.input_labels, "output_names": system.output_labels}
    if hasattr(system, "state_labels"):
        found["state_names"] = system.state_labels
    return {k: tuple(v) for k, v in found.items() if not all(re.fullmatch(r"[uyx]\[\d+\]", name) for name in v)}


def block_name(system: Any, name: str | None) -> str | None:
    """Return the name given, else the system's if it is an identifier (a made-up one, ``sys[0]``, is none)."""
    return system.name if name is None and system.name.isidentifier() else name


def check_single(cls: type[Block], system: Any) -> None:
    """Refuse a transfer function of several inputs or outputs."""
    if system.ninputs != 1 or system.noutputs != 1:
        raise ParameterError(
            f"found {system.ninputs} inputs and {system.noutputs} outputs; expected one each. Take one entry, "
            "system[0, 0], or use the state space: control.ss(system).",
            block=cls.__name__,
            port="system",
        )


def labels(block: Any) -> dict[str, Any]:
    """Return a block's names as keywords of python-control's constructors."""
    found = {
        "inputs": block.input_names,
        "outputs": block.output_names,
        "states": getattr(block, "state_names", None),
        "name": block.name,
    }
    return {k: v if isinstance(v, str) else list(v) for k, v in found.items() if v is not None}


def sample_time_of(block: Block) -> float | bool:
    """Return ``dt`` of a block as python-control spells it: 0 in continuous time, True where it is not given."""
    if not isinstance(block, FixedSampleTime):
        return 0
    return True if block.dt is None else float(block.dt)


def check_names(block: Any, **numbers: int) -> None:
    """Refuse a number of names that is not that of the signals."""
    for port, n in numbers.items():
        names = getattr(block, port)
        if names is not None and not kinds.names.holds(names):
            raise ParameterError(
                f"found {shorten(names)}; expected a name for each of the {n}. Give texts.",
                port=port,
            )
        if names is not None and len(names) != n:
            raise ParameterError(
                f"found {len(names)} names ({', '.join(map(str, names))}); expected {n}. Give one for each.",
                port=port,
            )


MADE_FOR: Any = parameter(
    default=None, unit="s", above=0.0, structural=True, description="sample time that it is made for; None: any"
)
"""The parameter ``dt`` of blocks in discrete time."""


class FixedSampleTime:
    """Part of blocks with a parameter ``dt``, which must be the sample time of the block's subsystem."""

    dt: Any
    label: Any

    def constants(self, T: float, method: str) -> dict[str, Any]:
        """Compare the sample times when numbers are computed for one."""
        if T != 1.0:  # tracing passes 1 s, whatever the subsystem's sample time is
            self.check_rate(T)
        return {}

    def check_rate(self, T: float) -> None:
        """Compare the sample times when the diagram is built."""
        if self.mismatch(T):
            raise SampleTimeError(self._message(T), block=self.label, port="dt")

    def mismatch(self, T: float) -> bool:
        """Whether ``T`` is another sample time than ``dt``, beyond rounding."""
        return self.dt is not None and not np.isclose(self.dt, T, rtol=1e-9, atol=0.0)

    def guards(self, t: Any, x: Any, u: Any, T: Any) -> dict[str, Any]:
        """Compare the sample times in the run as well, since they may have changed."""
        return {} if self.dt is None else {"sample_time": 1e-9 - np.abs(T / self.dt - 1.0)}

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> Any:
        """Return the error of sample times that differ."""
        return GuardError(self._message(None), block=self.label, port="dt")

    def _message(self, T: float | None) -> str:
        found = "another sample time" if T is None else f"a sample time of {T:.9g} s"
        return (
            f"found {found} in the subsystem; expected {self.dt:.9g} s, for which the block is made. "
            "Sample the continuous system with the subsystem's, set the subsystem's sample_time, or give dt=None if "
            "the block is meant for any."
        )
