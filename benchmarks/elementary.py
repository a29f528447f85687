"""Elementary functions of exported FMUs next to the platform's: python benchmarks/elementary.py.

Nanoseconds of a call in a chain in which each call waits for the one before, as in an integrator: the smallest of
nine chains of 100,000. Both are compiled in one library.
"""

from __future__ import annotations

import ctypes
import tempfile
import time
from importlib import resources
from pathlib import Path

import loopwright.fmus.export as export
from loopwright.fmus.export import compile_shared
from loopwright.fmus.export.elementary_tables import prepare_functions, restore_functions

CHAINS = {  # function: scale and offset of its argument, which settle it in a part of its range
    "sin": ((0.5, 0.1), (2.0, 0.7), (0.01, 6.0)),
    "cos": ((0.5, 0.1), (2.0, 0.7), (0.01, 6.0)),
    "tanh": ((0.1, 0.01), (1.5, 0.3), (1.0, 25.0)),
    "exp": ((-0.9, 0.5),),
    "expm1": ((-0.9, 0.5),),
    "log": ((1.0, 2.0),),
}
CALLS = 100_000
CHAIN = """
#ifdef _WIN32
__declspec(dllexport)
#else
__attribute__((visibility("default")))
#endif
double chain_{1}{0}(double x, double scale, double offset, long long n) {{
    for (long long i = 0; i < n; i++) x = {1}{0}(x * scale + offset);
    return x;
}}
"""


def nanoseconds(library: ctypes.CDLL, function: str, scale: float, offset: float) -> float:
    """Return the nanoseconds of a call."""
    chain = library[f"chain_{function}"]
    chain.restype = ctypes.c_double
    numbers = (ctypes.c_double(0.3), ctypes.c_double(scale), ctypes.c_double(offset), ctypes.c_longlong(CALLS))
    best = float("inf")
    for _ in range(9):
        started = time.perf_counter()
        chain(*numbers)
        best = min(best, time.perf_counter() - started)
    return best / CALLS * 1e9


def main() -> None:
    """Print one row for each chain."""
    text = prepare_functions(" ".join(f"{name}(x)" for name in CHAINS)) + restore_functions()
    text += "".join(CHAIN.format(name, of) for name in CHAINS for of in ("lw_", ""))
    runtime = (resources.files(export) / "fmu_sources" / "elementary.c").read_text("utf-8")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        out = Path(folder) / "chains.so"
        compile_shared({"all.c": text, "elementary.c": runtime}, out, compiled=["all.c"])
        library = ctypes.CDLL(str(out))
        print("function   x to         ours, ns   platform's, ns")
        for name, chains in CHAINS.items():
            for scale, offset in chains:
                ours, theirs = (nanoseconds(library, f"{of}{name}", scale, offset) for of in ("lw_", ""))
                print(f"{name:8}   {scale:5} x + {offset:<5}  {ours:8.1f}   {theirs:14.1f}")


if __name__ == "__main__":
    main()
