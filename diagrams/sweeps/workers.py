"""The worker that a sweep asks for."""

from __future__ import annotations

from .plan import Plan
from .worker import Worker


def make_worker(plan: Plan) -> Worker:
    """Return a worker that runs samples of a sweep in this thread."""
    if plan.lanes == 1:
        return Worker(plan)
    from .lane_worker import LaneWorker

    return LaneWorker(plan)
