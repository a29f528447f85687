"""FMU files: their archive and description, read, checked and unpacked; the archives of SSPs, too."""

from .archive_limits import ArchiveLimits
from .binaries import check_binary, missing_functions
from .description import FmuDescription, find_description, kept_description, read_description
from .faults import FmuFault, FmuFinding, FmuSeverity
from .fmpy_description import read_model, repair
from .gathering import read_index
from .interfaces import ModelExchangeInfo
from .joining import join_scalars
from .library_headers import SharedLibrary, read_library
from .parsed_xml import parse_xml
from .unit_definitions import FmuUnits
from .unpacking import unpack, unpack_archive, write_files
from .variables import FmuVariable, OtherVariable, inexact
from .zip_file import BUILD_DESCRIPTION, DESCRIPTION, FmuArchive

__all__ = [
    "BUILD_DESCRIPTION",
    "DESCRIPTION",
    "ArchiveLimits",
    "FmuArchive",
    "FmuDescription",
    "FmuFault",
    "FmuFinding",
    "FmuSeverity",
    "FmuUnits",
    "FmuVariable",
    "ModelExchangeInfo",
    "OtherVariable",
    "SharedLibrary",
    "check_binary",
    "find_description",
    "inexact",
    "join_scalars",
    "kept_description",
    "missing_functions",
    "parse_xml",
    "read_description",
    "read_index",
    "read_library",
    "read_model",
    "repair",
    "unpack",
    "unpack_archive",
    "write_files",
]
