"""Findings carried from loops to the numbers and systems that are made from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

from ...blocks.core import ConfirmationError, Finding
from .number import Number
from .state_space import findings_of, inexactness_of

P = ParamSpec("P")
R = TypeVar("R")


def carries_findings(function: Callable[P, R]) -> Callable[P, R]:
    """Give the result of a function the findings of the systems among its arguments."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        given = [*args, *kwargs.values()]
        try:
            made = function(*args, **kwargs)
        except ConfirmationError as error:
            for system in given:
                _say_how_exact(error, cast("Any", system))
            raise
        return with_findings(made, tuple(f for system in given for f in findings_of(cast("Any", system))))

    return run


def _say_how_exact(error: ConfirmationError, system: Any) -> None:
    """Add to an error that its system is not known well enough, if it isn't."""
    inexactness = inexactness_of(system)
    if inexactness:
        why = "; ".join(map(str, findings_of(system)))
        error.add(
            f" The loop itself is known to {inexactness:.1g} of its largest entry alone"
            f"{f' ({why})' if why else ', by differences of an FMU'}: a pole and a zero that cancel may seem apart."
        )


def with_findings(value: R, findings: tuple[Finding, ...]) -> R:
    """Return a number, a system, or a collection or result of them, with findings added to each number and system."""
    if not findings:
        return value
    return cast("R", _add(value, findings))


def _add(value: Any, findings: tuple[Finding, ...]) -> Any:
    from control import StateSpace

    if isinstance(value, Number):
        return replace(value, findings=_join(value.findings, findings))
    if isinstance(value, StateSpace):
        value.findings = _join(findings_of(value), findings)
        return value
    if isinstance(value, Mapping):
        return {key: _add(entry, findings) for key, entry in value.items()}
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(_add(entry, findings) for entry in value)
    if is_dataclass(value) and not isinstance(value, Finding | type):
        changed = {f.name: _add(getattr(value, f.name), findings) for f in fields(value) if f.name != "findings"}
        if any(f.name == "findings" for f in fields(value)):
            changed["findings"] = _join(getattr(value, "findings"), findings)  # noqa: B009 - of any dataclass
        return replace(value, **changed)
    return value


def _join(first: tuple[Finding, ...], second: tuple[Finding, ...]) -> tuple[Finding, ...]:
    return tuple(dict.fromkeys((*first, *second)))
