"""Structure of a block: a trace holds for another block of the kind, unless a zero becomes a number."""

import numpy as np
import pytest

from loopwright.blocks import BandLimitedNoise, Block, Compare, Constant, Gain, Input, Output, StateSpace, parameter
from loopwright.blocks.tracing import trace
from loopwright.blocks.tracing.structure import has_structure, is_traced_by, structure, traced_parameters

PLANT = StateSpace(A=[[0.0, 1.0], [-2.0, -3.0]], B=[0.0, 1.0], C=[1.0, 0.0], D=0.0)


@pytest.mark.parametrize(
    ("block", "other", "holds"),
    [
        (Gain(gain=2.0), Gain(gain=3.0), True),
        (Gain(gain=0.0), Gain(gain=3.0), True),
        (Gain(gain=3.0), Gain(gain=0.0), False),
        (Gain(gain=np.ones(2)), Gain(gain=3.0), False),
        (Gain(gain=3.0), Constant(value=3.0), False),
        (Compare(">"), Compare("<"), False),
        (PLANT.replace(A=[[0.0, 1.0], [0.0, -9.0]]), PLANT, True),
        (PLANT.replace(A=[[0.1, 1.0], [-2.0, -3.0]]), PLANT, False),
    ],
)
def test_a_trace_holds_for_other_numbers_but_not_in_the_place_of_a_zero(block, other, holds):
    assert is_traced_by(block, other) is holds
    if structure(block) == structure(other):
        assert is_traced_by(block, other)
        assert is_traced_by(other, block)


def test_traced_parameters_are_the_numbers():
    names = [name for name, _ in traced_parameters(PLANT)]
    assert names[:4] == ["A", "B", "C", "D"]
    assert dict(traced_parameters(Gain(gain=2.0))) == {"gain": 2.0}


class Shaken(Block):
    """The input and a noise."""

    noise: BandLimitedNoise = parameter(default=BandLimitedNoise(sample_time=0.1))
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return u.u + self.noise.output(t, None, None)


def test_a_seed_is_a_number_of_a_noise_and_fixed_in_a_block_around_it():
    noise = BandLimitedNoise(sample_time=0.1, seed=3)
    assert structure(noise) == structure(noise.replace(seed=4))
    assert is_traced_by(noise, noise.replace(seed=4))
    one, two = (Shaken(noise=noise.replace(seed=seed)) for seed in (3, 4))
    assert structure(one) != structure(two)
    assert not is_traced_by(one, two)
    assert not has_structure(one, two)
    values = []
    for block in (one, two):
        found = trace(block, {"u": ()}, sampled=True)
        values.append(float(found.function(0.25, [], 0.0, found.pack(block, 0.1))[0]))
        assert values[-1] == float(block.noise.output(np.float64(0.25), None, None))
    assert values[0] != values[1]
