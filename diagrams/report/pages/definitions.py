"""Definitions of the numbers of a report, by the last part of their paths that is a term."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from importlib.resources import files
from types import MappingProxyType

LOOP_TERMS = frozenset({"phase_margin_deg", "gain_margin_low", "gain_margin_high", "delay_margin_s", "ms", "mt"})
"""Terms whose definitions take the loop for granted."""


def read_definitions(package: str) -> Mapping[str, str]:
    """Return the definitions that a package has in its file ``definitions.toml``, by term."""
    text = files(package).joinpath("definitions.toml").read_text(encoding="utf-8")
    return MappingProxyType({term: str(said) for term, said in tomllib.loads(text).items()})


DEFINITIONS = read_definitions(__package__)
"""Definitions of the terms of any report."""


def definition(path: str, more: Mapping[str, str] = MappingProxyType({})) -> tuple[str, str] | None:
    """Return the term that defines a number, and its definition; None where none is known.

    A term defines the names that begin with it, too: ``gain_crossover`` defines ``gain_crossover_1``. A term of two
    parts, such as ``gain_crossover.phase_margin_deg``, comes before those of one.
    """
    parts = path.split(".")
    if parts[0] == "subject" and parts[-1] != "sample_time":  # subsystems, blocks and parameters have their own names
        parts = ["subject"]
    elif parts[0] == "inner" and parts[-2:-1] == ["control"] and len(parts) > 4:  # inner.WIRE.VARIANT….control.NUMBER
        parts = ["control"]
    elif parts[0] in ("inner", "injection"):
        del parts[1:2]  # the wire's name
    elif parts[0] == "steps":
        parts = ["effort"] if "effort" in parts else parts[2:]  # without the names of wires
    for pair in (f"{name}.{parts[-1]}" for name in _beginnings(parts[-2])) if len(parts) > 1 else ():
        for known in (more, DEFINITIONS):
            if pair in known:
                return pair, known[pair]
    for part in reversed(parts):
        for name in _beginnings(part):
            for known in (more, DEFINITIONS):
                if name in known:
                    return name, known[name]
    return None


def _beginnings(name: str) -> Iterator[str]:
    """Yield a name, and what is ahead of each of its underscores, the longest first."""
    while name:
        yield name
        name = name.rpartition("_")[0]
