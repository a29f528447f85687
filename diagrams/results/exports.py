"""Export of runs to other tools: CSV, pandas, xarray, Parquet, MATLAB."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import OptionError, check_argument, check_file, kinds, replace_file
from .stored import PathLike

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

    from .recorded_signals import RecordedSignals

_GROUP = 2**24  # bytes of a row group
_LONGEST = 63  # characters of a name in MATLAB
_LARGEST = 2**31 - 2**16  # bytes of a variable in a MATLAB file of version 5, with its header
_TAKEN = {
    *("t", "info"),
    *("break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if"),
    *("otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while"),
}


def to_csv(run: RecordedSignals, path: PathLike | IO[str], names: Sequence[str]) -> None:
    """Write signals as comma-separated values; see `Run.to_csv`."""
    if isinstance(path, str | os.PathLike):
        check_file(path)
    table = dict(columns(run, names))
    header = ",".join(["t", *table])
    rows = np.column_stack([run.t, *table.values()])
    with replace_file(path) if isinstance(path, str | os.PathLike) else nullcontext(path) as file:
        np.savetxt(file, rows, "%.17g", ",", header=header, comments="", encoding="utf-8")


def to_pandas(run: RecordedSignals, names: Sequence[str]) -> DataFrame:
    """Return signals as a DataFrame; see `Run.to_pandas`."""
    pandas = import_library("pandas")
    table = dict(columns(run, names))
    frame: DataFrame = pandas.DataFrame(table, index=pandas.Index(np.array(run.t), name="t"))
    frame.attrs["units"] = {"t": "s", **units_of_columns(run, names)}
    return frame


def to_xarray(run: RecordedSignals, names: Sequence[str]) -> Dataset:
    """Return signals as a Dataset; see `Run.to_xarray`."""
    xarray = import_library("xarray")
    variables, coordinates = {}, {"t": ("t", np.array(run.t), {"units": "s"})}
    for name in select_signals(run, names):
        values = run[name]
        axes = values.shape[1:]
        dims = [f"{name}_dim"] if len(axes) == 1 else [f"{name}_dim{i + 1}" for i in range(len(axes))]
        units = unit_list(run, name, values[:1].size)
        text = units[0] if len(set(units)) == 1 else ", ".join(units)
        variables[name] = (("t", *dims), values, {"units": text} if any(units) else {})
        coordinates |= {dim: (dim, np.arange(1, n + 1), {}) for dim, n in zip(dims, axes, strict=True)}
    dataset: Dataset = xarray.Dataset(variables, coordinates, attrs={"title": run.diagram_name})
    return dataset


def to_parquet(run: RecordedSignals, path: PathLike, names: Sequence[str]) -> None:
    """Write signals as a Parquet file; see `Run.to_parquet`."""
    arrow, parquet = import_library("pyarrow"), import_library("pyarrow.parquet")
    check_file(path)
    units = {"t": "s", **units_of_columns(run, names)}
    fields = [arrow.field(n, arrow.float64(), metadata={"unit": u} if u else None) for n, u in units.items()]
    schema = arrow.schema(fields, metadata={"diagram": run.diagram_name})
    n = _GROUP // (8 * len(fields)) + 1
    with replace_file(path) as file, parquet.ParquetWriter(file, schema) as writer:
        for k in range(0, max(len(run.t), 1), n):
            some = slice(k, k + n)
            arrays = [np.ascontiguousarray(run.t[some]), *(v for _, v in columns(run, names, some))]
            writer.write_table(arrow.Table.from_arrays([arrow.array(a) for a in arrays], schema=schema))


def to_mat(run: RecordedSignals, path: PathLike, names: Sequence[str]) -> None:
    """Write signals as a MATLAB file; see `Run.to_mat`."""
    from scipy.io import savemat

    check_file(path)
    signals = select_signals(run, names)
    variables = matlab_names(signals)
    values = {v: flatten_samples(run[n]) for n, v in variables.items()}
    for name, variable in variables.items():
        if values[variable].nbytes > _LARGEST:
            raise OptionError(
                f"the signal {name!r} takes {values[variable].nbytes / 2**30:.1f} GiB; expected less than 2 GiB a "
                "variable in a MATLAB file of version 5. Write it with to_parquet, which MATLAB reads with parquetread."
            )
    units = [", ".join(unit_list(run, n, values[v].shape[1])) if run.unit(n) else "" for n, v in variables.items()]
    info = {
        "diagram": run.diagram_name,
        "variables": np.array([*variables.values()], dtype=object),
        "names": np.array([*variables], dtype=object),
        "units": np.array(units, dtype=object),
    }
    contents = {"t": np.array(run.t), "info": info, **values}
    with replace_file(path) as file:
        savemat(file, contents, appendmat=False, long_field_names=True, oned_as="column")


def matlab_names(names: Sequence[str]) -> dict[str, str]:
    """Return a valid MATLAB name for each signal, by the rules of `Run.to_mat`."""
    made: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        if len(plain) > _LONGEST:
            plain = plain[-_LONGEST:]
        if not re.match(r"[A-Za-z]", plain) or plain in _TAKEN:
            plain = f"s_{plain}"[:_LONGEST]
        unique, k = plain, 1
        while unique in made.values():
            k += 1
            unique = f"{plain[: _LONGEST - len(f'_{k}')]}_{k}"
        made[name] = unique
    return made


def select_signals(run: RecordedSignals, names: Sequence[str]) -> list[str]:
    """Return the signals to export, each once: those given, else all named wires, else all ports."""
    for name in names:
        check_argument(name, kinds.text, "names", run.diagram_name)
    every = run.names
    wires = [n for n in every if n in run.wires]
    return list(dict.fromkeys(names or wires or every))


def columns(run: RecordedSignals, names: Sequence[str], some: slice = slice(None)) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the values of each column; entries of a vector are counted from 1."""
    for name in select_signals(run, names):
        values = run.part(name, some)
        for label, column in zip(column_labels(name, values.shape[1:]), flatten_samples(values).T, strict=True):
            yield label, np.ascontiguousarray(column)


def flatten_samples(values: np.ndarray) -> np.ndarray:
    """Return the entries of each sample side by side, a matrix's row by row."""
    return values.reshape(len(values), int(np.prod(values.shape[1:])))


def column_labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of a signal's columns."""
    return [name] if shape == () else [f"{name}[{i + 1}]" for i in range(int(np.prod(shape)))]


def units_of_columns(run: RecordedSignals, names: Sequence[str]) -> dict[str, str]:
    """Return the unit of each column, "" where it is not declared."""
    units: dict[str, str] = {}
    for name in select_signals(run, names):
        shape = run.part(name, slice(0)).shape[1:]
        units |= zip(column_labels(name, shape), unit_list(run, name, int(np.prod(shape))), strict=True)
    return units


def unit_list(run: RecordedSignals, name: str, size: int) -> list[str]:
    """Return the unit of each entry of a signal, "" where it is not declared."""
    unit = run.unit(name)
    if not isinstance(unit, tuple):
        return [unit or ""] * size
    return list(unit) if len(unit) == size else [", ".join(unit)] * size


def import_library(name: str) -> Any:
    """Import a library of the extra ``export``.

    Raises
    ------
    OptionError
        If it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise OptionError(
            f"this export needs {name.partition('.')[0]}, which is not installed. Install it: "
            'pip install "loopwright[export]".'
        ) from error
