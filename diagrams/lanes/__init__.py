"""Runs of one diagram side by side in the lanes of vectors: code of its ticks and of its FMUs' equations."""

from .lane_code import LaneCode, compile_lanes
from .lane_runs import LaneEnd, LaneRuns, LaneStart, make_room
from .no_lanes import NoLanesError

__all__ = ["LaneCode", "LaneEnd", "LaneRuns", "LaneStart", "NoLanesError", "compile_lanes", "make_room"]
