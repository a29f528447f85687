"""Description of an FMU: it is read and checked before the FMU's library is loaded."""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from ...blocks.core import FmuFileError, Layout, UnitError, parse_unit
from ..platform import native_platform


@dataclass(frozen=True, eq=False)
class FmuVariable:
    """Float64 variable of an FMU."""

    name: str
    reference: int
    causality: str
    shape: tuple[int, ...]
    unit: str | None
    start: Any
    description: str
    minimum: float | None
    maximum: float | None
    nominal: float | None = None
    variability: str = "continuous"
    initial: str = "exact"
    """FMI's ``initial``; "exact" means that the variable starts at its start value (FMI 3.0, 2.4.7.4)."""

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=int))


@dataclass(frozen=True)
class OtherVariable:
    """Variable of an FMU that is no Float64: it is neither read nor set."""

    name: str
    type: str
    causality: str

    def __str__(self) -> str:
        return f"{self.name} ({self.type})"


@dataclass(frozen=True, eq=False)
class FmuDescription:
    """Content of ``modelDescription.xml``, as far as a diagram needs it."""

    file: Path
    digest: str
    """SHA-256 of the file."""
    model_name: str
    identifier: str
    token: str
    variables: dict[str, FmuVariable]
    other: dict[str, OtherVariable]
    """Variables that are no Float64, by name."""
    can_save: bool = False
    """Whether the state of an instance can be saved and restored (canGetAndSetFMUState)."""
    can_serialize: bool = False
    """Whether a saved state can be turned into bytes, for another process (canSerializeFMUState)."""
    has_derivatives: bool = False
    """Whether the FMU computes directional derivatives in co-simulation (providesDirectionalDerivatives)."""
    variable_step: bool = False
    """Whether communication steps may differ in length (canHandleVariableCommunicationStepSize)."""
    fixed_internal_step: float | None = None
    """Fixed step of the FMU's own integrator in s (fixedInternalStepSize), or None; steps must be multiples of it."""
    states: dict[str, str] = field(default_factory=dict)
    """Continuous states that are variables, with their derivatives' names, in the order of the model structure."""
    model_exchange: str | None = None
    """Model identifier of the model-exchange interface; None without that interface."""
    model_exchange_has_derivatives: bool = False
    """Whether the FMU computes directional derivatives in model exchange."""

    def layout(self, names: Iterable[str]) -> Layout:
        """Return the layout of some variables in a flat vector, one after the other."""
        return Layout.of({name: self.variables[name].shape for name in names})

    def of(self, causality: str) -> dict[str, FmuVariable]:
        """Return the variables of a causality, in the file's order."""
        return {name: v for name, v in self.variables.items() if v.causality == causality}

    def other_ports(self, causality: str) -> list[OtherVariable]:
        """Return the inputs or outputs that are no Float64, in the file's order."""
        return [v for v in self.other.values() if v.causality == causality]

    @property
    def discrete_states(self) -> tuple[str, ...]:
        """Names of the discrete states: they are set at the start and change at events."""
        return tuple(
            v.name
            for v in self.variables.values()
            if v.causality in ("output", "local") and v.variability == "discrete" and v.initial == "exact"
        )


def read_description(file: str | os.PathLike[str]) -> FmuDescription:
    """Read and check an FMU, without loading its library.

    Raises
    ------
    FmuFileError
        If the file is missing, is no FMU, or has no FMI 3.0 co-simulation or no binary for this platform.
    """
    path = Path(file).expanduser()
    if not path.is_file():
        raise FmuFileError(f"there is no file {str(path)!r}; expected an FMU. Check the path.")
    stat = path.stat()
    return _read(path.resolve(), stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=256)
def _read(path: Path, mtime: int, length: int) -> FmuDescription:
    import fmpy

    data, entries, text = _read_archive(path)
    try:
        model = fmpy.read_model_description(str(path))
    except Exception as error:  # FMPy raises bare exceptions
        raise FmuFileError(f"the modelDescription.xml of {str(path)!r} can't be read: {error}") from error
    if not re.fullmatch(r"3\.0(\.\d+)?", model.fmiVersion):
        raise FmuFileError(
            f"{str(path)!r} is an FMU of FMI {model.fmiVersion}; expected FMI 3.0. Export it again with FMI 3.0 "
            f"co-simulation."
        )
    if model.coSimulation is None:
        raise FmuFileError(f"{str(path)!r} has no co-simulation interface; export it with one.")
    identifier, platform = model.coSimulation.modelIdentifier, native_platform()
    if not any(e.startswith(f"binaries/{platform}/{identifier}.") for e in entries):
        found = sorted({e.split("/")[1] for e in entries if e.startswith("binaries/") and e.count("/") > 1})
        raise FmuFileError(
            f"{str(path)!r} has no binary for this platform, {platform} (it has: {', '.join(found) or 'none'}). Export "
            "or build it for this platform."
        )
    variables, other = {}, {}
    for v in model.modelVariables:
        if v.causality == "independent":
            continue
        if v.type != "Float64":
            other[v.name] = OtherVariable(v.name, v.type, v.causality or "local")
            continue
        shape = _shape(v, model)
        start = None if v.start is None else _start(v.start, shape)
        variables[v.name] = FmuVariable(
            v.name, v.valueReference, v.causality or "local", shape, _unit(v.unit), start, v.description or "",
            _number(v.min), _number(v.max), _number(v.nominal), v.variability or "continuous",
            v.initial or ("calculated" if v.causality in ("output", "local", None) else "exact"),
        )  # fmt: skip
    return FmuDescription(
        path, hashlib.sha256(data).hexdigest(), model.modelName, identifier, model.instantiationToken, variables, other,
        states=_states(model, variables), **_capabilities(text),
    )  # fmt: skip


def _read_archive(path: Path) -> tuple[bytes, set[str], bytes]:
    """Return the content of a file, the names in its archive, and the text of its description."""
    data = b""
    try:
        data = path.read_bytes()
        with zipfile.ZipFile(path) as archive:
            entries = set(archive.namelist())
            text = archive.read("modelDescription.xml") if "modelDescription.xml" in entries else b""
    except zipfile.BadZipFile as error:
        raise FmuFileError(
            f"{str(path)!r} is no FMU: it is no zip archive (it starts with {data[:8]!r}), or a damaged one ({error}). "
            "Give the .fmu that the tool exported."
        ) from None
    except MemoryError:
        raise FmuFileError(
            f"{str(path)!r} can't be read: its content does not fit into memory; expected an FMU of a few MB. Look at "
            "the sizes of the files in it, or export it again."
        ) from None
    except RuntimeError as error:  # of an archive that asks for a password, or is packed in an unknown way
        raise FmuFileError(
            f"{str(path)!r} can't be read: {error}. Pack it again without a password, by the usual compression."
        ) from None
    except (OSError, EOFError, zlib.error) as error:
        raise FmuFileError(
            f"{str(path)!r} can't be read: {error}. Check its permissions, or copy or export it again."
        ) from None
    if "modelDescription.xml" not in entries:
        raise FmuFileError(f"{str(path)!r} is a zip archive without modelDescription.xml, so it is no FMU.")
    return data, entries, text


def _capabilities(text: bytes) -> dict[str, Any]:
    """Return the interfaces' flags (FMI 3.0, 3.4 and 4.4); FMPy drops providesDirectionalDerivatives of FMI 3.0."""
    root = ET.fromstring(text)
    steps, exchange = root.find("CoSimulation"), root.find("ModelExchange")
    fixed = None if steps is None else steps.get("fixedInternalStepSize")
    return {
        "can_save": _flag(steps, "canGetAndSetFMUState"),
        "can_serialize": _flag(steps, "canGetAndSetFMUState") and _flag(steps, "canSerializeFMUState"),
        "has_derivatives": _flag(steps, "providesDirectionalDerivatives"),
        "variable_step": _flag(steps, "canHandleVariableCommunicationStepSize"),
        "fixed_internal_step": _number(fixed),
        "model_exchange": None if exchange is None else exchange.get("modelIdentifier"),
        "model_exchange_has_derivatives": _flag(exchange, "providesDirectionalDerivatives"),
    }


def _flag(interface: ET.Element | None, name: str) -> bool:
    return interface is not None and interface.get(name) in ("true", "1")


def _states(model: Any, variables: dict[str, FmuVariable]) -> dict[str, str]:
    """Return derivatives and their states (FMI 3.0, 2.4.8); none if one is missing or no Float64."""
    pairs = {
        u.variable.derivative.name: u.variable.name for u in model.derivatives if u.variable.derivative is not None
    }
    complete = len(pairs) == len(model.derivatives) and all(a in variables and b in variables for a, b in pairs.items())
    return pairs if complete else {}


def _number(text: Any) -> float | None:
    return None if text is None else float(text)


def _shape(variable: Any, model: Any) -> tuple[int, ...]:
    sizes = []
    for dimension in variable.dimensions or ():
        if dimension.start is not None:
            sizes.append(int(dimension.start))
        else:
            parameters = {v.valueReference: v for v in model.modelVariables}
            sizes.append(int(parameters[dimension.valueReference].start))
    return tuple(sizes)


def _start(text: Any, shape: tuple[int, ...]) -> np.ndarray:
    values = np.array([float(x) for x in (text.split() if isinstance(text, str) else np.ravel(text))])
    full = np.broadcast_to(values, (int(np.prod(shape, dtype=int)),)) if values.size == 1 else values
    return np.array(full).reshape(shape)


def _unit(text: str | None) -> str | None:
    """Return a unit that this library can read, else None."""
    if text is None:
        return None
    try:
        parse_unit(text)
    except UnitError:
        return None
    return text
