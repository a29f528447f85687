"""FMUs of both versions with variables of all types: each output is the input of its type, after a step.

Value reference k is an input or a parameter, k + 50 the output that follows it. A text sets the Int32 output 90 to its
length. In FMI 3.0, Int64 91 is 2**53 + 1. The C sources know nothing of Loopwright.
"""

import zipfile

import fmpy.fmi2
import fmpy.fmi3

from loopwright.fmus.export.compiler import compile_shared
from loopwright.fmus.platform import native_platform

_C3 = {
    "Float64": "double",
    "Float32": "float",
    "Int8": "int8_t",
    "UInt8": "uint8_t",
    "Int16": "int16_t",
    "UInt16": "uint16_t",
    "Int32": "int32_t",
    "UInt32": "uint32_t",
    "Int64": "int64_t",
    "UInt64": "uint64_t",
    "Boolean": "bool",
}
_C2 = {"Real": "double", "Integer": "int", "Boolean": "int"}
_OTHER3 = ("Clock", "Binary")

_HEAD = """
#include <stdint.h>
#include <stdlib.h>
#include <stdbool.h>
#include <string.h>
#include <stddef.h>
#define SIZE(vr) ((vr) == 20 || (vr) == 70 ? 3 : 1)
typedef struct { int running; MEMBERS } instance;
static void follow(instance *c) { FOLLOW }
"""
_VALUES3 = """
int fmi3GetT(void *p, const unsigned vr[], size_t n, C v[], size_t nv) {
    instance *c = p; size_t at = 0;
    for (size_t i = 0; i < n; i++) for (size_t k = 0; k < SIZE(vr[i]); k++) v[at++] = c->vT[vr[i] + k];
    return at == nv ? 0 : 3;
}
int fmi3SetT(void *p, const unsigned vr[], size_t n, const C v[], size_t nv) {
    instance *c = p; size_t at = 0;
    for (size_t i = 0; i < n; i++) for (size_t k = 0; k < SIZE(vr[i]); k++) c->vT[vr[i] + k] = v[at++];
    if (!c->running) follow(c);
    return at == nv ? 0 : 3;
}
"""
_VALUES2 = """
int fmi2GetT(void *p, const unsigned vr[], size_t n, C v[]) {
    instance *c = p;
    for (size_t i = 0; i < n; i++) v[i] = c->vT[vr[i]];
    return 0;
}
int fmi2SetT(void *p, const unsigned vr[], size_t n, const C v[]) {
    instance *c = p;
    for (size_t i = 0; i < n; i++) c->vT[vr[i]] = v[i];
    if (!c->running) follow(c);
    return 0;
}
"""
_REST3 = """
const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateCoSimulation() {
    instance *c = calloc(1, sizeof(instance)); c->vFloat64[30] = 2.5; return c; }
void fmi3FreeInstance(void *p) { free(p); }
int fmi3EnterInitializationMode() { return 0; }
int fmi3ExitInitializationMode(void *p) { ((instance *)p)->running = 1; return 0; }
int fmi3Terminate() { return 0; }
int fmi3Reset(void *p) { ((instance *)p)->running = 0; return 0; }
int fmi3SetString(void *p, const unsigned vr[], size_t n, const char *v[], size_t nv) {
    ((instance *)p)->vInt32[90] = (int)strlen(v[0]); return 0; }
int fmi3DoStep(void *p, double t, double h, bool final, bool *event, bool *terminate, bool *early, double *last) {
    follow(p); *event = *terminate = *early = false; *last = t + h; return 0; }
"""
_REST2 = """
const char *fmi2GetVersion(void) { return "2.0"; }
void *fmi2Instantiate() { instance *c = calloc(1, sizeof(instance)); c->vReal[30] = 2.5; return c; }
void fmi2FreeInstance(void *p) { free(p); }
int fmi2SetupExperiment() { return 0; }
int fmi2EnterInitializationMode() { return 0; }
int fmi2ExitInitializationMode(void *p) { ((instance *)p)->running = 1; return 0; }
int fmi2Terminate() { return 0; }
int fmi2Reset(void *p) { ((instance *)p)->running = 0; return 0; }
int fmi2SetString(void *p, const unsigned vr[], size_t n, const char *v[]) {
    ((instance *)p)->vInteger[90] = (int)strlen(v[0]); return 0; }
int fmi2DoStep(void *p, double t, double h, int final) { follow(p); return 0; }
"""


def source(fmi, complete=False):
    """Return the C source; complete with functions that only fail, for FMPy, which asks for all of them."""
    types, values, rest = (_C3, _VALUES3, _REST3) if fmi == 3 else (_C2, _VALUES2, _REST2)
    members = " ".join(f"{c} v{t}[100];" for t, c in types.items())
    follow = " ".join(f"for (int i = 0; i < 40; i++) c->v{t}[i + 50] = c->v{t}[i];" for t in types)
    follow += " c->vInt64[91] = INT64_C(9007199254740993);" if fmi == 3 else ""
    head = _HEAD.replace("MEMBERS", members).replace("FOLLOW", follow)
    functions = "".join(
        values.replace(" C ", f" {c} ")
        .replace("vT", f"v{t}")
        .replace(f"fmi{fmi}GetT", f"fmi{fmi}Get{t}")
        .replace(f"fmi{fmi}SetT", f"fmi{fmi}Set{t}")
        for t, c in types.items()
    )
    text = head + functions + rest
    if complete:
        kind = fmpy.fmi3.FMU3Slave if fmi == 3 else fmpy.fmi2.FMU2Slave
        names = [n for n in dir(kind) if n.startswith(f"fmi{fmi}") and f"{n}(" not in text]
        text += "".join(f"int {name}() {{ return 3; }}\n" for name in names)
    return (
        text.replace("\nint fmi", '\n__attribute__((visibility("default"))) int fmi')
        .replace("\nvoid", '\n__attribute__((visibility("default"))) void')
        .replace("\nconst char", '\n__attribute__((visibility("default"))) const char')
    )


_NAMES3 = [*_C3, "Enumeration"]
_VECTOR = (
    '<Int16 name="{name}" valueReference="{reference}" causality="{causality}" variability="discrete"{start}>'
    '<Dimension valueReference="99"/></Int16>'
)
_LEVELS = '<Item name="low" value="1"/><Item name="high" value="3"/>'


def description3(more=""):
    """Return a description of FMI 3.0: u_<type> and y_<type>, a vector of Int16, two parameters, a text, a clock."""
    rows = ['<Float64 name="time" valueReference="98" causality="independent" variability="continuous"/>']
    for i, t in enumerate(_NAMES3):
        for prefix, causality, k in (("u", "input", i), ("y", "output", i + 50)):
            start = f' start="{1 if t == "Enumeration" else "false" if t == "Boolean" else 0}"' * (prefix == "u")
            kind = "continuous" if t.startswith("Float") else "discrete"
            declared = ' declaredType="Level"' if t == "Enumeration" else ""
            limit = ' max="200"' * (t == "UInt8")
            rows.append(
                f'<{t} name="{prefix}_{t}" valueReference="{k}" causality="{causality}" variability="{kind}"'
                f"{declared}{limit}{start}/>"
            )
    # value references are unique over all types, but storage is by type: these go beside those of the loop
    rows += [
        '<UInt64 name="n" valueReference="99" causality="structuralParameter" variability="fixed" start="3"/>',
        _VECTOR.format(name="u_vector", reference=20, causality="input", start=' start="0 0 0"'),
        _VECTOR.format(name="y_vector", reference=70, causality="output", start=""),
        '<Float64 name="gain" valueReference="30" causality="parameter" variability="tunable" start="2.5" min="0"/>',
        '<Float64 name="inner" valueReference="80" causality="local" variability="continuous"/>',
        '<Float64 name="fixed" valueReference="31" causality="parameter" variability="fixed" start="1"/>',
        '<String name="path" valueReference="40" causality="parameter" variability="fixed"><Start value="abc"/></String>',
        '<Int32 name="length" valueReference="90" causality="output" variability="discrete"/>',
        '<Binary name="blob" valueReference="41" causality="output" variability="discrete"/>',
        '<Clock name="tick" valueReference="42" causality="input" intervalVariability="triggered"/>',
    ]
    outputs = "".join(f'<Output valueReference="{k}"/>' for k in (*range(50, 50 + len(_NAMES3)), 70, 90, 41))
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="3.0" modelName="typed" '
        'instantiationToken="x"><CoSimulation modelIdentifier="typed"/><TypeDefinitions><EnumerationType name="Level">'
        f"{_LEVELS}</EnumerationType></TypeDefinitions><ModelVariables>{''.join(rows)}{more}</ModelVariables>"
        f"<ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
    )


def description2():
    """Return a description of FMI 2.0: u_<type> and y_<type>, a vector of Integer, a parameter, a text."""
    rows = []

    def add(name, k, causality, variability, inner, more=""):
        rows.append(
            f'<ScalarVariable name="{name}" valueReference="{k}" causality="{causality}" '
            f'variability="{variability}"{more}>{inner}</ScalarVariable>'
        )

    kinds = {
        "Real": ("continuous", "", "0"),
        "Integer": ("discrete", "", "0"),
        "Boolean": ("discrete", "", "false"),
        "Enumeration": ("discrete", ' declaredType="Level"', "1"),
    }
    for i, (t, (kind, declared, start)) in enumerate(kinds.items()):
        add(f"u_{t}", i, "input", kind, f'<{t}{declared} start="{start}"/>')
        add(f"y_{t}", i + 50, "output", kind, f"<{t}{declared}/>")
    for i in range(3):
        add(f"u_vector[{i}]", 20 + i, "input", "discrete", '<Integer start="0"/>')
        add(f"y_vector[{i}]", 70 + i, "output", "discrete", "<Integer/>")
    add("gain", 30, "parameter", "tunable", '<Real start="2.5" min="0"/>')
    add("inner", 80, "local", "continuous", "<Real/>")
    add("fixed", 31, "parameter", "fixed", '<Real start="1"/>')
    add("path", 40, "parameter", "fixed", '<String start="abc"/>')
    add("length", 90, "output", "discrete", "<Integer/>")
    outputs = [i + 1 for i, row in enumerate(rows) if 'causality="output"' in row]
    unknowns = "".join(f'<Unknown index="{i}"/>' for i in outputs)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription fmiVersion="2.0" modelName="typed" guid="x">'
        '<CoSimulation modelIdentifier="typed"/><TypeDefinitions><SimpleType name="Level"><Enumeration>'
        f"{_LEVELS}</Enumeration></SimpleType></TypeDefinitions><ModelVariables>{''.join(rows)}</ModelVariables>"
        f"<ModelStructure><Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure>"
        "</fmiModelDescription>"
    )


def typed_fmu(folder, fmi, text=None, *, complete=False, change=None):
    """Build the FMU of a version into a folder, and return its path; a change replaces one text of the source."""
    library = folder / f"typed{fmi}{complete}.so"
    if change is not None:
        library = folder / f"typed{fmi}_{len(list(folder.iterdir()))}.so"
        assert change[0] in source(fmi, complete)
    if not library.exists():
        compile_shared({"typed.c": source(fmi, complete).replace(*(change or ("\0", "")))}, library)
    path = folder / f"typed{fmi}_{len(list(folder.iterdir()))}.fmu"
    platform = native_platform() if fmi == 3 else {"x86_64-linux": "linux64"}.get(native_platform(), native_platform())
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            zipfile.ZipInfo("modelDescription.xml"), text or (description3() if fmi == 3 else description2())
        )
        archive.writestr(zipfile.ZipInfo(f"binaries/{platform}/typed.so"), library.read_bytes())
    return path
