"""The class of loops, loaded when the first loop is made: python-control takes a second to import."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .loop_transfer import LoopTransfer


def loop_class() -> type[LoopTransfer]:
    """Return `LoopTransfer`."""
    from .loop_transfer import LoopTransfer

    return LoopTransfer
