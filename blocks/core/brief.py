"""Short texts of results, for a cell of a notebook or an error: the kind, the facts that matter, and next steps."""

from __future__ import annotations

from collections.abc import Iterable


def brief(kind: str, *facts: str, then: str = "") -> str:
    """Return a short text of a value, such as ``<run of 'drive': 11 samples; run['y']>``, without empty facts."""
    shown = ", ".join(fact for fact in facts if fact)
    return f"<{kind}{': ' if shown else ''}{shown}{'; ' if then else ''}{then}>"


def enumerate_some(names: Iterable[str], most: int = 4) -> str:
    """Return some names in a row, and the number of the others: ``x, y and 1 more``."""
    found = list(names)
    more = f" and {len(found) - most} more" if len(found) > most else ""
    return ", ".join(found[:most]) + more


def count_of(n: int, noun: str) -> str:
    """Return a number of things: ``"1 state"``, ``"3 states"``, ``"2 frequencies"``."""
    if n == 1:
        return f"{n} {noun}"
    return f"{n} {noun[:-1]}ies" if noun[-1] == "y" and noun[-2] not in "aeiou" else f"{n} {noun}s"
