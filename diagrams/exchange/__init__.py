"""Blocks that a run evaluates from outside, such as FMUs in model exchange: their evaluators and their events."""

from .evaluator import INPUT_EVENT, ExchangedBlock, ExchangeEvaluator
from .events import OutsideEvents
from .exchanged_blocks import ExchangedBlocks

__all__ = [
    "INPUT_EVENT",
    "ExchangeEvaluator",
    "ExchangedBlock",
    "ExchangedBlocks",
    "OutsideEvents",
]
