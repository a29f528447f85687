"""C code of compiled runs for other platforms: it is compiled and linked, and emulated processors give the same bits."""

import importlib

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, Product, PythonFunction, Relay, Sine, Sum, TransferFunction
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.compiled import compiled_libraries, functions_between, fused, write_code
from loopwright.diagrams.flat import kinds_of
from loopwright.diagrams.lanes import lane_code
from loopwright.fmus.export.compiler import TARGETS
from loopwright.fmus.platform import native_platform
from loopwright.fmus.runtime import runtime_source

if native_platform() != "x86_64-linux":
    pytest.skip("calls from emulated code are those of x86_64-linux", allow_module_level=True)
emulated = importlib.import_module("support.emulated")  # here, as the emulator installs for that platform alone
QUIET = {"progress": False}
OTHERS = [name for name in TARGETS if name != "x86_64-linux"]
STRICT = ("-Wall", "-Wextra", "-Werror", "-Wno-unused-function", "-Wno-unused-parameter", "-Wno-unused-const-variable")
AS_WRITTEN = ("-Wno-psabi", "-Wno-constant-logical-operand")  # vectors pass within a library; models have constants


def sampled(n=12):
    """Delayed and fed back numbers, with functions of the processor alone."""

    @subsystem(sample_time=1e-3, name="box")
    def box(u):
        filtered = [TransferFunction(numerator=1.0, denominator=[0.01 * (i + 1), 1.0], name=f"f{i}") for i in range(n)]
        for i, block in enumerate(filtered):
            product = Product(name=f"m{i}")(filtered[(i + 1) % n].y, u)
            block(Sum(signs="+-", name=f"s{i}")(u, Gain(gain=0.3 + 0.01 * i, name=f"g{i}")(product)))
        return filtered[0].y

    return Diagram("sampled", box(Constant(value=0.7, name="u")))


def between_ticks():
    """An oscillator with a relay of its own in continuous time, and a controller on a clock."""
    x, v = Integrator(initial_value=1.0, name="x"), Integrator(name="v")

    @subsystem(sample_time=7e-3, name="box")
    def control(y):
        return TransferFunction(numerator=-2.0, denominator=[0.02, 1.0], name="filter")(y)

    switched = Relay(on_point=0.1, off_point=-0.1, on_value=0.4, off_value=-0.3, name="relay")(x.y)
    speed = v(Sum(signs="+--", name="force")(control(x.y), Gain(gain=30.0, name="stiffness")(x.y), switched))
    return Diagram("between_ticks", x(speed))


def sources():
    """All C code that runs compile, by name."""
    found = {
        "runtime": runtime_source(),
    }
    with pytest.MonkeyPatch.context() as patch:
        for grouped in (False, True):
            if grouped:
                patch.setattr("loopwright.diagrams.flat.flat_diagram.LARGEST", 0)
            flat = sampled().flatten(1e-3)
            found[f"ticks, grouped {grouped}"] = "\n".join(write_code(flat, kinds_of(flat, every=False)).texts)
            flat = between_ticks().flatten()
            texts = write_code(flat, kinds_of(flat, every=True), functions_between(flat, stiff=True)).texts
            found[f"between ticks, grouped {grouped}"] = "\n".join(texts)
    return found


def written_for_this_processor(monkeypatch):
    """The C code of a fused run and of lanes, and their flags."""
    found = {}

    def note(source, flags=(), processor="", *, of):
        found[of] = source, flags
        return compiled_libraries.load_compiled(source, flags, processor)

    diagram = experiments.EXPERIMENTS["C"]().diagram
    monkeypatch.setattr(fused, "load_compiled", lambda *given: note(*given, of="fused"))
    monkeypatch.setattr(lane_code, "load_compiled", lambda *given: note(*given, of="lanes"))
    diagram.simulate(0.01, fuse=True, **QUIET)
    stiff = {"controller.admittance_par.stiffness": [300.0, 301.0, 302.0, 303.0]}
    diagram.sweep(stiff, duration=0.01, signals=["plant.position"], lanes=4, fuse=True, **QUIET)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("platform", TARGETS)
def test_all_c_code_compiles_without_a_warning(platform, tmp_path):
    first = {"linux": b"\x7fELF", "windows": b"MZ", "darwin": b"\xcf\xfa\xed\xfe"}  # of libraries for 64 bits
    for i, text in enumerate(sources().values()):
        emulated.compile_for(platform, text, tmp_path / f"{i}", *STRICT)
        assert (tmp_path / f"{i}").read_bytes().startswith(first[platform.partition("-")[2]])


@pytest.mark.slow
@pytest.mark.parametrize("platform", TARGETS)
def test_code_for_one_processor_compiles_without_a_warning(platform, tmp_path, monkeypatch):
    found = written_for_this_processor(monkeypatch)
    assert sorted(found) == ["fused", "lanes"]
    for name, (text, flags) in found.items():
        emulated.compile_for(platform, text, tmp_path / name, *flags, *STRICT, *AS_WRITTEN)


# ---- bits ----


def same_bits(make, duration, platform, folder, **options):
    """Run natively and emulated; return the calls that emulated code has made."""
    first = make().simulate(duration, compile=True, **options, **QUIET)
    with pytest.MonkeyPatch.context() as patch:
        processor = emulated.emulate(patch, platform, folder)
        second = make().simulate(duration, compile=True, **options, **QUIET)
    assert (first.tier, second.tier) == ("compiled", "compiled")
    assert processor.runs > 0
    assert np.isfinite(first.data).all()
    assert first.data.tobytes() == second.data.tobytes()
    return processor.calls


def test_ticks_have_the_same_bits_on_aarch64(tmp_path):
    same_bits(sampled, 0.02, "aarch64-linux", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("platform", OTHERS)
def test_compiled_runs_have_the_same_bits_everywhere(platform, tmp_path, monkeypatch):
    for grouped in (False, True):
        if grouped:
            monkeypatch.setattr("loopwright.diagrams.flat.flat_diagram.LARGEST", 0)
        same_bits(sampled, 0.05, platform, tmp_path)
        for solver in ("rk4", "RK45", "DOP853", "Radau"):
            step = {"step": 1e-3} if solver == "rk4" else {}
            same_bits(between_ticks, 0.1, platform, tmp_path, solver=solver, **step)


@pytest.mark.slow
@pytest.mark.parametrize("platform", [name for name in OTHERS if "windows" not in name])
@pytest.mark.parametrize("letter", "ABCD")
def test_experiments_have_the_same_bits_everywhere(letter, platform, tmp_path):
    """Ticks of Fig. 3 around its FMU; sine and cosine of its blocks are this machine's C library's."""
    calls = same_bits(lambda: experiments.EXPERIMENTS[letter]().diagram, 0.2, platform, tmp_path)
    assert calls >= 200  # of the FMU at least


@pytest.mark.slow
def test_a_function_of_python_is_called_from_emulated_code(tmp_path):
    def make():
        @subsystem(sample_time=1e-3, name="box")
        def box(u):
            return PythonFunction(lambda x: float(x) ** 2, name="square")(u)

        return Diagram("python", box(Sine(frequency=3.0, name="u")))

    assert same_bits(make, 0.02, "aarch64-linux", tmp_path) >= 20


# ---- no product and sum in one rounding ----


def fused_operations(library):
    """Count instructions of aarch64 that multiply and add with one rounding: FMADD and its kin, FMLA and FMLS."""
    section = emulated.lief.parse(str(library)).get_section(".text")
    words = np.frombuffer(bytes(section.content), dtype="<u4")
    kinds = ((0xFF000000, 0x1F000000), (0xBF20FC00, 0x0E20CC00), (0xBF80F400, 0x0F801000), (0xBF80F400, 0x0F805000))
    return sum(int(np.count_nonzero((words & mask) == kind)) for mask, kind in kinds)


@pytest.mark.slow
def test_products_and_sums_are_rounded_each(tmp_path):
    seen = 0
    for i, text in enumerate(sources().values()):
        out = tmp_path / f"{i}.so"
        emulated.compile_for("aarch64-linux", text, out)
        assert fused_operations(out) == 0
        emulated.compile_for("aarch64-linux", text, out, "-ffp-contract=fast")
        seen += fused_operations(out)
    assert seen > 100  # the search finds them where they are
