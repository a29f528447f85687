"""Ticks of clocks as arrays, beside clocks that are asked one tick after the other."""

import numpy as np

from loopwright.diagrams.flat import EVERY, TickPattern, ticks_after


def one_by_one(patterns, k, last):
    found = []
    while k < last:
        k = min([*(pattern.after(k) for pattern in patterns), last])
        found.append(k)
    return found


def draw(rng):
    patterns = [TickPattern(int(rng.integers(1, 9)), int(rng.integers(0, 30))) for _ in range(rng.integers(1, 4))]
    k = int(rng.integers(0, 20))
    return patterns, k, k + int(rng.integers(0, 120)), int(rng.integers(1, 40))


def test_chunks_of_ticks_are_those_of_the_clocks_one_by_one():
    for seed in range(200):
        patterns, k, last, count = draw(np.random.default_rng(seed))
        found = []
        while (ticks := ticks_after(patterns, found[-1] if found else k, last, count)).size:
            assert len(ticks) <= count, seed
            found += ticks.tolist()
        assert found == one_by_one(patterns, k, last), seed


def test_large_ticks_are_exact():
    assert ticks_after([EVERY], 2**52, 2**52 + 3, 9).tolist() == [2**52 + 1, 2**52 + 2, 2**52 + 3]
