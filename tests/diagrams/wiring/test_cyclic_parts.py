"""Cyclic parts of graphs, beside the reachability of their nodes."""

import numpy as np
import pytest

from loopwright.diagrams.wiring import find_cyclic_parts


def mutually_reachable(count, pairs):
    """Return the sets of nodes that reach one another, by Warshall's closure; those of one node only with a pair."""
    reach = np.zeros((count, count), dtype=bool)
    reach[tuple(np.array(pairs, dtype=int).reshape(-1, 2).T)] = True
    for k in range(count):
        reach |= np.outer(reach[:, k], reach[k])
    both = reach & reach.T
    return {frozenset(np.flatnonzero(both[i]).tolist()) for i in range(count) if both[i, i]}


@pytest.mark.parametrize("repeats", [1, 2, 3])
def test_cyclic_parts_are_the_nodes_that_reach_one_another(repeats):
    rng = np.random.default_rng(7)
    for _ in range(60):
        count = int(rng.integers(1, 10))
        pairs = rng.integers(0, count, (int(rng.integers(0, 16)), 2)).tolist() * repeats
        keys = [f"n{i}" for i in range(count)]
        found = find_cyclic_parts(keys, [(keys[a], keys[b]) for a, b in rng.permutation(pairs).tolist()])
        assert {frozenset(int(key[1:]) for key in part) for part in found} == mutually_reachable(count, pairs)
        assert len(found) == len(mutually_reachable(count, pairs))
