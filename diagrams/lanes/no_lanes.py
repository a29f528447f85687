"""The reason for which runs can't go side by side."""

from __future__ import annotations


class NoLanesError(Exception):
    """Runs of a diagram can't go side by side in the lanes of a vector; the text says why, as a clause."""
