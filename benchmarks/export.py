"""What an exported FMU costs: python benchmarks/export.py.

One doStep of the gantry over 1 ms (five Runge-Kutta substeps, as exported) against a C function that is written by hand
and does the same: the same substeps, the outputs at the end, and a check for values that are not finite. Both come from
the same compiler with the same flags and have the signature of fmi3DoStep. They are called by turns, in two ways: from
Python through ctypes, with arguments made beforehand, as a simulation does, and from a loop in C, which leaves nothing
but the functions themselves. A time is the least over the turns, since other processes only add to it. Moving, the
friction's tanh is saturated and costs little; creeping, it is most of the work.

Then the time of an export for this machine: cold (nothing cached, not even the compiler's own files), warm (the
compiler has been used), and again (this very FMU is in the cache).
"""

from __future__ import annotations

import ctypes
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import fmpy
import fmpy.fmi3
import numpy as np

from loopwright.fmus import gantry
from loopwright.fmus.export.compiler import compile_shared, find_compiler
from loopwright.fmus.toolchain import SUFFIXES, flags, native_platform

TICK = 1e-3
SUBSTEPS = 5
FORCES = {"moving": (120.0, 90.0), "creeping": (30.0, 60.0)}  # N; friction holds 65 N and 38 N, the weight is 43 N
CALLS = 1_000
TURNS = 300

HAND_WRITTEN = """
#include <math.h>
#include <stdbool.h>

#ifdef _WIN32
#define PUBLIC __declspec(dllexport)
#else
#define PUBLIC __attribute__((visibility("default")))
#endif
#define SIGNATURE void *instance, double t, double h, bool keep, bool *event, bool *terminate, bool *early, double *last
PUBLIC int by_hand(SIGNATURE);
typedef int step(SIGNATURE);
PUBLIC int drive(step *function, void *instance, double t, double h, int n);

typedef struct {
    double x[4], acceleration[2]; /* x: position, velocity */
    double motor[2], external[2];
    double m_t[2], m_J[2], F_c[2], c_v[2], coulomb_scale, viscous_scale, width, gravity, substep;
} gantry;

static inline void rate(const gantry *g, const double *x, double *k) {
    for (int i = 0; i < 2; i++) {
        double v = x[2 + i], weight = i ? g->gravity * g->m_t[1] : 0.0;
        double friction = g->coulomb_scale * g->F_c[i] * tanh(v / g->width) + g->viscous_scale * g->c_v[i] * v;
        k[i] = v;
        k[2 + i] = (g->motor[i] + g->external[i] - friction - weight) / (g->m_t[i] + g->m_J[i]);
    }
}

int by_hand(SIGNATURE) {
    gantry *g = instance;
    double x[4], y[4], k1[4], k2[4], k3[4], k4[4];
    int n = (int)ceil(h / g->substep - 1e-9);
    double d = h / n;
    for (int i = 0; i < 4; i++) x[i] = g->x[i];
    for (int j = 0; j < n; j++) {
        rate(g, x, k1);
        for (int i = 0; i < 4; i++) y[i] = x[i] + d / 2.0 * k1[i];
        rate(g, y, k2);
        for (int i = 0; i < 4; i++) y[i] = x[i] + d / 2.0 * k2[i];
        rate(g, y, k3);
        for (int i = 0; i < 4; i++) y[i] = x[i] + d * k3[i];
        rate(g, y, k4);
        for (int i = 0; i < 4; i++) x[i] += d / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    }
    rate(g, x, k1);
    for (int i = 0; i < 4; i++) if (!isfinite(x[i]) || !isfinite(k1[i])) return 3;
    for (int i = 0; i < 4; i++) g->x[i] = x[i];
    g->acceleration[0] = k1[2];
    g->acceleration[1] = k1[3];
    *event = *terminate = *early = false;
    *last = t + h;
    return 0;
}

int drive(step *function, void *instance, double t, double h, int n) {
    bool event, terminate, early;
    double last;
    int failed = 0;
    for (int i = 0; i < n; i++) failed |= function(instance, t + i * h, h, true, &event, &terminate, &early, &last);
    return failed;
}
"""


class Stepped:
    """A function with the signature of fmi3DoStep, and what it steps."""

    def __init__(self, function: Any, instance: int | None, drive: Any):
        bools, double = ctypes.POINTER(ctypes.c_bool), ctypes.POINTER(ctypes.c_double)
        function.argtypes = [
            *(ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool),
            *(bools, bools, bools, double),
        ]
        self.function, self.instance, self.drive, self.done = function, ctypes.c_void_p(instance), drive, 0

    def from_python(self) -> float:
        """Return the seconds that a step takes."""
        function, instance, h, keep = self.function, self.instance, ctypes.c_double(TICK), ctypes.c_bool(True)
        flag, last = ctypes.pointer(ctypes.c_bool()), ctypes.pointer(ctypes.c_double())
        times = [ctypes.c_double((self.done + k) * TICK) for k in range(CALLS)]
        failed = 0
        started = time.perf_counter()
        for t in times:
            failed |= function(instance, t, h, keep, flag, flag, flag, last)
        return self._after(time.perf_counter() - started, failed)

    def from_c(self) -> float:
        """Return the seconds that a step takes."""
        now, h = ctypes.c_double(self.done * TICK), ctypes.c_double(TICK)
        started = time.perf_counter()
        failed = self.drive(self.function, self.instance, now, h, CALLS)
        return self._after(time.perf_counter() - started, failed)

    def _after(self, elapsed: float, failed: int) -> float:
        if failed:
            raise SystemExit("a step failed")
        self.done += CALLS
        return elapsed / CALLS


def exported(path: Path, folder: Path, force: tuple[float, float]) -> tuple[fmpy.fmi3.FMU3Slave, list[int]]:
    """Return the FMU in Step Mode, and what to read: position and velocity."""
    description = fmpy.read_model_description(str(path))
    references = {v.name: v.valueReference for v in description.modelVariables}
    fmpy.extract(str(path), str(folder))
    fmu = fmpy.fmi3.FMU3Slave(
        guid=description.guid, unzipDirectory=str(folder), modelIdentifier="gantry", instanceName="gantry"
    )
    fmu.instantiate()
    fmu.enterInitializationMode()
    fmu.setFloat64([references["motor_force"]], force)
    fmu.exitInitializationMode()
    return fmu, [references[name] for name in ("position", "velocity")]


def steps(folder: Path, label: str, force: tuple[float, float]) -> None:
    """Compare one doStep with the function written by hand."""
    fmu, read = exported(gantry.build(), folder / "fmu", force)
    suffix = SUFFIXES[native_platform().rpartition("-")[2]]
    compile_shared({"by_hand.c": HAND_WRITTEN}, folder / f"by_hand{suffix}")
    library = ctypes.CDLL(str(folder / f"by_hand{suffix}"))
    g = gantry.nominal
    table = [g.translational_mass, g.equivalent_mass, g.coulomb_friction, g.viscous_friction]
    scales = [g.coulomb_scale, g.viscous_scale, g.friction_width, g.gravity, gantry.INTERNAL_STEP]
    start = [*g.start_position, *g.start_velocity, 0.0, 0.0]
    values = np.concatenate([start, force, (0.0, 0.0), *table, scales])
    # FMPy's functions check what comes back, in Python; the library's own, loaded once more, is the same one, bare
    fmu_step = Stepped(ctypes.CDLL(fmu.dll._name).fmi3DoStep, fmu.component, library.drive)
    by_hand = Stepped(library.by_hand, values.ctypes.data, library.drive)
    report = []
    for way in (Stepped.from_python, Stepped.from_c):
        way(fmu_step), way(by_hand)
        turns = np.array([(way(fmu_step), way(by_hand)) for _ in range(TURNS)])
        ns = turns.min(axis=0) * 1e9
        report.append(f"{way.__name__.replace('_', ' ')} {ns[0]:.0f} / {ns[1]:.0f} ns, ratio {ns[0] / ns[1]:.3f}")
    found, expected = np.array(fmu.getFloat64(read, 4)), values[:4]
    apart = np.max(np.abs(found - expected) / np.abs(expected))
    if not apart < 1e-9:
        raise SystemExit(f"the two don't compute the same: {found} and {expected}")
    fmu.terminate()
    fmu.freeInstance()
    print(f"{label:8} {'; '.join(report)}; results {apart:.0e} apart")


def exports(folder: Path) -> None:
    """Time an export: cold, warm, and from the cache."""
    os.environ["LOOPWRIGHT_CACHE"] = str(folder / "cache")
    for label, path, internal_step in (("cold", "a", 1e-4), ("warm", "b", 2e-4), ("cached", "c", 2e-4)):
        started = time.perf_counter()
        gantry.build(out=folder / f"{path}.fmu", internal_step=internal_step)
        print(f"export, {label:7} {time.perf_counter() - started:6.2f} s")


def main() -> None:
    """Print all."""
    compiler = find_compiler()
    print(f"{compiler.identity.splitlines()[0]} {' '.join(flags(native_platform(), zig=compiler.zig))}")
    with tempfile.TemporaryDirectory() as folder:
        for label, force in FORCES.items():
            steps(Path(folder) / label, label, force)
        exports(Path(folder))


if __name__ == "__main__":
    main()
