"""Small FMUs for one behaviour each: C sources that know nothing of Loopwright, and descriptions written by hand.

A source holds the functions that matter; those that a co-simulation FMU needs beside them are added, and succeed. Its
instance is ``struct instance`` with at least ``double t``. Libraries are compiled once for each content.
"""

import hashlib
import zipfile

from loopwright.fmus.export.compiler import compile_shared
from loopwright.fmus.platform import native_platform

_HEAD = """
#include <fenv.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#pragma GCC visibility push(default)
"""
_COMMON = {
    "GetVersion": 'const char *NAME(void) { return "VERSION"; }',
    "EnterInitializationMode": "int NAME() { return 0; }",
    "ExitInitializationMode": "int NAME() { return 0; }",
    "Terminate": "int NAME() { return 0; }",
    "Reset": "int NAME(void *p) { memset(p, 0, sizeof(instance)); return 0; }",
    "FreeInstance": "void NAME(void *p) { free(p); }",
}
_OF = {
    "fmi3": _COMMON | {"InstantiateCoSimulation": "void *NAME() { return calloc(1, sizeof(instance)); }"},
    "fmi2": _COMMON
    | {
        "Instantiate": "void *NAME() { return calloc(1, sizeof(instance)); }",
        "SetupExperiment": "int NAME() { return 0; }",
    },
    "fmi1": {
        "GetVersion": _COMMON["GetVersion"],
        "InstantiateSlave": "void *NAME() { return calloc(1, sizeof(instance)); }",
        "InitializeSlave": "int NAME() { return 0; }",
        "TerminateSlave": "int NAME() { return 0; }",
        "ResetSlave": _COMMON["Reset"],
        "FreeSlaveInstance": _COMMON["FreeInstance"],
    },
}
_VERSIONS = {"fmi3": "3.0", "fmi2": "2.0", "fmi1": "1.0"}
GET, SET = (
    """
int {prefix}{verb}{suffix}(void *p, const unsigned vr[], size_t n, {const}{type} v[]{size}) {{
    instance *c = p; (void)c;
    for (size_t i = 0; i < n; i++) switch (vr[i]) {{ {cases} default: return 3; }}
    return 0;
}}
"""
    for _ in range(2)
)


def values(prefix, verb, suffix, type_, cases):
    """Return the function that gets or sets scalars; ``cases`` maps value references to expressions on ``c``."""
    way = "v[i] = {};" if verb == "Get" else "{} = v[i];"
    text = " ".join(f"case {k}: {way.format(expression)} break;" for k, expression in cases.items())
    size = ", size_t nv" if prefix == "fmi3" else ""
    const = "const " if verb == "Set" else ""
    return GET.format(prefix=prefix, verb=verb, suffix=suffix, type=type_, cases=text, const=const, size=size)


def small_fmu(folder, prefix, source, description, *, name="small", states=0, indicators=0):
    """Build an FMU into a folder, and return its path.

    ``source`` begins with the definition of ``instance``; ``description`` is the content of ``fmiModelDescription``
    after its attributes. ``states`` and ``indicators`` are their numbers in FMI 1.0, where attributes state them.
    """
    more = "".join(
        f"{text.replace('NAME', prefix + end).replace('VERSION', _VERSIONS[prefix])}\n"
        for end, text in _OF[prefix].items()
        if f"{prefix}{end}(" not in source
    )
    text = f"{_HEAD}{source}\n{more}"
    if prefix == "fmi1":  # names begin with the model identifier
        text = text.replace("fmi1", f"{name}_fmi")
    library = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.so"
    if not library.exists():
        compile_shared({"small.c": text}, library)
    token = "instantiationToken" if prefix == "fmi3" else "guid"
    more = f' modelIdentifier="{name}" numberOfContinuousStates="{states}" numberOfEventIndicators="{indicators}"'
    more *= prefix == "fmi1"
    xml = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="{_VERSIONS[prefix]}" '
        f'modelName="{name}" {token}="x"{more}>{description}</fmiModelDescription>'
    )
    here = native_platform()
    platform = here if prefix == "fmi3" else {"x86_64-linux": "linux64"}.get(here, here)
    path = folder / f"{name}_{hashlib.sha256((text + xml).encode()).hexdigest()[:8]}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("modelDescription.xml"), xml)
        archive.writestr(zipfile.ZipInfo(f"binaries/{platform}/{name}.so"), library.read_bytes())
    return path
