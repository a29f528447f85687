"""Export of runs to other tools: CSV, pandas, xarray, Parquet, MATLAB."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import OptionError, check_file, replace_file
from .stored import PathLike

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

_GROUP = 2**24  # bytes of a row group
_LONGEST = 63  # characters of a name in MATLAB
_LARGEST = 2**31 - 2**16  # bytes of a variable in a MATLAB file of version 5, with its header
_TAKEN = {
    *("t", "info"),
    *("break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if"),
    *("otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while"),
}


def to_csv(path: PathLike | IO[str], t: np.ndarray, table: Mapping[str, np.ndarray]) -> None:
    """Write columns as comma-separated values; see `Run.to_csv`."""
    if isinstance(path, str | os.PathLike):
        check_file(path)
    header = ",".join(["t", *table])
    rows = np.column_stack([t, *table.values()])
    with replace_file(path) if isinstance(path, str | os.PathLike) else nullcontext(path) as file:
        np.savetxt(file, rows, "%.17g", ",", header=header, comments="", encoding="utf-8")


def to_pandas(t: np.ndarray, table: Mapping[str, np.ndarray], units: Mapping[str, str]) -> DataFrame:
    """Return columns, with their units, as a DataFrame; see `Run.to_pandas`."""
    pandas = import_library("pandas")
    frame: DataFrame = pandas.DataFrame(table, index=pandas.Index(np.array(t), name="t"))
    frame.attrs["units"] = {"t": "s", **units}
    return frame


def to_xarray(
    t: np.ndarray, signals: Mapping[str, np.ndarray], units: Mapping[str, Sequence[str]], title: str
) -> Dataset:
    """Return signals, with the unit of each entry, as a Dataset; see `Run.to_xarray`."""
    xarray = import_library("xarray")
    variables, coordinates = {}, {"t": ("t", np.array(t), {"units": "s"})}
    for recorded, values in signals.items():
        name, axes = name_next_to_time(recorded), values.shape[1:]
        dims = [f"{name}_dim"] if len(axes) == 1 else [f"{name}_dim{i + 1}" for i in range(len(axes))]
        own = units[recorded]
        text = own[0] if len(set(own)) == 1 else ", ".join(own)
        variables[name] = (("t", *dims), values, {"units": text} if any(own) else {})
        coordinates |= {dim: (dim, np.arange(1, n + 1), {}) for dim, n in zip(dims, axes, strict=True)}
    dataset: Dataset = xarray.Dataset(variables, coordinates, attrs={"title": title})
    return dataset


def to_parquet(
    path: PathLike,
    t: np.ndarray,
    read: Callable[[slice], Iterable[np.ndarray]],
    units: Mapping[str, str],
    diagram: str,
) -> None:
    """Write columns as a Parquet file, in groups of samples that ``read`` returns; see `Run.to_parquet`."""
    arrow, parquet = import_library("pyarrow"), import_library("pyarrow.parquet")
    check_file(path)
    units = {"t": "s", **units}
    fields = [arrow.field(n, arrow.float64(), metadata={"unit": u} if u else None) for n, u in units.items()]
    schema = arrow.schema(fields, metadata={"diagram": diagram})
    n = _GROUP // (8 * len(fields)) + 1
    with replace_file(path) as file, parquet.ParquetWriter(file, schema) as writer:
        for k in range(0, max(len(t), 1), n):
            some = slice(k, k + n)
            arrays = [np.ascontiguousarray(t[some]), *read(some)]
            writer.write_table(arrow.Table.from_arrays([arrow.array(a) for a in arrays], schema=schema))


def to_mat(
    path: PathLike,
    t: np.ndarray,
    signals: Mapping[str, np.ndarray],
    units: Mapping[str, Sequence[str] | None],
    diagram: str,
) -> None:
    """Write signals, with the unit of each entry where any is declared, as a MATLAB file; see `Run.to_mat`."""
    from scipy.io import savemat

    check_file(path)
    variables = matlab_names(list(signals))
    values = {v: flatten_samples(signals[n]) for n, v in variables.items()}
    for name, variable in variables.items():
        if values[variable].nbytes > _LARGEST:
            raise OptionError(
                f"the signal {name!r} takes {values[variable].nbytes / 2**30:.1f} GiB; expected less than 2 GiB a "
                "variable in a MATLAB file of version 5. Write it with to_parquet, which MATLAB reads with parquetread."
            )
    info = {
        "diagram": diagram,
        "variables": np.array([*variables.values()], dtype=object),
        "names": np.array([*variables], dtype=object),
        "units": np.array([", ".join(units[n] or ()) for n in variables], dtype=object),
    }
    contents = {"t": np.array(t), "info": info, **values}
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


def flatten_samples(values: np.ndarray) -> np.ndarray:
    """Return the entries of each sample side by side, a matrix's row by row."""
    return values.reshape(len(values), int(np.prod(values.shape[1:])))


def name_next_to_time(name: str) -> str:
    """Return the name under which a signal goes out: of a wire called t, as the times are, that of `to_mat`, s_t."""
    return "s_t" if name == "t" else name


def column_labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """Return the names of a signal's columns."""
    name = name_next_to_time(name)
    return [name] if shape == () else [f"{name}[{i + 1}]" for i in range(int(np.prod(shape)))]


def import_library(name: str) -> Any:
    """Import a library of the extra ``export``."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise OptionError(
            f"this export needs {name.partition('.')[0]}, which is not installed. Install it: "
            'pip install "loopwright[export]".'
        ) from error
