"""Flattening of many blocks: small matrices are computed without threads of BLAS."""

import numpy as np
from threadpoolctl import threadpool_info

from loopwright.blocks import Block, State, parameter
from loopwright.diagrams import Diagram, subsystem

SEEN = []


class Looks(Block):
    """Notes how many threads BLAS has while its numbers are computed."""

    pole: float = parameter(default=0.5)
    y = State(start=1.0, output=True)

    def constants(self, T, method):
        if self.pole > 290.0:  # asking takes its time
            SEEN.append(max((p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"), default=1))
        return {"factor": np.exp(-self.pole * T)}

    def update(self, t, x, u):
        return self.factor * x.y


def test_many_small_matrices_are_computed_on_one_thread():
    @subsystem(sample_time=0.1, name="box")
    def box():
        return tuple(Looks(name=f"b{k}", pole=0.1 + k).y for k in range(301))

    made = Diagram("many", *(one.named(f"y{k}") for k, one in enumerate(box())))
    SEEN.clear()
    flat = made.flatten()
    assert len(SEEN) == 11
    assert set(SEEN) == {1}
    run = made.simulate(1.0, progress=False, compile=False)
    assert np.max(np.abs(run["y7"] - np.exp(-7.1 * run.t))) < 1e-12
    assert flat.width == 301
