"""Functions that are evaluated: each operation is done once, and no bit changes."""

import casadi as ca
import numpy as np

from loopwright.diagrams import experiments
from loopwright.diagrams.flat import bind_function, share_terms


def test_an_interpreted_tick_does_no_operation_twice():
    flat = experiments.hand_guiding().diagram.flatten()
    stage = flat.at_tick(flat.acting(0)).last
    assert stage.evaluated.n_instructions() < stage.fast.n_instructions()
    assert share_terms(stage.evaluated).n_instructions() == stage.evaluated.n_instructions()
    random = np.random.default_rng(1)
    given = [random.normal(size=stage.fast.numel_in(i)) for i in range(stage.fast.n_in())]
    bound = [bind_function(function, given) for function in (stage.fast, stage.evaluated)]
    for one in bound:
        one.call()
    for first, second in zip(bound[0].outputs, bound[1].outputs, strict=True):
        assert first.tobytes() == second.tobytes()


def test_equal_terms_are_shared():
    x = ca.SX.sym("x")
    twice = ca.Function("twice", [x], [ca.sin(x) * 2.0, ca.sin(x) + 1.0])
    once = share_terms(twice, "once")
    assert once.name() == "once"
    assert sum(once.instruction_id(i) == ca.OP_SIN for i in range(once.n_instructions())) == 1
