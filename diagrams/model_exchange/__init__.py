"""Blocks in model exchange, whose equations a run evaluates, such as FMUs: their evaluators and their events."""

from .blocks_in_a_run import BlocksInModelExchange
from .evaluator import OWN_EVENTS, ModelExchangeBlock, ModelExchangeEvaluator
from .events import OwnEvents

__all__ = [
    "OWN_EVENTS",
    "BlocksInModelExchange",
    "ModelExchangeBlock",
    "ModelExchangeEvaluator",
    "OwnEvents",
]
