"""Blocks that a run evaluates from outside, such as FMUs in model exchange: their evaluators and their events."""

from .evaluator import OWN_EVENTS, ExchangedBlock, ExchangeEvaluator
from .events import OutsideEvents
from .exchanged_blocks import ExchangedBlocks

__all__ = [
    "OWN_EVENTS",
    "ExchangeEvaluator",
    "ExchangedBlock",
    "ExchangedBlocks",
    "OutsideEvents",
]
