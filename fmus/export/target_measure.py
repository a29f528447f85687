"""C for a target, measured: compiled for Cortex-M, its instructions counted in an emulator, and single against double.

Nothing here is needed to write the C. The compiler is the package's (ziglang), which builds for Cortex-M from any
machine; the emulator is unicorn. Where one of them is missing, the numbers are missing, and the report says so.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import importlib.util
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import CompilerError, OptionError, explain_calls, near
from ..platform import cache_folder, native_platform
from ..toolchain import SUFFIXES
from .compiler import compile_shared, describe_compiler, find_compiler, run_compiler
from .target_members import Member
from .target_text import TargetText

PROCESSORS = {
    "cortex-m4": ("thumb-freestanding-eabihf", "cortex_m4+vfp4d16sp"),
    "cortex-m0": ("thumb-freestanding-eabi", "cortex_m0"),
}
"""Processors that are compiled for: zig's target and processor."""
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror")
_FLAGS = ("-std=c99", "-O2", "-fno-math-errno", "-ffunction-sections", "-fdata-sections", "-fno-sanitize=all", "-g0")
_STACK, _STACK_SIZE, _END = 0x30000000, 0x10000, 0x40000000
_PATTERN = 0xA5
_DRIVER = """#include "{name}.h"
{name} lw_instance;
unsigned lw_size(void) {{ return (unsigned)sizeof lw_instance; }}
void *volatile lw_place;
void (*volatile lw_kept[3])(void); /* so that the linker keeps them */
void _start(void) {{
    lw_place = &lw_instance;
    lw_kept[0] = (void (*)(void)){name}_init;
    lw_kept[1] = (void (*)(void)){name}_tick;
    lw_kept[2] = (void (*)(void))lw_size;
}}
"""
_STRING = """#include <stddef.h>
void *memcpy(void *to, const void *from, size_t count);
void *memset(void *to, int value, size_t count);
#define memcpy __builtin_memcpy
"""
_OF_ONE = """sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp expm1 log log1p sqrt floor ceil fabs
erf"""
_OTHERS = "pow fmod remainder copysign fmin fmax atan2 hypot"


@explain_calls
@dataclass(frozen=True, eq=False)
class ProcessorMeasurement:
    """Numbers of C for a target on one processor.

    Attributes
    ----------
    processor : str
        The processor.
    code, constants : int
        Bytes of instructions and of constant data of the source; functions of libraries are not in them.
    struct : int
        Bytes of an instance.
    stack : int or None
        Largest number of bytes of the stack that a tick has used.
    instructions : tuple of int
        Instructions of each tick of the test signal.
    bound : int or None
        Instructions that no tick exceeds, whatever the data; None where there is a loop or a call of a library.
    unbounded : str
        The reason why there is no bound.
    outputs : mapping of str to ndarray
        Outputs after each tick, as the processor computed them.
    missing : str
        The reason why nothing was counted; empty where it was.
    """

    processor: str
    code: int
    constants: int
    struct: int
    stack: int | None
    instructions: tuple[int, ...]
    bound: int | None
    unbounded: str
    outputs: Mapping[str, np.ndarray]
    missing: str = ""

    @property
    def largest(self) -> int | None:
        """The largest number of instructions of a tick."""
        return max(self.instructions, default=None)


@explain_calls
@dataclass(frozen=True, eq=False)
class TargetMeasurement:
    """C for a target, measured with a test signal.

    Attributes
    ----------
    ticks : int
        Ticks of the test signal.
    processors : tuple of ProcessorMeasurement
        By processor: memory, stack and instructions.
    float_error : mapping of str to float
        By output and signal: the largest difference between single and double precision; empty in double precision.
    missing : tuple of str
        What could not be measured, and why.
    """

    ticks: int
    processors: tuple[ProcessorMeasurement, ...]
    float_error: Mapping[str, float]
    missing: tuple[str, ...]


def measure(text: TargetText, processor: str, inputs: Mapping[str, Any], ticks: int) -> ProcessorMeasurement:
    """Compile C for a processor without a warning, and count the instructions of ticks in an emulator.

    ``inputs``: values of inputs at each tick, shape (ticks, …), or one value for all.
    Raises `CompilerError` if there is no compiler that builds for it, or a warning.
    Raises `OptionError`: for another processor, or values of inputs that don't fit.
    """
    if processor not in PROCESSORS:
        raise OptionError(f"there is no processor {processor!r}. {near(processor, PROCESSORS)}", port="processor")
    rows = input_rows(text, inputs, ticks)
    target, cpu = PROCESSORS[processor]
    compiler = find_compiler()
    if not compiler.zig:
        raise CompilerError(
            f"{compiler.command[0]} doesn't build for {processor}. Install the compiler that does: "
            'pip install "loopwright[build]".'
        )
    base = [*compiler.command, "-target", target, f"-mcpu={cpu}", *_FLAGS, "-Iinclude", "-I."]
    sources = {**text.files, "driver.c": _DRIVER.format(name=text.name), **_headers()}
    own = f"{text.name}.c"
    made = run_compiler(
        sources,
        [
            [*base, *WARNINGS, "-c", "-o", "own.o", own],
            [*base, "-S", "-o", "own.s", own],
        ],
        ["own.o", "own.s"],
        processor,
    )
    code, constants = _sizes(made["own.o"])
    bound, unbounded = find_bound(made["own.s"].decode(), f"{text.name}_tick")
    common = (processor, code, constants, text.bytes_of["struct"])
    try:
        link = [*base, "-static", "-nostartfiles", "-Wno-unused-command-line-argument", "-Wl,--gc-sections"]
        linked = run_compiler(sources, [[*link, "-o", "own.elf", own, "driver.c"]], ["own.elf"], processor)["own.elf"]
    except CompilerError as error:
        undefined = sorted({*re.findall(r"undefined symbol: (\w+)", str(error))})
        if not undefined:
            raise
        why = f"the bare processor's compiler has no {', '.join(undefined)}; a C library of the target has"
        return ProcessorMeasurement(*common, None, (), bound, unbounded, {}, why)
    if importlib.util.find_spec("unicorn") is None:
        why = 'the emulator is missing; pip install unicorn (it is in "loopwright[test]")'
        return ProcessorMeasurement(*common, None, (), bound, unbounded, {}, why)
    stack, counts, outputs = _Emulator(linked, text).run(rows, ticks)
    return ProcessorMeasurement(*common, stack, counts, bound, unbounded, outputs)


def input_rows(text: TargetText, inputs: Mapping[str, Any], ticks: int) -> dict[str, np.ndarray]:
    """Return the values of inputs at each tick, shape (ticks, entries); start values where none are given."""
    members = {m.variable.name: m for m in text.members if m.group == "inputs"}
    for name in inputs:
        if name not in members:
            raise OptionError(f"there is no input {name!r}. {near(name, members)}", block=text.name)
    found = {}
    for name, member in members.items():
        try:
            values = np.asarray(inputs.get(name, member.start.reshape(member.variable.shape)), dtype=float)
        except (TypeError, ValueError):
            raise OptionError(
                f"found {inputs[name]!r} for the input {name!r}; expected numbers, one value or one for each tick.",
                block=text.name,
            ) from None
        if values.shape == member.variable.shape:
            values = np.broadcast_to(values, (ticks, *member.variable.shape))
        if values.shape[1:] != member.variable.shape or len(values) < ticks:
            raise OptionError(
                f"found values of shape {values.shape} for the input {name!r}; expected a value for each tick, "
                f"{(ticks, *member.variable.shape)}.",
                block=text.name,
            )
        found[name] = values[:ticks].reshape(ticks, -1)
    return found


def offsets(text: TargetText) -> dict[tuple[str, str], int]:
    """Return the places of members in the struct, in bytes, by group and name."""
    size, end = 4 if text.number == "float" else 8, 0
    found: dict[tuple[str, str], int] = {}
    for member in text.members:
        found[member.group, member.variable.name] = end
        end += size * member.count
    return found


def _headers() -> dict[str, str]:
    """Return headers of a C library for a compiler without one: declarations alone."""
    lines = ['#define NAN __builtin_nanf("")', "#define INFINITY __builtin_inff()"]
    for kind, end in (("double", ""), ("float", "f")):
        lines += [f"{kind} {f}{end}({kind} x);" for f in _OF_ONE.split()]
        lines += [f"{kind} {f}{end}({kind} x, {kind} y);" for f in _OTHERS.split()]
        lines += [f"#define {f}{end} __builtin_{f}{end}" for f in ("fabs", "sqrt", "copysign", "fmin", "fmax")]
    return {"include/math.h": "\n".join(lines) + "\n", "include/string.h": _STRING}


# --- object files -----------------------------------------------------------------------------------------------------


def _sections(elf: bytes) -> list[tuple[str, int, int, int, int, int, int]]:
    """Return the sections of a 32-bit object: name, type, flags, address, offset, size, link."""
    start, count, names = struct.unpack_from("<I", elf, 32)[0], *struct.unpack_from("<HH", elf, 48)
    rows = [struct.unpack_from("<10I", elf, start + 40 * i) for i in range(count)]
    text = rows[names][4]

    def name(at: int) -> str:
        return elf[text + at : elf.index(b"\0", text + at)].decode()

    return [(name(r[0]), r[1], r[2], r[3], r[4], r[5], r[6]) for r in rows]


def _sizes(elf: bytes) -> tuple[int, int]:
    """Return the bytes of instructions, and of other data that a target holds."""
    code = data = 0
    for name, kind, flags, _, _, size, _ in _sections(elf):
        if flags & 2 and not name.startswith((".ARM.exidx", ".ARM.extab")):  # it is in the target's memory
            code, data = (code + size, data) if flags & 4 else (code, data + size * (kind != 8))
    return code, data


def _symbols(elf: bytes) -> dict[str, int]:
    sections = _sections(elf)
    table = next(s for s in sections if s[1] == 2)
    text = sections[table[6]][4]
    found = {}
    for at in range(table[4], table[4] + table[5], 16):
        name, value = struct.unpack_from("<II", elf, at)
        if name:
            found[elf[text + name : elf.index(b"\0", text + name)].decode()] = value
    return found


# --- a bound ------------------------------------------------------------------------------------------------

_LABEL = re.compile(r"^([\w.$]+):")


def find_bound(assembly: str, function: str) -> tuple[int | None, str]:
    """Return how many instructions a function executes at most, with those it calls; or None, and the reason.

    Without a jump backwards every instruction is executed once at most. So the number of instructions is a bound.
    """
    bodies = _functions(assembly)
    known: dict[str, tuple[int | None, str]] = {}

    def count(name: str) -> tuple[int | None, str]:
        if name not in bodies:
            return None, f"it calls {name}, a function of a library"
        if name in known:
            return known[name]
        known[name] = None, f"{name} calls itself"
        total, seen = 0, set[str]()
        for line in bodies[name]:
            if label := _LABEL.match(line):
                seen.add(label[1])
                continue
            total += 1
            operation, _, operands = line.partition("\t")
            target = operands.split(",")[-1].strip()
            if operation.startswith(("bl", "blx")) and not operation.startswith(("blt", "ble", "bls", "blo")):
                more, why = count(target)
                if more is None:
                    return known.setdefault(name, (None, why)) and (None, why)
                total += more
            elif operation.startswith(("b", "cb")) and not operation.startswith(("bic", "bfi", "bfc", "bx", "bkpt")):
                if target in seen:
                    return None, f"{name} has a loop"
                if not target.startswith(".") and target in bodies:  # a call at the end
                    more, why = count(target)
                    if more is None:
                        return None, why
                    total += more
                elif not target.startswith("."):
                    return None, f"it calls {target}, a function of a library"
        known[name] = total, ""
        return known[name]

    return count(function)


def _functions(assembly: str) -> dict[str, list[str]]:
    """Return the labels and instructions of each function."""
    found: dict[str, list[str]] = {}
    body: list[str] | None = None
    names = {*re.findall(r"^\s*\.type\s+([\w.$]+),\s*%function", assembly, re.MULTILINE)}
    for raw in assembly.splitlines():
        line = raw.split("@")[0].rstrip()
        if (label := _LABEL.match(line)) and label[1] in names:
            body = found[label[1]] = []
        elif re.match(r"\s*\.size\s", line):
            body = None
        elif body is not None and line:
            if label:
                body.append(line)
            elif line.startswith("\t") and not line.startswith("\t."):
                body.append(line.strip())
    return found


# --- the emulator -------------------------------------------------------------------------------------------


class _Emulator:
    def __init__(self, elf: bytes, text: TargetText):
        unicorn: Any = importlib.import_module("unicorn")
        arm_const: Any = importlib.import_module("unicorn.arm_const")
        self._arm = arm_const
        uc = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB)
        access = uc.reg_read(arm_const.UC_ARM_REG_C1_C0_2)
        uc.reg_write(arm_const.UC_ARM_REG_C1_C0_2, access | 0xF << 20)  # the floating-point unit is switched on
        uc.reg_write(arm_const.UC_ARM_REG_FPEXC, 1 << 30)
        self._uc, self._text, self._symbols = uc, text, _symbols(elf)
        start, count = struct.unpack_from("<I", elf, 28)[0], struct.unpack_from("<H", elf, 44)[0]
        pages = set[int]()
        parts = []
        for i in range(count):
            kind, offset, at, _, in_file, size, *_ = struct.unpack_from("<8I", elf, start + 32 * i)
            if kind == 1 and size:
                pages.update(range(at >> 12, (at + size + 0xFFF) >> 12))
                parts.append((at, elf[offset : offset + in_file]))
        for page in sorted(pages):
            uc.mem_map(page << 12, 0x1000)
        for at, content in parts:
            uc.mem_write(at, content)
        uc.mem_map(_STACK, _STACK_SIZE)
        uc.mem_map(_END, 0x1000)
        self._count, self._lengths = 0, dict[tuple[int, int], int]()
        uc.hook_add(unicorn.UC_HOOK_BLOCK, self._enter)

    def _enter(self, uc: Any, address: int, size: int, _: object) -> None:
        key = address, size
        if key not in self._lengths:
            halves = struct.unpack(f"<{size // 2}H", uc.mem_read(address, size // 2 * 2))
            i = count = 0
            while i < len(halves):
                i += 2 if halves[i] >> 11 in (0b11101, 0b11110, 0b11111) else 1  # of 32 bits, or of 16
                count += 1
            self._lengths[key] = count
        self._count += self._lengths[key]

    def _call(self, name: str) -> int:
        arm, uc = self._arm, self._uc
        uc.reg_write(arm.UC_ARM_REG_R0, self._symbols["lw_instance"])
        uc.reg_write(arm.UC_ARM_REG_SP, _STACK + _STACK_SIZE)
        uc.reg_write(arm.UC_ARM_REG_LR, _END | 1)
        self._count = 0
        uc.emu_start(self._symbols[name] | 1, _END)
        return int(uc.reg_read(arm.UC_ARM_REG_R0))

    def run(self, rows: Mapping[str, np.ndarray], ticks: int) -> tuple[int, tuple[int, ...], dict[str, np.ndarray]]:
        """Return the bytes of the stack, the instructions of each tick, and the outputs after each."""
        text, uc = self._text, self._uc
        at, kind = self._symbols["lw_instance"], np.float32 if text.number == "float" else np.float64
        self._call(f"{text.name}_init")
        if (size := self._call("lw_size")) != text.bytes_of["struct"]:
            raise CompilerError(f"found {size} bytes of an instance; expected {text.bytes_of['struct']}.")
        places = offsets(text)
        watched = [m for m in text.members if m.group in ("outputs", "signals")]
        outputs: dict[str, list[Any]] = {m.variable.name: [] for m in watched}
        uc.mem_write(_STACK, bytes([_PATTERN]) * _STACK_SIZE)
        counts = []
        for k in range(ticks):
            for name, values in rows.items():
                uc.mem_write(at + places["inputs", name], values[k].astype(kind).tobytes())
            if status := self._call(f"{text.name}_tick"):
                raise CompilerError(
                    f"tick {k} of the test signal ended with the status {status}: {text.statuses[status]}. "
                    "Give a test signal that the diagram runs with."
                )
            counts.append(self._count)
            for m in watched:
                size = m.count * np.dtype(kind).itemsize
                found = np.frombuffer(uc.mem_read(at + places[m.group, m.variable.name], size), kind)
                outputs[m.variable.name].append(found.astype(float).reshape(m.variable.shape))
        stack = bytes(uc.mem_read(_STACK, _STACK_SIZE))
        used = len(stack.lstrip(bytes([_PATTERN])))
        return used, tuple(counts), {name: np.array(found) for name, found in outputs.items()}


# --- this machine -------------------------------------------------------------------------------------------

_HOST = """#include "{name}.h"

SEEN int lw_run(const double *in, double *out, long ticks) {{
    {name} c;
    {name}_init(&c);
    for (long k = 0; k < ticks; k++, in += {read}, out += {count}) {{
{sets}
        const {name}_status status = {name}_tick(&c);
        if (status != {upper}_OK) return (int)status;
{gets}
    }}
    return 0;
}}
"""
_SEEN = """#if defined(_WIN32)
#define SEEN __declspec(dllexport)
#else
#define SEEN __attribute__((visibility("default")))
#endif
"""


def run_here(text: TargetText, inputs: Mapping[str, Any], ticks: int) -> dict[str, np.ndarray]:
    """Compile C for this machine, and return the outputs and signals after each tick.

    Raises `CompilerError` if there is no compiler, or a tick of the test signal fails.
    """
    rows = input_rows(text, inputs, ticks)
    ins = [m for m in text.members if m.group == "inputs"]
    outs = [m for m in text.members if m.group in ("outputs", "signals")]
    table = np.ascontiguousarray(np.hstack([rows[m.variable.name] for m in ins]) if ins else np.zeros((ticks, 1)))
    sets = [f"        {e} = ({text.name}_real)in[{i}];" for i, e in enumerate(_entries(ins))]
    gets = [f"        out[{i}] = (double){e};" for i, e in enumerate(_entries(outs))]
    driver = _SEEN + _HOST.format(
        name=text.name,
        upper=text.name.upper(),
        read=table.shape[1],
        sets="\n".join(sets),
        gets="\n".join(gets),
        count=len(gets),
    )
    values = np.zeros((ticks, len(gets)))
    run = _load({**text.files, "driver.c": driver}, [f"{text.name}.c", "driver.c"]).lw_run
    pointer = ctypes.POINTER(ctypes.c_double)
    run.argtypes = [pointer, pointer, ctypes.c_long]
    if status := run(table.ctypes.data_as(pointer), values.ctypes.data_as(pointer), ticks):
        raise CompilerError(
            f"a tick of the test signal ended with the status {status}: {text.statuses[status]}. Give a test signal "
            "that the diagram runs with."
        )
    made, first = {}, 0
    for m in outs:
        made[m.variable.name] = values[:, first : first + m.count].reshape(ticks, *m.variable.shape)
        first += m.count
    return made


def _load(sources: Mapping[str, str], compiled: Sequence[str]) -> ctypes.CDLL:
    """Return C as a library of this process, which is kept in the cache."""
    platform = native_platform()
    content = "\0".join([*describe_compiler(platform), *(f"{n}\0{t}" for n, t in sorted(sources.items()))])
    suffix = SUFFIXES.get(platform.rpartition("-")[2], ".so")
    path = cache_folder() / "target" / f"{hashlib.sha256(content.encode()).hexdigest()[:32]}{suffix}"
    if not path.is_file():
        compile_shared(sources, path, compiled=compiled)
    return ctypes.CDLL(str(path))


def _entries(members: Iterable[Member]) -> list[str]:
    return [m.access(i, "c.") for m in members for i in range(m.count)]
