"""States that blocks leave out with their parameters: the reason, for errors about names that are not found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .structure import join


def explain_absent_state(blocks: Mapping[str, Any], name: str) -> str:
    """Return why a state whose path is, or ends in, ``name`` is left out, with a next step; "" if none is."""
    for path, block in blocks.items():
        for state, reason in getattr(block, "absent_states", {}).items():
            full = join(path, state)
            if full == name or full.endswith("." + name):
                return f"{path!r} has no state {state!r}: {reason}."
    return ""
