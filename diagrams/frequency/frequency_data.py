"""A measured loop from a CSV file: its columns by name, as python-control's frequency-response data."""

from __future__ import annotations

import csv
import math
import os
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import OptionError, accepts, describe_disk_error, kinds

if TYPE_CHECKING:
    from control import FrequencyResponseData

FREQUENCY = {"rad/s": 1.0, "omega": 1.0, "hz": 2.0 * math.pi, "frequency_hz": 2.0 * math.pi, "f": 2.0 * math.pi}
"""Names of a frequency's column, with the factor to rad/s."""


@accepts(file=kinds.path, dt=kinds.number)
def read_frequency_data(file: str | os.PathLike[str], *, dt: float = 0.0) -> FrequencyResponseData:
    """Return the loop of a CSV file as `control.FrequencyResponseData`, with its attribute ``uncertainty``.

    The first line names the columns: the frequency ``omega`` (or ``rad/s``) or ``hz`` (or ``frequency_hz``, ``f``); the
    value ``real`` and ``imag``, or ``gain`` or ``gain_db`` with ``phase_deg`` or ``phase_rad``; and, if it is known,
    ``uncertainty``, relative to the value.

    Parameters
    ----------
    file : path
        The file.
    dt : float
        Sample time in s of a sampled loop.

    Raises
    ------
    OptionError
        If the file can't be read, a column is missing or given twice, or a row has no number there.
    """
    import control

    lines, columns = _read_columns(file)

    def take(*options: str) -> str:
        given = [name for name in options if name in columns]
        if len(given) != 1:
            raise OptionError(
                f"found the columns {', '.join(columns) or 'none'}; expected one of {', '.join(options)}. Name it in "
                "the first line.",
                block=str(file),
            )
        return given[0]

    frequency = take(*FREQUENCY)
    omega = FREQUENCY[frequency] * columns[frequency]
    if "real" in columns:
        value: np.ndarray = columns["real"] + 1j * columns[take("imag")]
    else:
        gain, phase = take("gain", "gain_db"), take("phase_deg", "phase_rad")
        size = 10.0 ** (columns[gain] / 20.0) if gain == "gain_db" else columns[gain]
        value = size * np.exp(1j * (np.radians(columns[phase]) if phase == "phase_deg" else columns[phase]))
    # Rows may be in any order; the same frequency twice has no phase between, so it is an error.
    order = np.argsort(omega, kind="stable")
    if (twice := np.flatnonzero(np.diff(omega[order]) == 0.0)).size:
        first, second = (lines[int(order[k])] for k in (twice[0], twice[0] + 1))
        raise OptionError(
            f"found the frequency {columns[frequency][order[twice[0]]]:g} in line {first} and again in line {second}; "
            "expected each one once. Leave one of the rows out, or take their mean.",
            block=str(file),
            port=frequency,
        )
    data = control.frd(value[order], omega[order], dt)
    data.uncertainty = columns["uncertainty"][order] if "uncertainty" in columns else None
    return data


def _read_columns(file: str | os.PathLike[str]) -> tuple[list[int], dict[str, np.ndarray]]:
    """Return the numbers of a CSV file by the names of their columns, and the lines of their rows."""
    try:
        # Spreadsheets write a byte order mark; lines are counted by the reader, as cells may contain line breaks.
        with open(file, encoding="utf-8-sig", newline="") as opened:
            reader = csv.reader(opened)
            numbered = [(reader.line_num, row) for row in reader if row and any(cell.strip() for cell in row)]
    except OSError as error:
        found = describe_disk_error(error, file, "Name another file.")
        raise OptionError(f"it can't be read: {found}", block=str(file)) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise OptionError(f"it is no CSV file in UTF-8: {error}. Save it as one.", block=str(file)) from error
    names = [cell.strip().lower() for cell in numbered[0][1]] if numbered else []
    columns: dict[str, np.ndarray] = {}
    for k, name in enumerate(names):
        if name and name in columns:
            raise OptionError(
                f"found the column {name!r} twice; expected each one once. Leave one of them out.", block=str(file)
            )
        try:
            columns[name] = np.array([float(row[k]) for _, row in numbered[1:]])
        except (ValueError, IndexError):
            bad = next(line for line, row in numbered[1:] if len(row) <= k or not _is_number(row[k]))
            raise OptionError(
                f"line {bad} has no number in the column {name!r}; expected one. Mend it, or leave the row out.",
                block=str(file),
            ) from None
    return [line for line, _ in numbered[1:]], columns


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
