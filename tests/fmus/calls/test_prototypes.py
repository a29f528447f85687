"""Types of the standard's functions, read once for each class of FMPy's, against those that FMPy itself sets."""

from types import SimpleNamespace

import pytest
from fmpy import fmi1, fmi2, fmi3

from loopwright.fmus.calls import bind_functions

KINDS = [
    getattr(module, f"FMU{i}{kind}") for i, module in ((1, fmi1), (2, fmi2), (3, fmi3)) for kind in ("Model", "Slave")
]


class Library:
    """A library that has every function."""

    def __getattr__(self, name):
        self.__dict__[name] = SimpleNamespace()
        return self.__dict__[name]


@pytest.mark.parametrize("kind", KINDS)
def test_functions_get_the_types_that_fmpy_gives_them(kind):
    ours, theirs = (kind.__new__(kind) for _ in range(2))
    for fmu in (ours, theirs):
        fmu.dll, fmu._functions, fmu.modelIdentifier = Library(), {}, "ball"
    prefix = f"fmi{kind.__name__[3]}"
    bind_functions(ours, kind, prefix)
    theirs._loadFunctions()
    assert list(ours._functions) == list(theirs._functions)
    assert ours.dll.__dict__ == theirs.dll.__dict__
    assert len(ours._functions) > 20
