"""Runs of one diagram side by side in the lanes of vectors: code of its ticks and of its FMUs' equations."""

from .lane_code import LaneCode, compile_lanes
from .lane_runs import LaneEnd, LaneRuns, LaneStart, LaneVectors, make_room
from .start_code import StartSource
from .vector_code import NoLanesError

__all__ = [
    "LaneCode",
    "LaneEnd",
    "LaneRuns",
    "LaneStart",
    "LaneVectors",
    "NoLanesError",
    "StartSource",
    "compile_lanes",
    "make_room",
]
