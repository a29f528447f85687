"""A drive and its run, for tests of how results show themselves."""

import pytest

from support.shown_drive import drive


@pytest.fixture(scope="session")
def diagram():
    return drive()


@pytest.fixture(scope="session")
def run(diagram):
    return diagram.simulate(2.0, progress=False)
