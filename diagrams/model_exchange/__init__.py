"""Blocks that a run evaluates from outside, such as FMUs in model exchange: their evaluators and their events."""

from .blocks_in_a_run import BlocksInModelExchange
from .evaluator import OWN_EVENTS, ModelExchangeBlock, ModelExchangeEvaluator
from .events import OutsideEvents

__all__ = [
    "OWN_EVENTS",
    "BlocksInModelExchange",
    "ModelExchangeBlock",
    "ModelExchangeEvaluator",
    "OutsideEvents",
]
