"""Linear systems of python-control where something else is expected: a short text, and the block to make of one."""

from __future__ import annotations

from typing import Any

_KINDS = ("StateSpace", "TransferFunction")  # the blocks have the names of python-control's classes


def kind_of_system(value: Any) -> str:
    """Return the class of python-control's that a linear system is of, "" of anything else; it isn't imported."""
    names = (base.__name__ for base in type(value).__mro__ if base.__module__.partition(".")[0] == "control")
    return next((name for name in names if name in _KINDS), "")


def system_text(value: Any) -> str:
    """Return a short text of a linear system of python-control, "" of anything else."""
    kind = kind_of_system(value)
    return f"<control.{kind}, {value.ninputs} → {value.noutputs}>" if kind else ""


def as_block(value: Any, wired: str = "") -> str:
    """Return what to write for a linear system of python-control, wired by ``"(u)"``, say; "" of anything else."""
    if not (kind := kind_of_system(value)):
        return ""
    block = kind if value.dt in (0, None) else f"Discrete{kind}"
    return f"A block is made of it by {block}.from_control(system){wired}"
