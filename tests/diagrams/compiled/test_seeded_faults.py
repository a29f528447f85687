"""Faults seeded in the loop in C: random diagrams against the reference loop find each of them."""

import pickle
import subprocess
import sys

import pytest

from loopwright.fmus.runtime import runtime_source
from support import TESTS
from support.random_hybrid import FAMILIES, make_if_possible, reference
from support.seeded_faults import FAULTS, seed_fault

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_can_be_seeded(name):
    assert seed_fault(runtime_source(), name) != runtime_source()


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """A file with what the reference loop says of random diagrams."""
    found = {}
    for family in FAMILIES:
        for seed in range(10 if family in ("sampled", "plants", "slower") else 25):
            case = make_if_possible(family, seed)
            expected = None if case is None else reference(case)
            if expected is not None:
                found[family, seed] = expected
    file = tmp_path_factory.mktemp("records") / "records.pickle"
    file.write_bytes(pickle.dumps(found))
    return file


def count(name, records):
    """Return in how many of the diagrams a fault shows, in a process of its own: what a fault does is not foreseen."""
    command = [sys.executable, "-m", "support.seeded_faults", name, str(records)]
    try:
        done = subprocess.run(command, check=False, cwd=TESTS, capture_output=True, text=True, timeout=600)
    except subprocess.TimeoutExpired:
        return 1
    if done.returncode < 0:  # ended by a signal
        return 1
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-2])


def test_without_a_fault_none_is_found(records):
    assert count("", records) == 0


@pytest.mark.parametrize("name", FAULTS)
def test_random_diagrams_find_a_seeded_fault(records, name):
    assert count(name, records) >= 1
