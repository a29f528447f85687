"""Quick part of a test that is a full product of cases: the diagonal, which has each value of each parameter once."""

import inspect

import pytest


def identify(node, params):
    """Give what tells the values of each parametrization apart; they are the same objects in all cases."""
    named = [mark.args[0] for mark in node.iter_markers("parametrize")]
    groups = [name.replace(" ", "").split(",") if isinstance(name, str) else list(name) for name in named]
    groups += [[name] for name in params if not any(name in group for group in groups)]
    return tuple(tuple(id(params[name]) for name in group) for group in groups)


def find_quick(node, cases, *, chosen):
    """Give the places of the quick ones of a function's cases: those that its mark draws, or of a product the diagonal.

    A case is its values by the names of parameters; ``chosen`` says that some are marked slow already.
    """
    mark, factors = node.get_closest_marker("drawn"), [*node.iter_markers("parametrize")]
    if len(cases) < 2 or (mark is None and (len(factors) < 2 or chosen)):
        return [*range(len(cases))]
    return draw([identify(node, params) for params in cases], *(mark.args if mark is not None else ()))


class QuickAlone:
    """Plugin that makes no items of slow cases, which would be deselected: they are half of all, and of the collection."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_pycollect_makeitem(self, collector, name, obj):
        if not collector.funcnamefilter(name) or not inspect.isfunction(obj):
            return None
        marks = *getattr(obj, "pytestmark", []), *collector.iter_markers()
        return [] if any(mark.name == "slow" for mark in marks) else None

    @pytest.hookimpl(wrapper=True)
    def pytest_generate_tests(self, metafunc):
        yield
        calls = metafunc._calls
        slow = ["slow" in {mark.name for mark in call.marks} for call in calls]
        places = find_quick(metafunc.definition, [call.params for call in calls], chosen=any(slow))
        metafunc._calls = [calls[i] for i in places if not slow[i]] or calls[:1]


def draw(cases, count=None):
    """Give the places of the quick cases, or of ``count`` of them, evenly spread; a case is a tuple of its values.

    Case i of the diagonal has value i of every parameter; a parameter with fewer values begins anew.
    """
    values = [list(dict.fromkeys(column)) for column in zip(*cases, strict=True)]
    diagonal = {tuple(column[i % len(column)] for column in values) for i in range(max(map(len, values)))}
    places = [i for i, case in enumerate(cases) if case in diagonal]
    if count is None or count >= len(places):
        return places
    return [places[round(k * (len(places) - 1) / max(count - 1, 1))] for k in range(count)]
