"""Layouts: where named arrays stand in a flat vector."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.blocks.core import read_time
from loopwright.blocks.core.layout import Layout, elements, lay_out

SHAPES = st.dictionaries(
    st.sampled_from(["a", "b.c", "d", "e", "f.g.h"]), st.lists(st.integers(0, 3), max_size=2).map(tuple), max_size=5
)


@settings(deadline=None)  # a busy machine is no failure
@given(shapes=SHAPES, offset=st.integers(0, 4))
def test_what_is_laid_out_comes_one_after_the_other_as_numpy_ravels_it(shapes, offset):
    layout = Layout.of(shapes, offset)
    rng = np.random.default_rng(1)
    arrays = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    vector = np.concatenate([np.zeros(offset), *(np.ravel(v) for v in arrays.values())])
    assert layout.total == vector.size - offset
    for name, part in layout.split(vector).items():
        assert part.shape == shapes[name]
        assert np.array_equal(part, arrays[name])
        assert np.array_equal(vector[layout.index(name)], arrays[name])
    backwards = [*shapes][::-1]
    assert vector[layout.entries(backwards)].tolist() == [v for n in backwards for v in np.ravel(arrays[n])]
    assert layout.cuts == ([offset, *(offset + np.cumsum([v.size for v in arrays.values()]))] if shapes else [0])
    assert len(layout.labels) == layout.total


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((), ["q"]),
        ((2,), ["q[1]", "q[2]"]),
        ((2, 2), ["q[1,1]", "q[1,2]", "q[2,1]", "q[2,2]"]),
        ((0,), []),
    ],
)
def test_elements_have_names_that_count_from_1(shape, expected):
    assert elements("q", shape) == expected


def test_slices_of_pieces_and_exact_times():
    assert lay_out([2, 0, 1], offset=3) == [slice(3, 5), slice(5, 5), slice(5, 6)]
    assert [*map(read_time, (0.0007, 1 / 44100, 0.1 + 0.2))] == [Fraction(7, 10000), Fraction(1, 44100), None]
