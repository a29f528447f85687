"""Types of the standard's functions, read once for each class of FMPy's, against those that FMPy itself sets."""

from types import SimpleNamespace

import pytest
from fmpy import fmi1, fmi2, fmi3

from loopwright.fmus.calls import LibraryFunctions, list_prototypes

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
    ours._functions = LibraryFunctions(ours.dll, kind, prefix, "ball", ())
    for prototype in list_prototypes(kind, prefix):
        assert ours._functions[prototype.name] is ours._functions[prototype.name]
    theirs._loadFunctions()
    assert list(ours._functions) == list(theirs._functions)
    assert ours.dll.__dict__ == theirs.dll.__dict__
    assert len(ours._functions) > 20


class Part:
    """A library that has two functions."""

    def __init__(self):
        self.fmi3DoStep, self.fmi3SetTime = SimpleNamespace(), SimpleNamespace()


def test_a_function_that_is_missing_returns_an_error_and_one_that_is_needed_is_refused():
    functions = LibraryFunctions(Part(), fmi3.FMU3Slave, "fmi3", "ball", ("DoStep",))
    assert list(functions) == ["fmi3DoStep"]
    assert functions.lack("fmi3GetFMUState")
    assert not functions.lack("fmi3DoStep")
    assert functions["fmi3GetFMUState"](None, None) == 3  # fmi3Error
    with pytest.raises(AttributeError, match="fmi3Terminate"):
        LibraryFunctions(Part(), fmi3.FMU3Slave, "fmi3", "ball", ("Terminate", "DoStep"))


def test_a_change_of_each_function_reaches_those_that_are_bound_later():
    functions, changed = LibraryFunctions(Library(), fmi3.FMU3Slave, "fmi3", "ball", ("DoStep",)), []
    functions.change_each(lambda name, function: changed.append(name))
    functions["fmi3Terminate"], functions["fmi3Terminate"]
    assert changed == ["fmi3DoStep", "fmi3Terminate"]
