"""Compiled libraries of other platforms, run in an emulator of their processor within this process's memory.

Emulated code has the addresses of this process: what it reads or writes is mapped when it is first touched, and calls of
functions that aren't emulated (of the C library, of an FMU, of Python) are made by this machine's processor. So a run can
have its C code emulated, and all else as it is.
"""

import ctypes
import ctypes.util
import hashlib
import mmap
import os
import struct
import sys
from functools import lru_cache
from itertools import groupby
from pathlib import Path

import lief
import unicorn
from unicorn import arm64_const as arm
from unicorn import x86_const as x86

from loopwright.diagrams.compiled import bound_functions, compiled_libraries, plants_called_back
from loopwright.fmus.export import compile_shared
from loopwright.fmus.toolchain import DIAGRAM_FLAGS

lief.logging.disable()
PAGE, AT_ONCE, STACK = 0x1000, 1 << 20, 1 << 20
INTEGERS, NUMBERS = [ctypes.c_uint64] * 6, [ctypes.c_double] * 8
_REAL = (
    "sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 exp2 log log1p log2 log10 pow sqrt cbrt "
    "hypot fmod remainder floor ceil trunc rint nearbyint round fabs fmin fmax copysign ldexp erf fma"
)
REAL = frozenset(_REAL.split())
"""Functions of the C library that return a number; others return an integer, or nothing."""
FETCHED = (unicorn.UC_ERR_FETCH_UNMAPPED, unicorn.UC_ERR_FETCH_PROT)


@lru_cache(maxsize=1)
def _c_libraries():
    assert os.uname()[::4] == ("Linux", "x86_64"), "calls from emulated code are made as there"
    return [ctypes.CDLL(ctypes.util.find_library(name)) for name in ("m", "c")]


class Processor:
    """An emulated processor of a platform, such as ``"aarch64-linux"``, in the memory of this process."""

    def __init__(self, platform):
        self.platform, (machine, self.system) = platform, platform.split("-")
        self.arm, self.runs, self.calls, self.outside = machine == "aarch64", 0, 0, {}
        kind = (unicorn.UC_ARCH_ARM64, unicorn.UC_MODE_ARM) if self.arm else (unicorn.UC_ARCH_X86, unicorn.UC_MODE_64)
        self.uc = unicorn.Uc(*kind)
        if self.arm:
            self.uc.reg_write(arm.UC_ARM64_REG_CPACR_EL1, 3 << 20)  # numbers with a point are allowed
            self.integers = [getattr(arm, f"UC_ARM64_REG_X{i}") for i in range(8)]
            self.numbers = [getattr(arm, f"UC_ARM64_REG_D{i}") for i in range(8)]
            self.at, self.stack = arm.UC_ARM64_REG_PC, arm.UC_ARM64_REG_SP
            self.result = self.integers[0]
        else:
            names = "RCX RDX R8 R9" if self.system == "windows" else "RDI RSI RDX RCX R8 R9"
            self.integers = [getattr(x86, f"UC_X86_REG_{name}") for name in names.split()]
            self.numbers = [getattr(x86, f"UC_X86_REG_XMM{i}") for i in range(8)]
            self.at, self.stack = x86.UC_X86_REG_RIP, x86.UC_X86_REG_RSP
            self.result = x86.UC_X86_REG_RAX
        self.mapped = set()
        self.uc.hook_add(unicorn.UC_HOOK_MEM_READ_UNMAPPED | unicorn.UC_HOOK_MEM_WRITE_UNMAPPED, self._touch)
        stack = self.room(STACK)
        self.uc.reg_write(self.stack, stack + STACK - 0x1000)

    def room(self, size):
        """Return the address of new memory from which code may be run."""
        size = -(-size // PAGE) * PAGE
        memory = mmap.mmap(-1, size)
        address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self.outside[address] = memory  # as long as this lives
        self._map(address, size, unicorn.UC_PROT_ALL)
        return address

    def _map(self, address, size, rights):
        self.uc.mem_map_ptr(address, size, rights, address)
        self.mapped.update(range(address // PAGE, (address + size) // PAGE))

    def _touch(self, uc, access, address, size, value, data):
        """Map memory of this process, as it is touched."""
        for line in Path("/proc/self/maps").read_text().splitlines():
            first, last = (int(x, 16) for x in line.split()[0].split("-"))
            if first <= address < last and line.split()[1][0] == "r":
                break
        else:
            return False
        begin = max(first, address // AT_ONCE * AT_ONCE) // PAGE
        end = min(last, (address // AT_ONCE + 1) * AT_ONCE) // PAGE
        new = [page for page in range(begin, end) if page not in self.mapped]
        for _, run in groupby(enumerate(new), lambda pair: pair[1] - pair[0]):
            pages = [page for _, page in run]
            rights = unicorn.UC_PROT_READ | unicorn.UC_PROT_WRITE
            self._map(pages[0] * PAGE, len(pages) * PAGE, rights)
        return True

    def native(self, name):
        """Return the address of a function of this machine's C library, for emulated code to call."""
        if self.system == "darwin":
            name = name.removeprefix("_")
        for library in _c_libraries():
            if hasattr(library, name):
                address = ctypes.cast(library[name], ctypes.c_void_p).value
                break
        else:
            address = 0x10000 + 16 * len(self.outside)  # no address of this process
        self.outside[address] = name
        return address

    def _register(self, place):
        found = self.uc.reg_read(place)
        return struct.unpack("<d", struct.pack("<Q", found & (2**64 - 1)))[0]

    def _answer(self, place, number):
        self.uc.reg_write(place, struct.unpack("<Q", struct.pack("<d", number))[0])

    def _call_outside(self, address):
        """Make a call that the emulated code has begun."""
        name = self.outside.get(address, "")
        integers = [self.uc.reg_read(place) for place in self.integers[:6]] + [0, 0]
        numbers = [self._register(place) for place in self.numbers]
        self.calls += 1
        if name == "__sincos_stret":  # of macOS: both in registers
            for place, function in zip(self.numbers, ("sin", "cos"), strict=False):
                self._answer(place, self._made(self.native(function), ctypes.c_double)(*integers[:6], *numbers))
            return
        if address < 1 << 24:
            raise LookupError(f"the emulated library calls {name!r}, which this machine hasn't")
        kind = ctypes.c_double if name in REAL else ctypes.c_uint64
        found = self._made(address, kind)(*integers[:6], *numbers)
        if kind is ctypes.c_double:
            self._answer(self.numbers[0], found)
        else:
            self.uc.reg_write(self.result, found)

    @staticmethod
    def _made(address, result):
        return ctypes.CFUNCTYPE(result, *INTEGERS, *NUMBERS)(address)

    def call(self, address, given, result=None):
        """Call an emulated function with C values."""
        self.runs += 1
        kept = self.uc.context_save()
        integers, numbers = [], []
        for value in given:
            if isinstance(value, float | ctypes.c_double):
                numbers.append(float(getattr(value, "value", value)))
                integers += [0] * (self.system == "windows")
                continue
            value = getattr(value, "_obj", value)  # by reference
            if isinstance(value, ctypes.Structure | ctypes.Array):
                value = ctypes.addressof(value)
            integers.append(int(getattr(value, "value", value) or 0))
            numbers += [0.0] * (self.system == "windows")
        stack = (self.uc.reg_read(self.stack) - 0x1000) & ~0xF
        places = len(self.integers)
        beyond = b"".join(struct.pack("<q", value) for value in integers[places:])
        if self.system == "windows":
            beyond = bytes(32) + beyond
        stack -= len(beyond) + len(beyond) % 16
        ctypes.memmove(stack, beyond, len(beyond))
        end = 0x8000
        if self.arm:
            self.uc.reg_write(arm.UC_ARM64_REG_LR, end)
        else:
            stack -= 8
            ctypes.memmove(stack, struct.pack("<q", end), 8)
        self.uc.reg_write(self.stack, stack)
        for place, value in zip(self.integers, integers, strict=False):
            self.uc.reg_write(place, value & (2**64 - 1))
        for place, value in zip(self.numbers, numbers, strict=False):
            self._answer(place, value)
        self._run(address, end)
        found = self.uc.reg_read(self.result)
        self.uc.context_restore(kept)
        if result is None:
            return None
        return result(found & (2 ** (8 * ctypes.sizeof(result)) - 1)).value

    def _run(self, address, end):
        """Run from an address until the function has returned."""
        while address != end:
            try:
                self.uc.emu_start(address, end)
                return
            except unicorn.UcError as error:
                address = self.uc.reg_read(self.at)
                if error.errno not in FETCHED:
                    raise RuntimeError(f"{self.platform}: {error} at {address:#x}") from error
            if address == end:
                return
            if self.arm:
                back = self.uc.reg_read(arm.UC_ARM64_REG_LR)
            else:
                stack = self.uc.reg_read(self.stack)
                back = ctypes.c_uint64.from_address(stack).value
            self._call_outside(address)
            if not self.arm:
                self.uc.reg_write(self.stack, stack + 8)
            address = back


class Function(ctypes.c_void_p):
    """An emulated function, as ctypes has functions."""

    restype, argtypes, processor = ctypes.c_int, None, None

    def __call__(self, *given):
        return self.processor.call(self.value, given, self.restype)


class Library:
    """A library of an emulated processor, as ctypes has libraries."""

    def __init__(self, processor, path):
        self.processor, self._name = processor, str(path)
        binary = lief.parse(str(path))
        parts = getattr(binary, "segments", None) or binary.sections
        if processor.system == "linux":
            parts = [part for part in parts if part.type == lief.ELF.Segment.TYPE.LOAD]
        size = max(part.virtual_address + max(part.virtual_size, len(part.content)) for part in parts)
        self.base = processor.room(size + PAGE)
        for part in parts:
            content = bytes(part.content)
            ctypes.memmove(self.base + part.virtual_address, content, len(content))
        getattr(self, f"_bind_{processor.system}")(binary)

    def _put(self, place, address):
        ctypes.c_uint64.from_address(self.base + place).value = address

    def _bind_linux(self, binary):
        for relocation in binary.relocations:
            symbol = relocation.symbol
            if symbol is None or not symbol.name:
                self._put(relocation.address, self.base + relocation.addend)
            elif symbol.value:
                self._put(relocation.address, self.base + symbol.value + relocation.addend)
            else:
                self._put(relocation.address, self.processor.native(symbol.name))
        self.places = {symbol.name: symbol.value for symbol in binary.exported_symbols}

    def _bind_darwin(self, binary):
        for relocation in binary.relocations:
            place = relocation.address
            self._put(place, self.base + ctypes.c_uint64.from_address(self.base + place).value)
        for binding in binary.bindings:
            if binding.symbol is not None:
                self._put(binding.address, self.processor.native(binding.symbol.name))
        self.places = {symbol.name.removeprefix("_"): symbol.value for symbol in binary.exported_symbols}

    def _bind_windows(self, binary):
        shift = self.base - binary.optional_header.imagebase
        for page in binary.relocations:
            for entry in page.entries:
                if entry.type == lief.PE.RelocationEntry.BASE_TYPES.DIR64:
                    place = page.virtual_address + entry.position
                    self._put(place, ctypes.c_uint64.from_address(self.base + place).value + shift)
        for library in binary.imports:
            for entry in library.entries:
                self._put(entry.iat_address, self.processor.native(entry.name))
        self.places = {entry.name: entry.address for entry in binary.get_export().entries}

    def __getitem__(self, name):
        function = Function(self.base + self.places[name])
        function.processor = self.processor
        return function


def compile_for(platform, source, out, *more):
    """Compile a source of compiled runs for a platform, without the instructions of this machine's processor."""
    flags = [flag for flag in (*DIAGRAM_FLAGS, *more) if "native" not in flag]
    compile_shared({"code.c": source}, out, platform=platform, more_flags=flags)


def _replace(patch, original, made):
    """Replace a function under all names that modules have for it."""
    for module in [module for name, module in sorted(sys.modules.items()) if name.startswith("loopwright.diagrams")]:
        for name in [name for name, value in vars(module).items() if value is original]:
            patch.setattr(module, name, made)


def emulate(patch, platform, folder):
    """Let compiled runs of new diagrams run as code of another platform; return the processor.

    Its steps of FMUs are not for Windows, whose calls place numbers and integers in one order.
    """
    processor, known, native_runtime = Processor(platform), {}, compiled_libraries.load_runtime

    def load(source, flags=(), processor_of=""):
        if (source, flags) not in known:
            out = folder / f"{platform}-{hashlib.sha256(f'{flags}{source}'.encode()).hexdigest()}"
            if not out.exists():
                compile_for(platform, source, out, *flags)
            known[source, flags] = Library(processor, out)
        return known[source, flags]

    def function(address):
        made = Function(address)
        made.processor = processor
        return made

    patch.setattr(compiled_libraries, "installed_runtime", lambda: folder / "none")
    _replace(patch, compiled_libraries.load_runtime, lru_cache(compiled_libraries.load_runtime.__wrapped__))
    _replace(patch, compiled_libraries.load_compiled, load)
    patch.setattr(plants_called_back, "load_runtime", native_runtime)  # code of other processes
    patch.setattr(bound_functions, "TICK", function)
    return processor
