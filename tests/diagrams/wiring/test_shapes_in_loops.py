"""A loop of vectors gets its shape from the delay's initial value; one that disagrees is a ShapeError."""

import itertools

import numpy as np
import pytest

from loopwright.blocks import Gain, ShapeError, UnitDelay
from loopwright.diagrams import Diagram, subsystem


def test_the_initial_value_gives_the_shape():
    @subsystem(sample_time=0.1)
    def box():
        delay = UnitDelay(initial_value=(1.0, 2.0), name="delay")
        delay(Gain(gain=0.5)(delay.y))
        return delay.y

    run = Diagram("d", box().named("w")).simulate(0.2, progress=False)
    assert run["w"].tolist() == [[1.0, 2.0], [0.5, 1.0], [0.25, 0.5]]


@pytest.mark.parametrize("names", list(itertools.permutations("abz")), ids="".join)
def test_a_loop_whose_shapes_disagree_is_refused_whatever_its_blocks_are_called(names):
    widening, scaling, delayed = names

    @subsystem(sample_time=0.1)
    def box():
        delay = UnitDelay(initial_value=(1.0, 2.0), name=delayed)
        wide = Gain(gain=np.ones((3, 2)), name=widening)(
            delay.y
        )  # three numbers, which are to be the pair's next value
        delay(Gain(gain=0.5, name=scaling)(wide))
        return wide

    with pytest.raises(
        ShapeError, match=rf"^box\.{delayed}\.u: box\.{scaling}\.y has shape \(3,\), where the loop .* \(2,\)"
    ):
        Diagram("d", box())
