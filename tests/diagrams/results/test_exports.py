"""Runs for other tools: what goes out comes back through the other's reader, to the last bit."""

import csv
import re
import sys
from dataclasses import replace

import numpy as np
import pandas
import pyarrow.parquet
import pytest
import xarray
from scipy.io import loadmat

from loopwright.blocks import OptionError, Sine, UnknownNameError
from loopwright.diagrams import Diagram, Run
from loopwright.diagrams.results import RecordedSignals
from loopwright.diagrams.results import run_exports as _exports
from loopwright.types import Layout, Wire

SHAPES = {"plant.position": (2,), "plant.mass": (2, 3), "box.pid.v": (), "box.e": ()}
LAYOUT = Layout.of(SHAPES)
WIRES = {
    "v": Wire("box.pid", "v"),
    "x": Wire("plant", "position", 0),
    "both": Wire("plant", "position", slice(0, 2)),
    "η/ξ error": Wire("box", "e"),
}
UNITS = {"plant.position": ("m", "rad"), "box.pid.v": "m/s2", "plant.mass": "kg"}


def make(n=200, **changes):
    random = np.random.default_rng(3)
    t = np.cumsum(random.random(n))
    data = random.standard_normal((n, LAYOUT.total + 1)) * 10.0 ** random.integers(-300, 300, (n, 1))
    if n > 9:
        t[5] = t[4]  # before and after an event
        data[:5, 8] = [np.nan, np.inf, -np.inf, -0.0, 5e-324]
    signals = RecordedSignals(LAYOUT, WIRES, UNITS, LAYOUT.total + 1)
    fields = {"t": t, "data": data, "signals": signals, "diagram": None}
    return Run(**(fields | {"diagram_name": "crane"} | changes))


@pytest.fixture(scope="module")
def run():
    return make()


def same(a, b):
    """Whether two arrays agree in every bit; NaN is NaN."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return a.shape == b.shape and bool(np.all((a.view("u8") == b.view("u8")) | (np.isnan(a) & np.isnan(b))))


COLUMNS = ["both[1]", "both[2]", "v", "x", "η/ξ error", *(f"plant.mass[{k}]" for k in range(1, 7))]
"""All that was recorded: the named wires, and the port that no wire's name covers."""


def check_columns(run, table):
    """Compare columns by name with the run."""
    assert same(table["v"], run["v"])
    assert same(table["x"], run["plant.position"][:, 0])
    assert same(table["both[1]"], run["plant.position"][:, 0])
    assert same(table["both[2]"], run["plant.position"][:, 1])
    assert same(table["η/ξ error"], run["box.e"])
    assert same(table["plant.mass[4]"], run["plant.mass"][:, 1, 0])


@pytest.mark.parametrize("kind", ["csv", "parquet", "mat"])
def test_a_file_that_cannot_be_written_is_refused_by_the_path_that_was_given(kind, run, tmp_path):
    write = getattr(run, f"to_{kind}")
    with pytest.raises(OptionError, match=r"^path: there is no folder '.*nowhere'\. Make it, or name another one"):
        write(tmp_path / "nowhere" / f"run.{kind}")
    with pytest.raises(OptionError, match=rf"{tmp_path.name}' is a folder\. Name a file in it"):
        write(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_csv_is_read_by_the_standard_library(run, tmp_path):
    run.to_csv(tmp_path / "run.csv")
    with open(tmp_path / "run.csv", encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["t", *COLUMNS]
    table = dict(zip(header, np.array(rows, dtype=float).T, strict=True))
    assert same(table["t"], run.t)
    check_columns(run, table)


def test_pandas_has_the_times_as_index(run):
    frame = run.to_pandas()
    assert frame.index.name == "t"
    assert same(frame.index, run.t)
    assert list(frame) == COLUMNS
    check_columns(run, frame)
    assert frame.attrs["units"] == {
        "t": "s",
        "both[1]": "m",
        "both[2]": "rad",
        "v": "m/s2",
        "x": "m",
        "η/ξ error": "",
    } | {f"plant.mass[{k}]": "kg" for k in range(1, 7)}


def test_a_matrix_goes_out_row_by_row(run, tmp_path):
    frame = run.to_pandas("mass", "pid.v")
    assert list(frame) == [*(f"mass[{i}]" for i in range(1, 7)), "pid.v"]
    assert same(frame["mass[4]"], run["plant.mass"][:, 1, 0])
    run.to_mat(tmp_path / "run.mat", "mass")
    assert same(loadmat(tmp_path / "run.mat")["mass"][:, 3], run["plant.mass"][:, 1, 0])


@pytest.mark.slow
def test_a_frame_does_not_change_the_run():
    run = make()
    before = run.t.copy(), run.data.copy()
    frame = run.to_pandas("v", "x")
    frame.iloc[:, :] = 0.0
    run.to_xarray("mass")["mass"][:] = 0.0
    assert same(run.t, before[0])
    assert same(run.data, before[1])


def test_xarray_has_a_dimension_for_every_axis(run, tmp_path):
    data = run.to_xarray("v", "both", "mass", "e")
    assert data["v"].dims == ("t",)
    assert data["both"].dims == ("t", "both_dim")
    assert data["mass"].dims == ("t", "mass_dim1", "mass_dim2")
    assert same(data["t"], run.t)
    for name in ("v", "both", "mass", "e"):
        assert same(data[name], run[name])
    assert same(data["both"].sel(both_dim=2), run["both"][:, 1])  # counted as in the columns' names
    found = {name: data[name].attrs.get("units") for name in ("t", "v", "both", "mass", "e")}
    assert found == {"t": "s", "v": "m/s2", "both": "m, rad", "mass": "kg", "e": None}
    assert data.attrs["title"] == "crane"


@pytest.mark.slow
def test_xarray_writes_it_as_netcdf_and_reads_it_back(run, tmp_path):
    run.to_xarray("v", "both", "mass").to_netcdf(tmp_path / "run.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "run.nc", engine="scipy") as data:
        assert same(data["t"], run.t)
        assert same(data["mass"], run["mass"])
        assert (data["both"].attrs["units"], data.attrs["title"]) == ("m, rad", "crane")


def test_parquet_is_read_by_pandas_and_says_the_units(run, tmp_path):
    run.to_parquet(tmp_path / "run.parquet")
    table = pandas.read_parquet(tmp_path / "run.parquet")
    assert list(table) == ["t", *COLUMNS]
    assert same(table["t"], run.t)
    check_columns(run, table)
    schema = pyarrow.parquet.read_schema(tmp_path / "run.parquet")
    units = {f.name: (f.metadata or {}).get(b"unit") for f in schema}
    assert units == {"t": b"s", "both[1]": b"m", "both[2]": b"rad", "v": b"m/s2", "x": b"m", "η/ξ error": None} | {
        f"plant.mass[{k}]": b"kg" for k in range(1, 7)
    }
    assert schema.metadata[b"diagram"] == b"crane"


def test_parquet_is_written_in_groups_of_rows(run, tmp_path, monkeypatch):
    monkeypatch.setattr(_exports, "_GROUP", 8 * 12 * 63)
    run.to_parquet(tmp_path / "run.parquet")
    assert pyarrow.parquet.ParquetFile(tmp_path / "run.parquet").num_row_groups == 4
    check_columns(run, pandas.read_parquet(tmp_path / "run.parquet"))


def test_matlab_files_hold_names_and_units(run, tmp_path):
    run.to_mat(tmp_path / "run.mat", "v", "both", "η/ξ error", "plant.position")
    found = loadmat(tmp_path / "run.mat", simplify_cells=True)
    variables = ["v", "both", "s_____error", "plant_position"]
    assert {k for k in found if not k.startswith("__")} == {"t", "info", *variables}
    for variable, name in zip(variables, ("v", "both", "η/ξ error", "plant.position"), strict=True):
        assert same(found[variable], run[name])
    assert same(found["t"], run.t)
    info = found["info"]
    assert info["diagram"] == "crane"
    assert list(info["variables"]) == variables
    assert list(info["names"]) == ["v", "both", "η/ξ error", "plant.position"]
    assert [str(u) if len(u) else "" for u in info["units"]] == ["m/s2", "m, rad", "", "m, rad"]
    assert loadmat(tmp_path / "run.mat")["v"].shape == (200, 1)  # a column, as MATLAB plots it


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["plant.x", "plant_x", "plant[x"], ["plant_x", "plant_x_2", "plant_x_3"]),
        (["t", "info", "end", "While", "1st", "_x", "ξ"], ["s_t", "s_info", "s_end", "While", "s_1st", "s__x", "s__"]),
        (["a" * 70 + ".y", "b" + "a" * 70 + ".y"], ["a" * 61 + "_y", "a" * 61 + "_2"]),
        (["1" + "a" * 62], ["s_1" + "a" * 60]),
        (["x_2", "x", "x."], ["x_2", "x", "x_"]),
    ],
)
def test_names_are_made_valid_and_unique_for_matlab(names, expected):
    made = _exports.matlab_names(names)
    assert [*made.values()] == expected
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", name) for name in made.values())


def test_a_signal_that_the_format_cannot_hold_is_refused(run, tmp_path, monkeypatch):
    monkeypatch.setattr(_exports, "_LARGEST", 8 * 300)
    run.to_mat(tmp_path / "run.mat", "v")
    with pytest.raises(
        OptionError, match=r"the signal 'both' takes .* less than 2 GiB a variable .*\. Write it with to_parquet"
    ):
        run.to_mat(tmp_path / "run.mat", "v", "both")


def test_without_names_all_ports_go_out_where_no_wire_has_one(tmp_path):
    frame = make(signals=RecordedSignals(LAYOUT, {}, UNITS, LAYOUT.total + 1)).to_pandas()
    assert list(frame)[:3] == ["plant.position[1]", "plant.position[2]", "plant.mass[1]"]
    assert len(frame.columns) == LAYOUT.total


def test_only_what_was_recorded_goes_out():
    columns = np.array([0, 9])
    run = make()
    run = make(data=run.data[:, columns], signals=replace(run.signals, columns=columns, has_states=False))
    assert list(run.to_pandas()) == ["x", "η/ξ error"]
    with pytest.raises(UnknownNameError, match=r"the signal 'v' was not recorded"):
        run.to_pandas("v")


@pytest.mark.parametrize("n", [0, 1])
def test_a_run_of_no_sample_and_of_one_goes_out(n, tmp_path):
    run = make(n)
    assert run.to_pandas().shape == (n, 11)
    assert run.to_xarray("mass")["mass"].shape == (n, 2, 3)
    run.to_csv(tmp_path / "run.csv")
    run.to_mat(tmp_path / "run.mat")
    run.to_parquet(tmp_path / "run.parquet")
    assert len(pandas.read_csv(tmp_path / "run.csv")) == len(pandas.read_parquet(tmp_path / "run.parquet")) == n
    assert loadmat(tmp_path / "run.mat")["both"].shape == (n, 2)


@pytest.mark.parametrize(
    ("library", "export"),
    [("pandas", Run.to_pandas), ("xarray", Run.to_xarray), ("pyarrow", lambda run: run.to_parquet("run.parquet"))],
)
def test_a_library_that_is_missing_is_named_with_what_to_install(run, library, export, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    text = rf'this export needs {library}, which is not installed\. Install it: pip install "loopwright\[export\]"'
    with pytest.raises(OptionError, match=text):
        export(run)


def test_a_wire_called_as_the_times_are_has_a_column_and_they_have_theirs(tmp_path):
    """Two columns of one name are read as one, or not at all; MATLAB's files have the same name for it."""
    run = Diagram("d", Sine(frequency=1.0)().named("t")).simulate(0.5, step=0.125, progress=False)
    run.to_csv(tmp_path / "run.csv", "t")
    run.to_parquet(tmp_path / "run.parquet", "t")
    tables = run.to_pandas("t"), run.to_xarray("t"), pandas.read_parquet(tmp_path / "run.parquet")
    for table in (*tables, pandas.read_csv(tmp_path / "run.csv")):
        np.testing.assert_array_equal(table["s_t"], run["t"])
    assert [*tables[2]] == ["t", "s_t"]
    np.testing.assert_array_equal(tables[2]["t"], run.t)
