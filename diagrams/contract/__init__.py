"""The contract of a block, checked."""

from .contract import BlockReport, check_block

__all__ = [
    "BlockReport",
    "check_block",
]
