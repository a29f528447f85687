"""FMUs under a C program that calls every function of FMI in every state (``walks/``), with the sanitizers.

The program is compiled together with the FMU's own sources, and with the numbers of its description (``facts.h``).
"""

import os
import shutil
import subprocess
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

from loopwright.fmus.export.fmu_package import fmi_headers

WALKS = Path(__file__).parent / "walks"
FLAGS = [
    "-g",
    "-O1",
    "-std=gnu11",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
]
TWO = {
    "canGetAndSetFMUState": "canGetAndSetFMUstate",
    "providesDirectionalDerivatives": "providesDirectionalDerivative",
}


def walk(file, folder):
    """Compile the walk with an FMU's sources, run it, and return what it has printed."""
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("the sanitizers are those of gcc")
    folder.mkdir(exist_ok=True)
    with zipfile.ZipFile(file) as archive:
        archive.extractall(folder)
    tree = ElementTree.parse(folder / "modelDescription.xml").getroot()
    fmi = int(tree.get("fmiVersion")[0])
    (folder / "facts.h").write_text(_facts(tree, fmi), encoding="utf-8")
    sources = [str(folder / "sources" / "model.c"), str(WALKS / f"walk{fmi}.c")]
    include = [f"-I{path}" for path in (folder / "sources", folder, WALKS, fmi_headers()[0])]
    program = str(folder / "walk")
    done = subprocess.run(
        [gcc, *FLAGS, *include, *sources, "-lm", "-o", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    done = subprocess.run(
        [program], capture_output=True, text=True, check=False, env=os.environ | {"ASAN_OPTIONS": "detect_leaks=1"}
    )
    assert "runtime error" not in done.stderr, done.stderr
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout.splitlines()[-1]


def _facts(tree, fmi):
    """Return the numbers of a description that the walk needs, as C text."""
    elements = list(tree.find("ModelVariables"))
    scalars = [e[0] if fmi == 2 else e for e in elements]
    references = [int(e.get("valueReference")) for e in elements]
    sizes = [_size(e) if fmi == 3 else 1 for e in elements]
    states = {int(one.get("derivative")) - (fmi == 2) for one in scalars if one.get("derivative")}
    if fmi == 2:
        states = {references[i] for i in states}
    stepped, exchanged = tree.find("CoSimulation"), tree.find("ModelExchange")
    flag = "providesDirectionalDerivatives"

    def first(name, holds):
        found = [i for i, e in enumerate(elements) if e.tag != "Clock" and holds(e, references[i])]
        if not found:
            missing.append(name)
            return 0, 1
        return references[found[0]], sizes[found[0]]

    missing = []
    chosen = {
        "TIME": first("time", lambda e, vr: e.get("causality") == "independent"),
        "FIXED": first("fixed", lambda e, vr: e.get("causality") == "parameter" and e.get("variability") == "fixed"),
        "TUNABLE": first("tunable", lambda e, vr: e.get("variability") == "tunable"),
        "INPUT": first("input", lambda e, vr: e.get("causality") == "input"),
        "STATE": first(
            "state",
            lambda e, vr: vr in states or (e.get("causality") == "local" and e.get("initial") == "exact"),
        ),
        "OUTPUT": first("output", lambda e, vr: e.get("causality") == "output"),
    }
    clocks = [e for e in elements if e.tag == "Clock"]
    due = [float(c.get("shiftDecimal", 0)) for c in clocks]
    numbers = {
        "N_X": sum(size for vr, size in zip(references, sizes, strict=True) if vr in states)
        if exchanged is not None
        else 0,
        "N_Z": len(tree.findall("ModelStructure/EventIndicator"))
        if fmi == 3
        else int(tree.get("numberOfEventIndicators") or 0),
        "N_CLOCKS": len(clocks),
        "VR_CLOCK": clocks[0].get("valueReference") if clocks else 0,
        "DUE_AT_START": int(bool(clocks) and due[0] == 0.0),
        "HAS_EVENT_MODE": int(stepped.get("hasEventMode") == "true"),
        "EXCHANGEABLE": int(exchanged is not None),
        "HAS_DERIVATIVES": int(stepped.get(flag if fmi == 3 else TWO[flag]) == "true"),
        "OUTPUT_IS_STATE": int(chosen["OUTPUT"][0] in states),
        "HAS_INPUTS": int("input" not in missing),
        "INTERPOLATES": int(stepped.get("canInterpolateInputs") == "true"),
        "STEP": tree.find("DefaultExperiment").get("stepSize"),
        "MOST": 64 + max(sizes),
        "TOKEN": f'"{tree.get("instantiationToken") or tree.get("guid")}"',
    }
    numbers |= {f"VR_{name}": vr for name, (vr, _) in chosen.items()}
    numbers |= {f"SIZE_{name}": size for name, (_, size) in chosen.items()}
    lines = [f"#define {name} {value}" for name, value in numbers.items()]
    rows = ", ".join(f"{{{c.get('valueReference')}, {d}}}" for c, d in zip(clocks, due, strict=True)) or "{0, 1.0}"
    lines.append(f"static const struct {{ unsigned reference; double shift; }} clocks[] = {{{rows}}};")
    lines.append("static double start_of(long vr, long k) {\n    static const double starts[][65] = {")
    for vr, size, e in zip(references, sizes, scalars, strict=True):
        if (vr, size) in chosen.values():
            values = (e.get("start") or "0").split()
            lines.append(f"        {{{vr}, {', '.join(values[:64])}}},")
    lines.append("    };\n    for (unsigned i = 0; i < sizeof starts / sizeof *starts; i++)")
    lines.append("        if (starts[i][0] == (double)vr) return k < 64 ? starts[i][1 + k] : 0.0;\n    return 0.0;\n}")
    tests = " || ".join(f'strstr(name, "({name})")' for name in missing) or "0"
    if "input" in missing:
        tests += ' || strstr(name, "Derivative(") || strstr(name, "AdjointDerivative") || strstr(name, "DirectionalDerivative")'
        tests += ' || !strcmp(name, "setFloat64(NaN)") || !strcmp(name, "setFloat64(NULL)")'
        tests += ' || !strcmp(name, "setReal(NaN)") || !strcmp(name, "setReal(NULL)")'
    lines.append(f"#include <string.h>\nstatic int skips(const char *name) {{ return (void)name, {tests}; }}")
    return "\n".join(lines) + "\n"


def _size(element):
    size = 1
    for dimension in element.findall("Dimension"):
        size *= int(dimension.get("start"))
    return size
