"""An interrupt of a run, with what the run recorded."""

from __future__ import annotations

from ..results import Run


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in a run: a `KeyboardInterrupt` that keeps what was recorded until then.

    Attributes
    ----------
    run : Run
        The run until the last sample before the interrupt.
    """

    def __init__(self, run: Run):
        where = f"at t = {run.t[-1]:.9g} s" if len(run.t) else "before the first sample"
        super().__init__(f"interrupted {where}")
        self.run = run

    def __reduce__(self) -> tuple[type[Interrupted], tuple[Run]]:
        return type(self), (self.run,)
