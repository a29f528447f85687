"""Errors in sentences for readers of a report, who called nothing: what was found and where, then what changes it."""

from __future__ import annotations

from ...blocks.core import LoopwrightError, SimulationError


def say_found(error: LoopwrightError) -> str:
    """Return what was found, as a sentence without its period; of a run, block, port and time follow in brackets."""
    found, where = error.what_was_found.strip().rstrip("."), ""
    if isinstance(error, SimulationError):
        who = ".".join(part for part in (error.block, error.port) if part)
        where = ", ".join(part for part in (who, "" if error.t is None else f"t = {error.t:.6g} s") if part)
    return f"{found[:1].upper()}{found[1:]}" + (f" ({where})" if where else "")


def say(error: LoopwrightError) -> str:
    """Return what was found, and the next step for the diagram's author."""
    return f"{say_found(error)}." + (f" To change it: {error.next_step}" if error.next_step else "")
