"""An SSP, read: what is in it, and the structure of its diagram."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...blocks.core import (
    Grid,
    OptionError,
    Sheet,
    ShownAsTable,
    SspFileError,
    accepts,
    brief,
    count_of,
    explain_calls,
    kinds,
)
from ...fmus import ArchiveLimits
from ..wiring import Structure
from .assembly import Assembly
from .elements import OUTPUTS, Component, System
from .parsing import Parsed, parse_package
from .ssp_files import open_package


@explain_calls
@dataclass(frozen=True, eq=False)
class SspDescription(ShownAsTable):
    """Content of an SSP, as `read_ssp` returns it; ``Diagram.from_ssp(file)`` makes a diagram of it.

    Attributes
    ----------
    file : Path
        The file.
    variant : str
        The description that was read.
    variants : tuple of str
        All descriptions in the file, the default one first.
    name : str
        Name of the system structure.
    version : str
        Version of SSP, "1.0" or "2.0".
    components : mapping of str
        Source of each component by its path in the file.
    inputs, outputs : mapping of str
        Unit of each input and output of the root system, None without one.
    start, stop : float or None
        Start and end in s of the simulation that the file proposes.
    step : float or None
        Step in s that an annotation in it names (of OSP, OMSimulator and others); the standard has none.
    tool : str
        Tool that made it.
    notes : tuple of str
        Remarks on what has no effect.
    """

    file: Path
    variant: str
    variants: tuple[str, ...]
    name: str
    version: str
    components: Mapping[str, str]
    inputs: Mapping[str, str | None]
    outputs: Mapping[str, str | None]
    start: float | None = None
    stop: float | None = None
    step: float | None = None
    tool: str = ""
    notes: tuple[str, ...] = ()
    _parsed: Parsed | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        facts = f"SSP {self.version}", count_of(len(self.components), "component")
        return brief(f"description of {self.file.name!r}", *facts, then=f"Diagram.from_ssp({self.file.name!r})")

    def _sheet(self) -> Sheet:
        def seconds(value: float | None) -> str:
            return "" if value is None else f"{value:g} s"

        def grid(title: str, units: Mapping[str, str | None]) -> Grid:
            return Grid(title, ("name", "unit"), tuple((name, unit or "") for name, unit in units.items()))

        return Sheet(
            f"SSP {self.file.name!r}",
            (
                ("system", self.name),
                ("SSP", self.version),
                ("made by", self.tool),
                ("description", self.variant),
                ("others", ", ".join(name for name in self.variants if name != self.variant)),
                ("start", seconds(self.start)),
                ("stop", seconds(self.stop)),
                ("step", seconds(self.step)),
            ),
            (
                Grid("Components", ("path", "source"), tuple(self.components.items())),
                grid("Inputs", self.inputs),
                grid("Outputs", self.outputs),
            ),
            self.notes,
        )


@accepts(file=kinds.path, limits=kinds.one_of_class(ArchiveLimits, "ArchiveLimits(…)"))
def read_ssp(
    file: str | os.PathLike[str], variant: str | None = None, *, limits: ArchiveLimits | None = None
) -> SspDescription:
    """Read what is in an SSP (System Structure and Parameterization 1.0 or 2.0), without running anything of it.

    Parameters
    ----------
    file : str or PathLike
        The ``.ssp``, or a ``.ssd`` with its files next to it.
    variant : str, optional
        File name of the description in it, or its name; ``SystemStructure.ssd`` without it.
    limits : ArchiveLimits, optional
        Limits of its size, and of that of each FMU in it; the usual ones without it.

    Returns
    -------
    SspDescription

    Raises
    ------
    SspFileError
        If the file is missing or no SSP; if its archive is unsafe, damaged or beyond the limits; if a description in it
        breaks the standard, or has something that is not supported here: the message names the element.
    """
    parsed = parse_package(open_package(file, limits), variant)
    root, found = parsed.system, parsed.experiment
    return SspDescription(
        parsed.package.file,
        parsed.variant,
        parsed.package.descriptions,
        parsed.name,
        parsed.version,
        {".".join(names): e.source for names, e in root.walk() if isinstance(e, Component)},
        {n: c.unit for n, c in root.connectors.items() if c.kind not in OUTPUTS},
        {n: c.unit for n, c in root.connectors.items() if c.kind in OUTPUTS},
        found.start,
        found.stop,
        found.step,
        parsed.tool,
        parsed.notes,
        parsed,
    )


def read_structure(
    file: str | os.PathLike[str],
    variant: str | None = None,
    inputs: Mapping[str, Any] | None = None,
    limits: ArchiveLimits | None = None,
) -> tuple[str, Structure]:
    """Return the name and the structure of an SSP's diagram; parameters are those of `Diagram.from_ssp`.

    Raises `SspFileError, DoubleDriveError, OptionError`: as `read_ssp`; for connections and parameters that don't fit
    the FMUs; for an unknown name in ``inputs``.
    """
    if inputs is not None and not isinstance(inputs, Mapping):
        raise OptionError(
            f"found inputs={inputs!r}; expected values by names, such as {{'u': 1.0}}. Give these.", port="inputs"
        )
    parsed = parse_package(open_package(file, limits), variant)
    root: System = parsed.system
    notes = [*parsed.notes]
    structure = Assembly(root, limits or ArchiveLimits(), inputs or {}, notes).structure()
    if notes:
        warnings.warn(f"SSP {parsed.package.file.name!r}: {'; '.join(notes)}.", RuntimeWarning, stacklevel=4)
    if not structure.blocks:
        raise SspFileError(
            f"{str(parsed.package.file)!r} has no component; expected one FMU at least. Add one.", block=root.name
        )
    name = re.sub(r"\W", "_", root.name or parsed.name or "ssp")
    return (name if name.isidentifier() else f"_{name}"), structure
