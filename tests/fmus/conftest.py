"""A cache of its own for all tests of FMUs, and exported FMUs."""

import pytest

from loopwright.fmus.export.package import build_fmu
from support.exported import Instance, mass_spring_damper, pendulums
from support.exported2 import Instance2


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOOPWRIGHT_CACHE", str(folder))
        patch.delenv("LOOPWRIGHT_CC", raising=False)
        yield folder


@pytest.fixture(scope="module")
def msd(cache):
    return build_fmu(mass_spring_damper())


@pytest.fixture
def instance(tmp_path):
    made = []

    def make(path, **options):
        made.append(Instance(path, tmp_path / str(len(made)), **options))
        return made[-1]

    yield make
    for item in made:
        item.fmu.freeInstance()


@pytest.fixture(scope="module")
def msd2(cache):
    return build_fmu(mass_spring_damper(), fmi=2)


@pytest.fixture(scope="module")
def pendulums2(cache):
    return build_fmu(pendulums(), fmi=2)


@pytest.fixture
def instance2(tmp_path):
    made = []

    def make(path, **options):
        made.append(Instance2(path, tmp_path / f"v2-{len(made)}", **options))
        return made[-1]

    yield make
    for item in made:
        item.fmu.freeInstance()
