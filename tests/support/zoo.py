"""Hostile FMUs: one compiled library for each version of FMI, and one fault in each, which is written over a text in it.

The block is y' = u from y = 0, so that with u = 1 its output is the time; it can save its state.
"""

import zipfile
from pathlib import Path

from loopwright.fmus.export.compiler import compile_shared
from loopwright.fmus.platform import native_platform

_PLACE = b"@" * 64
_STATES = 'canGetAndSetFMUState="true" canHandleVariableCommunicationStepSize="true"'
_DESCRIPTIONS = {
    3: f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="zoo" instantiationToken="zoo">
  <ModelExchange modelIdentifier="zoo"/>
  <CoSimulation modelIdentifier="zoo" {_STATES}/>
  <ModelVariables>
    <Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>
    <Float64 name="u" valueReference="1" causality="input" start="0"/>
    <Float64 name="y" valueReference="2" causality="output" initial="exact" start="0"/>
    <Float64 name="p" valueReference="3" causality="parameter" variability="fixed" start="1"/>
    <Float64 name="der(y)" valueReference="4" derivative="2"/>
    <Float64 name="z" valueReference="5"/>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="2"/>
    <ContinuousStateDerivative valueReference="4"/>
    <InitialUnknown valueReference="4"/>
    <EventIndicator valueReference="5"/>
  </ModelStructure>
</fmiModelDescription>
""",
    2: f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="zoo" guid="zoo" numberOfEventIndicators="1">
  <ModelExchange modelIdentifier="zoo"/>
  <CoSimulation modelIdentifier="zoo" {_STATES.replace("FMUState", "FMUstate")}/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="1" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="2" causality="output" initial="exact"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="p" valueReference="3" causality="parameter" variability="fixed"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="der(y)" valueReference="4"><Real derivative="2"/></ScalarVariable>
    <ScalarVariable name="z" valueReference="5"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="2"/></Outputs>
    <Derivatives><Unknown index="4"/></Derivatives>
    <InitialUnknowns><Unknown index="4"/></InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
""",
}


def zoo_library(folder, fmi):
    """Return the bytes of the library of a version, without a fault; it is compiled once."""
    library = Path(folder) / f"zoo{fmi}.so"
    if not library.exists():
        text = Path(__file__).with_suffix(".c").read_text()
        compile_shared({"zoo.c": f"#define FMI {fmi}\n{text}"}, library)
    return library.read_bytes()


def zoo_fmu(folder, fmi, fault="", *, missing="", keep=1.0):
    """Write an FMU with a fault, "place fault time"; without a function, or with a part of its library only."""
    data = zoo_library(folder, fmi)
    text = fault.encode()
    assert len(text) < len(_PLACE)
    assert data.count(_PLACE) == 1
    data = data.replace(_PLACE, text.ljust(len(_PLACE), b"\0"))
    if missing:  # its name in the table of symbols gets another last letter
        name = f"fmi{fmi}{missing}\0".encode()
        assert name in data
        data = data.replace(name, name[:-2] + b"_\0")
    platform = native_platform()
    if fmi == 2:
        platform = {"x86_64-linux": "linux64", "x86_64-darwin": "darwin64"}.get(platform, platform)
    slug = "_".join((fault or "sound").replace(".", "").split()) + f"_{missing}" * bool(missing)
    path = Path(folder) / f"{slug}_{fmi}_{round(100 * keep)}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("modelDescription.xml"), _DESCRIPTIONS[fmi])
        archive.writestr(zipfile.ZipInfo(f"binaries/{platform}/zoo.so"), data[: round(keep * len(data))])
    return path
