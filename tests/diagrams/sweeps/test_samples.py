"""Samples of parameters: grids, Latin hypercubes, tables, their seeds and the names of their parameters."""

import itertools

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, OptionError, StateSpace, UnknownNameError
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.sweeps import Box, grid, latin, read_samples, table


@subsystem(sample_time=0.1)
def controller(y):
    return Gain(gain=2.0, name="proportional")(y)


def loop():
    plant = Integrator(name="plant", initial_value=1.0)
    return Diagram("loop", plant(Gain(gain=-1.0, name="sign")(controller(plant.y))))


def test_a_grid_is_every_combination_with_the_last_parameter_running_fastest():
    axes = {"a": (1.0, 2.0), "b": np.linspace(0.0, 1.0, 3), "c": ("x", "y")}
    found = grid(axes)
    assert [tuple(s.parameters.values()) for s in found] == list(itertools.product(*axes.values()))
    assert found.shape == (2, 3, 2)
    assert [s.index for s in found] == list(range(12))
    assert found[-1] == found[11]
    assert all(type(s.parameters["b"]) is float for s in found)


@pytest.mark.parametrize("count", [1, 7, 40])
def test_a_latin_hypercube_has_one_sample_in_each_part_of_each_range(count):
    found = latin({"a": (-2.0, 6.0), "b": Box(1e-3, 1e3, "log"), "c": Box((0.0, 10.0), (1.0, 30.0))}, count, seed=3)
    a = np.array([s.parameters["a"] for s in found])
    b = np.log10([s.parameters["b"] for s in found])
    c = np.array([s.parameters["c"] for s in found])
    for values, low, high in [(a, -2.0, 6.0), (b, -3.0, 3.0), (c[:, 0], 0.0, 1.0), (c[:, 1], 10.0, 30.0)]:
        parts = np.floor((values - low) / (high - low) * count)
        assert sorted(parts) == list(range(count))
    again, other = latin({"a": (0.0, 1.0)}, count, seed=3), latin({"a": (0.0, 1.0)}, count, seed=4)
    assert again.rows == latin({"a": (0.0, 1.0)}, count, seed=3).rows != other.rows


def test_a_box_gives_its_ends_exactly_and_the_middle_of_its_scale():
    box = Box(0.1, 0.7)
    assert (box.at(0.0), box.at(1.0)) == (0.1, 0.7)
    assert box.at(0.5) == pytest.approx(0.4, rel=1e-15)
    assert Box(2.0, 8.0, "log").at(0.5) == pytest.approx(4.0, rel=1e-15)  # √(2·8)
    np.testing.assert_array_equal(Box((1.0, 2.0), (3.0, 2.0)).at(0.5), [2.0, 2.0])
    np.testing.assert_array_equal(Box((1.0, 2.0), (3.0, 4.0)).at((0.0, 1.0)), [1.0, 4.0])


def test_a_table_is_taken_by_rows_by_columns_and_from_pandas():
    pandas = pytest.importorskip("pandas")
    rows = [{"a": 1.0, "b": 3.0}, {"b": 4.0, "a": 2.0}]
    by_columns = table({"a": [1.0, 2.0], "b": [3.0, 4.0]})
    assert table(rows).rows == by_columns.rows == ((1.0, 3.0), (2.0, 4.0))
    assert table(pandas.DataFrame(rows)).rows == by_columns.rows
    assert by_columns.axes is None
    assert by_columns.shape == (2,)


def test_a_seed_belongs_to_its_sample_whatever_comes_after_it():
    few, many = grid({"a": range(3)}, seed=5), grid({"a": range(1000)}, seed=5)
    assert [s.seed for s in few] == [s.seed for s in many[:3]]
    assert len({s.seed for s in many}) == 1000
    assert few[0].seed != grid({"a": range(3)}, seed=6)[0].seed
    assert all(0 <= s.seed < 2**63 for s in many)
    words = np.random.SeedSequence(entropy=5, spawn_key=(2,)).generate_state(1, np.uint64)  # as NumPy spawns the third
    assert few[2].seed == int(words[0]) // 2
    assert np.random.SeedSequence(5).spawn(3)[2].generate_state(1, np.uint64)[0] == words[0]


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("sign.gain", "sign.gain"),
        ("proportional.gain", "controller.proportional.gain"),
        ("controller.sample_time", "controller.sample_time"),
        ("initial_value", "plant.initial_value"),
        ("plant", "plant"),
    ],
)
def test_a_name_is_the_path_that_replace_takes(name, full):
    diagram = loop()
    assert diagram.wired.find_parameter(name) == full
    value = {"plant": Integrator(initial_value=2.0), "controller.sample_time": 0.2}.get(name, 2.0)
    assert diagram.replace({full: value}).structure == diagram.replace({name: value}).structure


def test_a_start_value_of_an_fmu_is_found_without_the_word_start():
    diagram = experiments.path_following().diagram
    assert diagram.wired.find_parameter("plant.coulomb_scale") == "plant.start.coulomb_scale"
    assert diagram.wired.find_parameter("plant.start.coulomb_scale") == "plant.start.coulomb_scale"
    assert diagram.wired.find_parameter("pid_par.a0") == "controller.pid_par.a0"
    variant = diagram.replace({"plant.coulomb_scale": 2.0})
    assert variant["plant"].start == diagram.replace({"plant.start.coulomb_scale": 2.0})["plant"].start
    for wrong in ("plant.coulomb_scal", "plant.start.viscous"):
        with pytest.raises(UnknownNameError, match="_scale") as said:
            diagram.replace({wrong: 2.0})
        with pytest.raises(UnknownNameError) as found:
            diagram.wired.find_parameter(wrong)
        assert str(said.value) == str(found.value)
    with pytest.raises(UnknownNameError, match=r"plant: it has no parameter 'coulomb_scal'. .*coulomb_scale"):
        diagram.wired.find_parameter("plant.coulomb_scal")
    with pytest.raises(UnknownNameError, match=r"no entry 'viscous' in 'start'.*viscous_scale"):
        diagram.wired.find_parameter("plant.start.viscous")


@pytest.mark.parametrize(
    ("parameters", "options", "message"),
    [
        ({"sign.gian": (1.0, 2.0)}, {}, r"sign: it has no parameter 'gian'. .*'gain'"),
        ({"sine.gain": (1.0, 2.0)}, {}, r"nothing is called 'sine.gain' in diagram 'loop'. .*sign.gain"),
        ({"gain": (1.0, 2.0)}, {}, r"parameter of controller.proportional, sign; write the path"),
        ({"proportional.gain": (1.0,), "controller.proportional.gain": (2.0,)}, {}, "found two names of one parameter"),
        ({"sign.gain.real": (1.0,)}, {}, r"sign: it has no parameter 'gain.real': 'gain' is -1, without parts"),
        ({}, {}, r"loop: found {}; expected parameters by name"),
        ({"sign.gain": ()}, {}, r"sign.gain: found no value; expected one at least"),
        ({"sign.gain": 2.0}, {}, r"sign.gain: found 2.0; expected a list of its values"),
        ({"sign.gain": (1.0, float("nan"))}, {}, r"sign.gain: found the value nan; expected finite"),
        ({"sign.gain": (1.0, 2.0)}, {"samples": "lattin"}, r"loop.samples: found samples='lattin'. .*'latin'"),
        ({"sign.gain": (1.0, 2.0)}, {"samples": "latin"}, r"needs count="),
        ({"sign.gain": (1.0, 2.0)}, {"samples": "latin", "count": 0}, r"found count=0; expected a positive integer"),
        ({"sign.gain": (2.0, 1.0)}, {"samples": "latin", "count": 3}, r"sign.gain: found a range from 2.0 to 1.0"),
        ({"sign.gain": Box(1.0, 2.0)}, {}, r"sign.gain: found Box\(.*expected a list of its values"),
        ({"sign.gain": (1.0, 2.0)}, {"count": 3}, r"found count=3 together with samples that have their number"),
        (
            {"sign.gain": (1.0, 2.0)},
            {"samples": [{"sign.gain": 1.0}]},
            r"together with a table of samples; give one of them",
        ),
        (None, {"samples": [{"sign.gain": 1.0}, {"sign": 2.0}]}, r"sample 1 gives sign, and sample 0 sign.gain"),
        (None, {"samples": {"sign.gain": (1.0,), "plant": (1.0, 2.0)}}, r"unequal length \(sign.gain: 1, plant: 2\)"),
        (None, {"samples": []}, r"found no sample"),
        ({"sign.gain": (1.0, 2.0)}, {"seed": -1}, r"found seed=-1; expected an integer from 0 on"),
    ],
)
def test_what_does_not_fit_is_refused_with_name_and_next_step(parameters, options, message):
    with pytest.raises((OptionError, UnknownNameError), match=message):
        read_samples(loop().wired, parameters, **options)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ((0.0, 1.0, "log"), "expected positive ends"),
        ((0.0, 1.0, "cubic"), "found scale='cubic'"),
        ((0.0, float("inf")), "expected finite ends"),
        (((1.0, 2.0), 3.0), r"shapes \(2,\) and \(\)"),
        (("low", "high"), "expected two numbers"),
    ],
)
def test_a_box_that_is_none_is_refused(ends, message):
    with pytest.raises(OptionError, match=message):
        Box(*ends)


def test_parameters_of_vectors_and_matrices_can_be_swept():
    diagram = Diagram("two", StateSpace(A=[[-1.0]], B=[1.0], C=[1.0], name="lag")(Constant(value=1.0)))
    found = read_samples(diagram.wired, {"lag.A": [[[-1.0]], [[-2.0]]]})
    assert [s.parameters["lag.A"] for s in found] == [[[-1.0]], [[-2.0]]]
