"""The part of a product of cases that the quick set takes, and what it keeps for later sessions."""

from itertools import product
from types import SimpleNamespace

import pytest

from support.cpu_budget import Budget
from support.drawn import QuickAlone, draw
from support.kept import kept_folder, kept_tree


@pytest.mark.parametrize("sizes", [(7,), (3, 3), (2, 5), (4, 3, 2), (1, 6)])
def test_every_value_of_every_parameter_is_drawn(sizes):
    cases = list(product(*map(range, sizes)))
    drawn = [cases[place] for place in draw(cases)]
    assert [len(set(column)) for column in zip(*drawn, strict=True)] == list(sizes)
    assert len(drawn) == max(sizes)


@pytest.mark.parametrize(("count", "expected"), [(1, [0]), (2, [0, 9]), (4, [0, 3, 6, 9]), (50, list(range(10)))])
def test_so_many_as_asked_for_are_drawn_evenly(count, expected):
    assert draw([(i,) for i in range(10)], count) == expected


@pytest.mark.drawn(1)
@pytest.mark.parametrize("second", "xy")
@pytest.mark.parametrize("first", "ab")
def test_what_is_not_drawn_is_slow(first, second, request):
    assert (request.node.get_closest_marker("slow") is None) == (first + second == "ax")


@pytest.mark.parametrize("second", "xyz")
@pytest.mark.parametrize("first", "ab")
def test_of_a_product_of_cases_the_diagonal_is_quick(first, second, request):
    assert (request.node.get_closest_marker("slow") is None) == (first + second in ("ax", "by", "az"))


@pytest.mark.parametrize("second", ["x", pytest.param("y", marks=pytest.mark.slow)])
@pytest.mark.parametrize("first", "ab")
def test_who_says_which_cases_are_slow_has_the_others_quick(first, second, request):
    assert (request.node.get_closest_marker("slow") is None) == (second == "x")


@pytest.mark.parametrize(
    ("drawn", "slow", "made"),
    [((), "", "ax az by"), ((2,), "", "ax by"), ((), "az bz", "ax ay bx by"), ((), "ax ay az bx by bz", "ax")],
)
def test_slow_cases_are_not_made_where_the_quick_ones_alone_are_asked_for(drawn, slow, made):
    """Where all are slow one is made, as pytest makes a case without parameters of none."""
    values = {name: name for name in "abxyz"}
    calls = [
        SimpleNamespace(
            params={"first": values[a], "second": values[b]}, marks=[pytest.mark.slow] * (a + b in slow.split())
        )
        for a, b in product("ab", "xyz")
    ]
    factors = [pytest.mark.parametrize("second", "xyz").mark, pytest.mark.parametrize("first", "ab").mark]
    mark = pytest.mark.drawn(*drawn).mark if drawn else None
    definition = SimpleNamespace(iter_markers=lambda name: factors, get_closest_marker=lambda name: mark)
    metafunc, hook = SimpleNamespace(definition=definition, _calls=calls), QuickAlone()
    for _ in hook.pytest_generate_tests(metafunc):
        pass
    assert " ".join("".join(call.params.values()) for call in metafunc._calls) == made


def test_the_cases_of_a_function_have_one_budget():
    lines, budget = [], Budget(0.5)
    for name, taken in (("a[1]", 0.3), ("a[2]", 0.3), ("b", 0.4)):
        report = SimpleNamespace(
            when="teardown", nodeid=f"tests/x/y/test_z.py::test_{name}", user_properties=[("cpu", taken)]
        )
        budget.pytest_runtest_logreport(report)
    budget.pytest_terminal_summary(SimpleNamespace(write_line=lines.append, section=lines.append))
    assert lines == [
        "processor time, 1 s",
        "     1.0 s  tests/x/y",
        "1 functions beyond 0.5 s",
        "    0.60 s  tests/x/y/test_z.py::test_a, 2 cases",
    ]


def test_a_folder_that_is_kept_is_the_same_for_all_and_none_where_nothing_can_be_written(tmp_path):
    (tmp_path / "a_file").write_text("")
    assert kept_folder("types", tmp_path) == kept_folder("types", tmp_path) == tmp_path / "types"
    assert kept_folder("types", tmp_path / "a_file") is None


def test_a_kept_tree_comes_back_with_what_the_last_session_has_added(tmp_path):
    archive = tmp_path / "kept.tar"
    for session in range(3):
        with kept_tree(archive, tmp_path / str(session)) as folder:
            assert sorted(file.name for file in folder.iterdir()) == [f"of_{i}" for i in range(session)]
            (folder / f"of_{session}").write_text("")
    with pytest.raises(ZeroDivisionError), kept_tree(archive, tmp_path / "failed") as folder:
        (folder / "half").write_text(str(1 / 0))
    with kept_tree(archive, tmp_path / "last") as folder:
        assert sorted(file.name for file in folder.iterdir()) == ["of_0", "of_1", "of_2"]
    with kept_tree(None, tmp_path / "nothing") as folder:
        assert list(folder.iterdir()) == []
    assert sorted(tmp_path.glob("*.tar")) == [archive]
