"""Garbage collection waits in a function, and goes on after it."""

import gc

import pytest

from loopwright.blocks.core import without_collection


@without_collection
def is_collecting():
    return gc.isenabled()


@without_collection
def fail():
    raise ValueError("failed")


def test_collection_waits_in_the_function_and_goes_on_after_it():
    assert gc.isenabled()
    assert not is_collecting()
    assert gc.isenabled()
    with pytest.raises(ValueError, match="failed"):
        fail()
    assert gc.isenabled()


def test_collection_that_was_off_stays_off():
    gc.disable()
    try:
        assert not is_collecting()
        assert not gc.isenabled()
    finally:
        gc.enable()
