"""Description of an FMU: it is read and checked before the FMU's library is loaded."""

from __future__ import annotations

import os
import re
import stat
import weakref
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import (
    FmuFileError,
    Layout,
    Sheet,
    ShownAsTable,
    accepts,
    brief,
    describe_disk_error,
    enumerate_some,
    explain_calls,
    kinds,
)
from ..host_state import FOLDER
from .aliases import find_aliases, judge_negated, read_negated
from .archive_limits import ArchiveLimits
from .binaries import find_binary, judge_name
from .faults import FmuFault, FmuFinding
from .fmpy_description import read_model, resize
from .gathering import Elements, gather
from .interfaces import (
    Dependencies,
    ModelExchangeInfo,
    derivatives_flag,
    read_co_simulation,
    read_dependencies,
    read_model_exchange,
    state_flags,
)
from .parsed_xml import parse_xml
from .rules import KNOWN_VERSIONS, check_dimensions, unknown_version
from .states import find_states, read_derivatives
from .unit_definitions import FmuUnits
from .variables import WIRE_TYPES, FmuVariable, OtherVariable, fmi3_type, read_other, read_variable, variable_grid
from .zip_file import DESCRIPTION, OTHER_PLACE, FmuArchive

_DROPPED = ("UInt", "Clock")
"""Beginnings of the types of FMI 3.0 of which FMPy drops attributes."""


@explain_calls
@dataclass(frozen=True, eq=False)
class FmuDescription(ShownAsTable):
    """Content of ``modelDescription.xml``, as far as a diagram needs it."""

    fmi: str
    """Version of FMI, such as "2.0" or "3.0"."""
    file: Path
    digest: str
    """SHA-256 of the file."""
    model_name: str
    identifier: str
    token: str
    """The instantiationToken, FMI 2.0's guid."""
    binary: str
    """The library for this platform, as its path in the archive."""
    variables: dict[str, FmuVariable]
    """Variables with numbers as values; scalars ``s[1]``, ``s[2]`` are gathered into an array ``s``."""
    other: dict[str, OtherVariable]
    """Other variables, by name: texts, binaries, clocks and negated aliases, which no wire carries."""
    elements: Elements = field(default_factory=dict)
    """Array and index, from 0 on, of each scalar that was gathered."""
    aliases: dict[str, str] = field(default_factory=dict)
    """First name of each input and parameter by its further names; a wire is for the first."""
    scalars: Mapping[str, FmuVariable] = field(default_factory=dict, repr=False)
    """Variables with numbers as values as the file has them, before any were gathered."""
    derivatives: Mapping[str, str] = field(default_factory=dict, repr=False)
    """Continuous states by their derivatives, as the file has them."""
    joined: Mapping[str, str] = field(default_factory=dict, repr=False)
    """Ports of the arrays that the user has put together of scalars, by the names of these arrays in `variables`."""
    members: Mapping[str, FmuVariable] = field(default_factory=dict, repr=False)
    """The scalars of these, as the file has them, by name."""
    spelled: Mapping[str, str] = field(default_factory=dict, repr=False)
    """These scalars' names by those of the elements that they are, such as ``position[1]``."""
    complaints: tuple[str, ...] = ()
    """Rules of the standard that the description breaks, as FMPy's validation words them."""
    unit_complaints: tuple[str, ...] = ()
    """Texts on units whose names mean something else here, so that their variables' units are others or none."""
    can_save: bool = False
    """Whether the state of an instance can be saved and restored (canGetAndSetFMUState)."""
    can_serialize: bool = False
    """Whether a saved state can be turned into bytes, for another process (canSerializeFMUState)."""
    has_derivatives: bool = False
    """Whether the FMU computes directional derivatives in co-simulation (providesDirectionalDerivatives)."""
    only_once: bool = False
    """Whether a process can have one instance only (canBeInstantiatedOnlyOncePerProcess)."""
    has_event_mode: bool = False
    """Whether events in co-simulation can be handled in Event Mode (hasEventMode of FMI 3.0)."""
    interpolates_inputs: bool = False
    """Whether it takes slopes of its real inputs (canInterpolateInputs of FMI 1.0 and 2.0), or inputs within a step
    (providesIntermediateUpdate of FMI 3.0)."""
    variable_step: bool = False
    """Whether communication steps may differ in length (canHandleVariableCommunicationStepSize)."""
    fixed_internal_step: float | None = None
    """Fixed step of the FMU's own integrator in s (fixedInternalStepSize of FMI 3.0), or None; steps must be multiples
    of it."""
    stop_time: float | None = None
    """End of the default experiment in s, beyond which some FMUs take no step unless they are given a later one."""
    step_size: float | None = None
    """Communication step of the default experiment in s."""
    dependencies: Dependencies = field(default_factory=dict)
    """Variables that each output depends on, as the model structure says."""
    states: dict[str, str] = field(default_factory=dict)
    """Continuous states that are variables, with their derivatives' names, in the order of the model structure."""
    state_order: tuple[int, ...] = ()
    """Place of each of the FMU's continuous states among the elements of `states`; FMI sets them in its own order."""
    limits: ArchiveLimits = field(default_factory=ArchiveLimits)
    """Limits within which it is read and unpacked."""
    findings: tuple[FmuFinding, ...] = ()
    """Faults of the archive that don't keep the FMU from running."""
    exchange: ModelExchangeInfo | None = None
    """The model-exchange interface, if there is one with a library for this platform."""
    co_simulation: bool = True
    """Whether there is a co-simulation interface; ``identifier`` and ``binary`` are else those of model exchange."""
    generation_tool: str = ""
    """Tool that made it, as its description says."""
    model_version: str = ""
    """Version of the model, as its description says."""

    def __repr__(self) -> str:
        kinds = "co-simulation" * self.co_simulation, "model exchange" * bool(self.model_exchange)
        facts = f"FMI {self.fmi}", " and ".join(filter(None, kinds)), f"{len(self.variables)} variables"
        return brief(f"description of {self.file.name!r}", *facts, then=".variables, .states, loopwright.doctor(file)")

    def _sheet(self) -> Sheet:
        return self.as_sheet()

    def as_sheet(
        self,
        head: str = "",
        inputs: Mapping[str, FmuVariable] | None = None,
        outputs: Mapping[str, FmuVariable] | None = None,
        started: Mapping[str, Any] | None = None,
        facts: tuple[tuple[str, Any], ...] = (),
    ) -> Sheet:
        """Return the FMU as it is shown; a block's ports and start values take the place of the file's own."""
        kinds = (("co-simulation", self.co_simulation), ("model exchange", self.model_exchange is not None))
        states = {name: self.find(name) for name in self.states}
        started = started or {}
        step = self.fixed_internal_step
        return Sheet(
            head or f"FMU {self.file.name!r}",
            (
                ("model", " ".join(filter(None, (self.model_name, self.model_version)))),
                ("FMI", f"{self.fmi}, {' and '.join(name for name, has in kinds if has)}"),
                ("made by", self.generation_tool),
                *facts,
                ("can", ", ".join(self.capabilities) or "none of saving its state, derivatives, events"),
                ("steps", "" if step is None else f"multiples of {step:g} s"),
                ("no ports for", enumerate_some(map(str, self.other.values()), 8)),
            ),
            (
                variable_grid("Inputs", self.of("input") if inputs is None else inputs, started),
                variable_grid("Outputs", self.of("output") if outputs is None else outputs, {}),
                variable_grid("Parameters", {**self.structural, **self.of("parameter")}, started),
                variable_grid("Continuous states", states, started),
            ),
            tuple(map(str, self.findings)),
        )

    @property
    def model_exchange(self) -> str | None:
        """Model identifier of the model-exchange interface; None without that interface."""
        return None if self.exchange is None else self.exchange.identifier

    @property
    def model_exchange_has_derivatives(self) -> bool:
        """Whether the FMU computes directional derivatives in model exchange."""
        return self.exchange is not None and self.exchange.has_derivatives

    @property
    def capabilities(self) -> list[str]:
        """What it can do in a run, in words."""
        flags = {
            "save its state": self.can_save,
            "serialize it": self.can_serialize,
            "give directional derivatives": self.has_derivatives or self.model_exchange_has_derivatives,
            "take steps of different lengths": self.variable_step,
            "handle events in co-simulation": self.has_event_mode,
            "take inputs within a step": self.interpolates_inputs,
            "be loaded once per process only": self.only_once,
        }
        return [text for text, has in flags.items() if has]

    def layout(self, names: Iterable[str]) -> Layout:
        """Return the layout of some variables in a flat vector, one after the other."""
        return Layout.of({name: self.find(name).shape for name in names})

    def has_slopes(self, variable: FmuVariable) -> bool:
        """Whether directional derivatives of a variable may be asked for: of outputs and of the states' derivatives."""
        known = {key for v in self.variables.values() if v.causality == "output" for key in v.keys}
        known |= {key for name in self.states.values() for key in self.find(name).keys}
        return known.issuperset(variable.keys)

    def find_state(self, variable: FmuVariable) -> str | None:
        """Return the name of the continuous state that a variable is, by its own or another name; else None."""
        return next((name for name in self.states if self.find(name).keys == variable.keys), None)

    def find(self, name: str) -> FmuVariable:
        """Return a variable, or a scalar that was gathered into an array.

        Raises
        ------
        KeyError
            If the FMU has no such variable with numbers as values.
        """
        name = self.spelled.get(name, name)
        return self.element(name) if name in self.elements and name not in self.variables else self.variables[name]

    def feeds_through(self, source: FmuVariable, output: FmuVariable) -> bool:
        """Return whether an output may follow an input at once; it may where the model structure doesn't say."""
        found = [self.dependencies.get(key) for key in output.keys]
        return any(of is None or not of.isdisjoint(source.keys) for of in found)

    @property
    def names(self) -> set[str]:
        """Names of all variables with numbers as values, and of scalars that were gathered."""
        return {*self.variables, *self.elements, *self.spelled}

    def of(self, causality: str) -> dict[str, FmuVariable]:
        """Return the variables of a causality, in the file's order."""
        return {name: v for name, v in self.variables.items() if v.causality == causality}

    def other_ports(self, causality: str) -> list[OtherVariable]:
        """Return the inputs or outputs that no wire carries, in the file's order."""
        return [v for v in self.other.values() if v.causality == causality]

    def element(self, name: str) -> FmuVariable:
        """Return a scalar that was gathered into an array."""
        if name in self.members:
            return self.members[name]
        array, index = self.elements[name]
        v = self.variables[array]

        def at(values: Any) -> Any:
            return None if values is None else float(np.broadcast_to(values, v.shape)[index])

        reference = v.references[int(np.ravel_multi_index(index, v.shape))]
        start = None if v.start is None else np.array(v.start[index])
        return replace(
            v,
            name=name,
            references=(reference,),
            shape=(),
            start=start,
            minimum=at(v.minimum),
            maximum=at(v.maximum),
            nominal=at(v.nominal),
        )

    @cached_property
    def structural(self) -> dict[str, FmuVariable]:
        """Structural parameters, on which the sizes of arrays depend, by name."""
        return self.of("structuralParameter")

    @cached_property
    def texts(self) -> dict[str, OtherVariable]:
        """Variables that are texts or binary data, by name."""
        return {name: v for name, v in self.other.items() if v.is_text}

    @property
    def derivatives_flag(self) -> str:
        """Name of the capability flag of directional derivatives."""
        return derivatives_flag(self.fmi)

    @property
    def state_flags(self) -> tuple[str, str]:
        """Names of the capability flags of saving and of serializing the state."""
        return state_flags(self.fmi)

    @property
    def discrete_states(self) -> tuple[str, ...]:
        """Names of the discrete states: they are set at the start and change at events."""
        return tuple(
            v.name
            for v in self.variables.values()
            if v.causality in ("output", "local") and v.variability == "discrete" and v.initial == "exact"
        )


@accepts(file=kinds.path, limits=kinds.one_of_class(ArchiveLimits, "ArchiveLimits(…)"))
def read_description(
    file: str | os.PathLike[str], sizes: Mapping[str, int] | None = None, *, limits: ArchiveLimits | None = None
) -> FmuDescription:
    """Read and check an FMU, without loading its library.

    Parameters
    ----------
    file : str or PathLike
        The FMU.
    sizes : mapping, optional
        Values of structural parameters, on which the shapes of arrays depend; others have their start values.
    limits : ArchiveLimits, optional
        Limits of its size; the usual ones without it.

    Raises
    ------
    FmuFileError
        If the file is missing, is no FMU, has neither co-simulation nor model exchange of FMI 1.0 to 3.0, or no binary
        for this platform; if its archive is unsafe, damaged or beyond the limits. Its ``fault`` is an `FmuFault`.
    """
    return find_description(file, sizes, limits)


def find_description(
    file: str | os.PathLike[str], sizes: Mapping[str, int] | None, limits: ArchiveLimits | None
) -> FmuDescription:
    """Return what `read_description` returns, in a fraction of the time: a run's blocks ask often, and rightly."""
    path = os.fspath(file)  # pathlib would take most of the time
    if path.startswith("~"):
        path = os.path.expanduser(path)
    if not _is_absolute(path):
        with FOLDER:  # another thread may load a library, which takes place in its folder
            try:
                path = os.path.abspath(path)
            except OSError as error:
                raise _unreadable(path, error) from error
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        status = None
    except OSError as error:
        raise _unreadable(path, error) from error
    if status is None or not stat.S_ISREG(status.st_mode):
        shown = str(Path(os.path.expanduser(os.fspath(file))))
        found = f"{shown!r} is a folder" if os.path.isdir(path) else f"there is no file {shown!r}"
        folder = (
            ""
            if _is_absolute(os.fspath(file))
            else f" It is relative to the working folder, {os.path.dirname(path)!r}."
        )
        raise FmuFileError(f"{found}; expected an FMU. Check the path.{folder}", fault=FmuFault.NO_FILE)
    identity = (status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size)
    return _read(path, identity, limits or _USUAL, _key_of(sizes) if sizes else ())


_is_absolute = lru_cache(maxsize=256)(os.path.isabs)


def _unreadable(path: str, error: OSError) -> FmuFileError:
    found = describe_disk_error(error, path, OTHER_PLACE)
    return FmuFileError(f"{path!r} can't be read: {found}", fault=FmuFault.NO_FILE)


def kept_description(digest: str, sizes: Mapping[str, int] | None) -> FmuDescription | None:
    """Return a description that is in memory, by the file's SHA-256, without a look at the file; None if none is."""
    return _KEPT.get((digest, _key_of(sizes)))


def _key_of(sizes: Mapping[str, int] | None) -> tuple[tuple[str, int], ...]:
    return tuple(sorted(sizes.items())) if sizes else ()


_KEPT: weakref.WeakValueDictionary[tuple[str, tuple[tuple[str, int], ...]], FmuDescription]
_KEPT = weakref.WeakValueDictionary()
_USUAL = ArchiveLimits()


@lru_cache(maxsize=256)
def _read(
    place: str, identity: tuple[int, ...], limits: ArchiveLimits, sizes: tuple[tuple[str, int], ...]
) -> FmuDescription:
    path = Path(place).resolve()
    archive = FmuArchive.open(path, limits)
    entries, text = set(archive.files), archive.description()
    root = parse_xml(path, DESCRIPTION, text)
    version = root.get("fmiVersion", "2.0")  # without one, it is no description, as its reading says
    if not re.fullmatch(KNOWN_VERSIONS, version):
        raise unknown_version(path, version)
    model, complaints = read_model(path, text, root, limits)
    interface = model.coSimulation or model.modelExchange
    if interface is None:
        raise FmuFileError(
            f"{str(path)!r} has neither a co-simulation nor a model-exchange interface; export it with one of them.",
            fault=FmuFault.INTERFACE,
        )
    identifier = interface.modelIdentifier
    binary = find_binary(path, entries, version, identifier)
    try:
        if sizes:
            resize(model, dict(sizes))
            check_dimensions(path, model, limits)
        found = _read_variables(path, entries, root, model)
    except FmuFileError:
        raise
    except Exception as error:  # of a description that breaks its own rules
        raise FmuFileError(
            f"the {DESCRIPTION} of {str(path)!r} can't be read: {type(error).__name__}: {error}. "
            f"{''.join(f'{complaint} ' for complaint in complaints[:3])}Export it again.",
            fault=FmuFault.DESCRIPTION,
            subject=DESCRIPTION,
        ) from error
    findings = (*archive.findings, *judge_name(binary, identifier), *judge_negated(found["other"].values()))
    made = FmuDescription(
        version,
        path,
        archive.digest,
        model.modelName,
        identifier,
        model.instantiationToken or "",
        binary,
        complaints=complaints,
        limits=limits,
        findings=findings,
        generation_tool=root.get("generationTool", ""),
        model_version=root.get("version", ""),
        **found,
    )
    _KEPT[made.digest, sizes] = made
    return made


def _read_variables(path: Path, entries: set[str], root: Any, model: Any) -> dict[str, Any]:
    """Return the variables, states and capabilities of an FMU, as arguments of its description."""
    version = model.fmiVersion
    flags = read_co_simulation(root, version)
    if model.modelExchange is not None:
        with suppress(FmuFileError):  # without a library for this platform it is as good as none
            binary = find_binary(path, entries, version, model.modelExchange.modelIdentifier)
            flags["exchange"] = read_model_exchange(root, model, binary)
    flags["co_simulation"] = model.coSimulation is not None
    dropped, units = _dropped_attributes(root), FmuUnits({u.name: u for u in model.unitDefinitions})
    scalars, other, negated = {}, {}, read_negated(root, model)
    for v in model.modelVariables:
        if v.causality == "independent" or v.name in scalars or v.name in other:  # a local of a name that is taken
            continue
        if v.name in negated:
            other[v.name] = negated[v.name]
        elif fmi3_type(v.type) in WIRE_TYPES:
            try:
                scalars[v.name] = read_variable(v, dropped.get(v.name, {}), units)
            except ValueError as error:
                raise FmuFileError(
                    f"the variable {v.name!r} of {str(path)!r} has {error}. Export it again.",
                    fault=FmuFault.DESCRIPTION,
                    subject=v.name,
                ) from error
        else:
            other[v.name] = read_other(v, dropped.get(v.name, {}))
    variables, elements, _ = gather(scalars, frozenset(other))
    derivatives = read_derivatives(model)
    states, order = find_states(derivatives, scalars, variables, elements)
    variables, aliases = find_aliases(variables)
    return {
        "variables": variables,
        "other": other,
        "elements": elements,
        "scalars": scalars,
        "derivatives": derivatives,
        "aliases": aliases,
        "dependencies": read_dependencies(model.outputs),
        "states": states,
        "state_order": order,
        "unit_complaints": tuple(units.complaints),
        **flags,
    }


def _dropped_attributes(root: Any) -> dict[str, Mapping[str, str]]:
    """Return attributes that FMPy drops, by the variable's name: bounds of unsigned integers, intervals of clocks."""
    tags = " or ".join(f"starts-with(name(), '{kind}')" for kind in _DROPPED)
    found: dict[str, Mapping[str, str]] = {}
    for element in root.xpath(
        f"ModelVariables/*[{tags} or @relativeQuantity or @intermediateUpdate or Real/@relativeQuantity]"
    ):
        inner = element.find("Real")  # of FMI 2.0
        found[element.get("name", "")] = (element if inner is None else inner).attrib
    return found
