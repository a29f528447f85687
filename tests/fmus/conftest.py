"""Exported FMUs, and instances of them that are freed at the end."""

import pytest

from loopwright.fmus import build_fmu
from support.exported import mass_spring_damper
from support.instances import Exchange, open_instance


@pytest.fixture(scope="module")
def msd(cache):
    return build_fmu(mass_spring_damper())


@pytest.fixture
def instance(tmp_path):
    """instance(path, **options) -> the FMU, of either version, instantiated."""
    made = []

    def make(path, **options):
        made.append(open_instance(path, tmp_path / str(len(made)), **options))
        return made[-1]

    yield make
    for item in made:
        item.fmu.freeInstance()


@pytest.fixture
def exchange(instance):
    """exchange(path, **options) -> the FMU, of either version, instantiated for Model Exchange."""
    return lambda path, **options: Exchange(instance(path, model_exchange=True, **options))
