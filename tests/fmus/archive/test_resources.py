"""Folder of an FMU's resources: it is there whenever the FMU gets its place, whatever the archive has of it."""

import shutil
import zipfile

import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from loopwright.fmus.archive import read_description, unpack
from support.careful_fmus import SIMPLE2
from support.small_fmus import small_fmu, values

_STEP = (
    "int fmi2DoStep(void *p, double t, double h, int f) { ((instance *)p)->t = t + h; return 0; }\n"
    + values("fmi2", "Get", "Real", "double", {1: "c->t"})
    + values("fmi2", "Get", "Integer", "int", {2: "0"})
)
# As the FMUs of some tools do, it refuses to start without the folder, empty as it may be.
_SOURCE2 = """
#include <sys/stat.h>
typedef struct { double t; } instance;
static bool is_there(const char *path) { struct stat s; return !stat(path, &s) && S_ISDIR(s.st_mode); }
void *fmi2Instantiate(const char *name, int kind, const char *guid, const char *place) {
    return !strncmp(place, "file:///", 8) && is_there(place + 7) ? calloc(1, sizeof(instance)) : NULL; }
"""
_SOURCE3 = """
#include <sys/stat.h>
typedef struct { double t; } instance;
static bool is_there(const char *path) { struct stat s; return !stat(path, &s) && S_ISDIR(s.st_mode); }
void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *place) {
    return is_there(place) ? calloc(1, sizeof(instance)) : NULL; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    *e = *stop = *early = false; *last = ((instance *)p)->t = t + h; return 0; }
"""
_SOURCE3 += values("fmi3", "Get", "Float64", "double", {1: "c->t"})
_MODEL3 = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables><Float64 name="y" valueReference="1" causality="output"/></ModelVariables>
<ModelStructure><Output valueReference="1"/></ModelStructure>"""


@pytest.mark.parametrize("has_entry", [True, False], ids=["empty", "missing"])
@pytest.mark.parametrize("isolate", [True, False], ids=["apart", "here"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_it_is_there(cache, tmp_path, fmi, isolate, has_entry):
    made = (_SOURCE2 + _STEP, SIMPLE2.format(variable="true", more="")) if fmi == 2 else (_SOURCE3, _MODEL3)
    file = small_fmu(tmp_path, f"fmi{fmi}", *made)
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("resources/" if has_entry else f"documentation/{fmi}{isolate}.txt", "")
    run = Diagram("d", Fmu(file, name="plant", isolate=isolate)()).simulate(0.3, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.y"], run.t, rtol=0, atol=1e-12)
    folder = unpack(read_description(file))
    shutil.rmtree(folder / "resources")  # as an earlier version has left it in the cache
    assert unpack(read_description(file)) == folder
    assert (folder / "resources").is_dir()
    assert len(list(folder.parent.glob("tmp*"))) == 0
