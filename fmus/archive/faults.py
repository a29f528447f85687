"""Kinds of faults of FMU files, and findings about them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from ...blocks.core import explain_calls


class FmuFault(StrEnum):
    """Kind of a fault of an FMU file: the field `fault` of errors (`FmuFileError`) and of findings."""

    # the archive
    NO_FILE = "no file"
    NO_ARCHIVE = "no archive"
    DAMAGED = "damaged archive"
    ENCRYPTED = "encrypted"
    COMPRESSION = "unknown compression"
    UNSAFE_PATH = "path out of the folder"
    BACKSLASH = "backslash in a path"
    LINK = "link"
    TOO_LARGE = "too large"
    TOO_MANY = "too many files"
    RATIO = "compressed beyond the limit"
    OVERLAP = "overlapping files"
    DUPLICATE_FILE = "duplicate file"
    CASE = "names that differ in case"
    # the description
    NO_DESCRIPTION = "no description"
    XML = "no XML"
    ENTITY = "XML entities"
    DESCRIPTION = "description that breaks its rules"
    VERSION = "unknown version"
    INTERFACE = "no such interface"
    DUPLICATE_NAME = "duplicate variable"
    DUPLICATE_REFERENCE = "duplicate value reference"
    DIMENSION = "impossible dimension"
    EXPERIMENT = "impossible default experiment"
    STANDARD = "violation of the standard"
    NAME = "name with another meaning elsewhere"
    NEGATED = "negated alias"
    # the libraries
    NO_BINARY = "no binary for this platform"
    OTHER_NAME = "library with another name"
    AMBIGUOUS = "several libraries"
    TRUNCATED = "truncated library"
    OTHER_PLATFORM = "library for another platform"
    MISSING_LIBRARY = "missing shared library"
    MISSING_SYMBOL = "missing function"
    UNDEFINED_SYMBOL = "undefined symbol"
    # running
    LOADING = "refused to be loaded or instantiated"
    TOOL = "needs another program"
    PYTHON = "needs Python"
    TRIAL = "failed trial run"


class FmuSeverity(StrEnum):
    """Weight of a finding."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@explain_calls
@dataclass(frozen=True)
class FmuFinding:
    """Fault of an FMU file, or a note on its use.

    Parameters
    ----------
    fault : FmuFault
        Kind of the fault.
    subject : str
        File of the archive, library, function, variable or attribute concerned; empty for the whole FMU.
    found : str
        The fault in a sentence, with its place.
    step : str
        The next step.
    severity : FmuSeverity
        An error keeps the FMU from running here, a warning does not.
    """

    fault: FmuFault
    subject: str
    found: str
    step: str
    severity: FmuSeverity = FmuSeverity.WARNING
