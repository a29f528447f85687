"""Binaries of exported FMUs for other platforms, in an emulator of their processor: the bits of this machine's."""

import ctypes
import importlib
import zipfile

import numpy as np
import pytest

from loopwright.fmus.export import compile_shared
from loopwright.fmus.models import gantry_contact, scara
from loopwright.fmus.platform import native_platform
from loopwright.fmus.toolchain import SUFFIXES, TARGETS
from support import elementary

if native_platform() != "x86_64-linux":
    pytest.skip("calls from emulated code are those of x86_64-linux", allow_module_level=True)
emulated = importlib.import_module("support.emulated")  # here, as the emulator installs for that platform alone
OTHERS = [name for name in TARGETS if name != "x86_64-linux"]


def same_functions(platform, folder, n):
    """Hold elementary functions of both processors against each other, for whole ranges of arguments."""
    texts = {"all.c": elementary.source(), "elementary.c": elementary.RUNTIME.read_text("utf-8")}
    here, there = folder / "here", folder / "there"
    compile_shared(texts, here, compiled=["all.c"])
    compile_shared(texts, there, compiled=["all.c"], platform=platform)
    first, second = ctypes.CDLL(str(here)), emulated.Library(emulated.Processor(platform), there)
    rng = np.random.default_rng(20)
    special = np.array([0.0, -0.0, 1.0, -1.0, 5e-324, -1e-310, np.inf, -np.inf, np.nan, 1e308, -745.2, 709.9])
    for name in elementary.FUNCTIONS:
        given = elementary.powers(n, rng) if name == "pow" else ((x, x) for x in elementary.arguments(name, n, rng))
        for x, z in [*given, (special, special[::-1].copy())]:
            y, found = np.empty_like(x), np.empty_like(x)
            for library, out in ((first, y), (second, found)):
                pointers = [ctypes.c_void_p(a.ctypes.data) for a in (x, z, out)]
                library[f"many_{name}"](*pointers, ctypes.c_longlong(x.size))
            number = ~np.isnan(y)  # a NaN's sign and payload are the processor's
            assert np.array_equal(np.isnan(found), ~number)
            assert y[number].tobytes() == found[number].tobytes(), name


@pytest.mark.slow
@pytest.mark.parametrize("platform", OTHERS)
def test_elementary_functions_have_the_same_bits_everywhere(platform, tmp_path):
    same_functions(platform, tmp_path, 2000)


def motion(library, token, inputs, outputs, steps):
    """Step an FMU of FMI 3.0 by 1 ms with inputs that change; give its outputs after each step."""
    make = library["fmi3InstantiateCoSimulation"]
    make.restype = ctypes.c_void_p
    texts = [ctypes.create_string_buffer(text.encode()) for text in ("name", token, "file:///")]
    nothing, no, yes = ctypes.c_void_p(None), ctypes.c_bool(False), ctypes.c_bool(True)
    flags = (no, no, no, no)
    instance = ctypes.c_void_p(make(*texts, *flags, nothing, ctypes.c_size_t(0), nothing, nothing, nothing))
    assert instance.value

    def call(name, *arguments):
        function = library[f"fmi3{name}"]
        function.restype = ctypes.c_int
        assert function(instance, *arguments) == 0, name

    def transfer(name, references, values):
        vr = np.array(references, dtype=np.uint32)
        n = ctypes.c_size_t(vr.size)
        call(name, ctypes.c_void_p(vr.ctypes.data), n, ctypes.c_void_p(values.ctypes.data), n)

    call("EnterInitializationMode", no, ctypes.c_double(0.0), ctypes.c_double(0.0), no, ctypes.c_double(0.0))
    call("ExitInitializationMode")
    said, rows = (ctypes.c_bool * 3)(), np.zeros((steps, len(outputs)))
    reached = ctypes.c_double()
    pointers = [ctypes.c_void_p(ctypes.addressof(said) + i) for i in range(3)]
    for k in range(steps):
        transfer("SetFloat64", inputs, 0.3 * np.cos(0.05 * k + np.arange(len(inputs))))
        time, width = ctypes.c_double(k * 1e-3), ctypes.c_double(1e-3)
        call("DoStep", time, width, yes, *pointers, ctypes.byref(reached))
        transfer("GetFloat64", outputs, rows[k])
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("model", [gantry_contact, scara], ids=["gantry_contact", "scara"])
def test_fmus_have_the_same_bits_everywhere(model, tmp_path):
    """The files that are shipped: sine, tangent hyperbolic and events within steps."""
    from fmpy import read_model_description

    path = model.build(platform="all", arrays=False, out=tmp_path / "model.fmu")
    description = read_model_description(str(path))
    of = {
        kind: [int(v.valueReference) for v in description.modelVariables if v.causality == kind and not v.dimensions]
        for kind in ("input", "output")
    }
    found = {}
    with zipfile.ZipFile(path) as archive:
        for platform in TARGETS:
            name = description.coSimulation.modelIdentifier + SUFFIXES[platform.split("-")[1]]
            out = tmp_path / f"{platform}-{name}"
            out.write_bytes(archive.read(f"binaries/{platform}/{name}"))
            other = platform != native_platform()
            library = emulated.Library(emulated.Processor(platform), out) if other else ctypes.CDLL(str(out))
            found[platform] = motion(library, description.instantiationToken, of["input"], of["output"], 300)
    assert np.ptp(found[native_platform()], axis=0).max() > 1e-4
    assert {values.tobytes() for values in found.values()} == {found[native_platform()].tobytes()}
