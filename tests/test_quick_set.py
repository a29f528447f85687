"""The part of a product of cases that the quick set takes."""

from itertools import product

import pytest

from support.drawn import draw


@pytest.mark.parametrize("sizes", [(7,), (3, 3), (2, 5), (4, 3, 2), (1, 6)])
def test_every_value_of_every_parameter_is_drawn(sizes):
    cases = list(product(*map(range, sizes)))
    drawn = [cases[place] for place in draw(cases)]
    assert [len(set(column)) for column in zip(*drawn, strict=True)] == list(sizes)
    assert len(drawn) == max(sizes)


@pytest.mark.parametrize(("count", "expected"), [(1, [0]), (2, [0, 9]), (4, [0, 3, 6, 9]), (50, list(range(10)))])
def test_so_many_as_asked_for_are_drawn_evenly(count, expected):
    assert draw([(i,) for i in range(10)], count) == expected


@pytest.mark.drawn(1)
@pytest.mark.parametrize("second", "xy")
@pytest.mark.parametrize("first", "ab")
def test_what_is_not_drawn_is_slow(first, second, request):
    assert (request.node.get_closest_marker("slow") is None) == (first + second == "ax")
