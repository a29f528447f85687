"""Worker process of a sweep: it is sent a plan and samples, and answers with outcomes."""

from __future__ import annotations

import pickle
from contextlib import suppress

from ...fmus.child_processes import Host


def main() -> None:
    """Answer samples until the sweep ends."""
    with suppress(EOFError):
        _answer(Host())


def _answer(host: Host) -> None:
    data = host.receive()
    try:
        plan = pickle.loads(data)
    except Exception as error:
        host.send(f"{type(error).__name__}: {error}")
        return
    from ...blocks.core import one_thread
    from ...fmus.child_processes import end_all
    from .workers import make_worker

    try:
        with one_thread(), make_worker(plan) as worker:
            host.send("")
            while True:
                for outcome in worker.run_all([host.receive()]):
                    host.send(outcome)
    finally:
        end_all()
