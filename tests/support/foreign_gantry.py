"""The gantry of Table II, exported by other tools: PythonFMU (FMI 2.0), PythonFMU3 (FMI 3.0), CasADi (model exchange).

The equations are written out once more, in plain Python, and know nothing of Loopwright. PythonFMU's FMUs take the
classical Runge-Kutta step of the plant's own build, 0.2 ms, so that both take the operations of one method.
"""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

_EQUATIONS = """
import math

MASS, COULOMB, VISCOUS, WEIGHT = (36.87, 21.20), (65.42, 37.69), (175.93, 62.83), (0.0, 9.81 * 4.41)


class Plant:
    def __init__(self):
        self.u, self.f, self.s, self.v = [0.0, 0.0], [0.0, 0.0], [0.8, 0.5], [0.0, 0.0]

    def acceleration(self, i, v):
        friction = COULOMB[i] * math.tanh(v / 0.01) + VISCOUS[i] * v
        return (self.u[i] + self.f[i] - friction - WEIGHT[i]) / MASS[i]

    def advance(self, t, h):
        n = max(1, round(5000.0 * h))
        d = h / n
        for i in (0, 1):
            s, v = self.s[i], self.v[i]
            for _ in range(n):
                a1 = self.acceleration(i, v)
                v2 = v + d / 2 * a1
                a2 = self.acceleration(i, v2)
                v3 = v + d / 2 * a2
                a3 = self.acceleration(i, v3)
                v4 = v + d * a3
                a4 = self.acceleration(i, v4)
                s, v = s + d / 6 * (v + 2 * v2 + 2 * v3 + v4), v + d / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            self.s[i], self.v[i] = s, v
"""
_FMI2 = """
from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Real


class OtherGantry(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.plant = p = Plant()
        for name, values, causality in (
            ("motor_force", p.u, "input"), ("external_force", p.f, "input"), ("position", p.s, "output"),
            ("velocity", p.v, "output"),
        ):
            for i in (0, 1):
                initial = Fmi2Initial.exact if causality == "output" else None
                self.register_variable(Real(f"{name}[{i + 1}]", causality=Fmi2Causality[causality], initial=initial,
                    getter=lambda w=values, i=i: w[i], setter=lambda x, w=values, i=i: w.__setitem__(i, x)), nested=False)
        for i in (0, 1):
            self.register_variable(Real(f"acceleration[{i + 1}]", causality=Fmi2Causality.output,
                getter=lambda i=i: p.acceleration(i, p.v[i])), nested=False)

    def do_step(self, t, h):
        self.plant.advance(t, h)
        return True
"""
_FMI3 = """
import numpy as np
from pythonfmu3 import Dimension, Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Status, Fmi3StepResult, Fmi3Variability, Float64


class OtherGantry(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.plant = p = Plant()
        self.time = 0.0
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous))
        for name, values, causality in (
            ("motor_force", p.u, "input"), ("external_force", p.f, "input"), ("position", p.s, "output"),
            ("velocity", p.v, "output"),
        ):
            initial = Fmi3Initial.exact if causality == "output" else None
            self.register_variable(Float64(name, causality=Fmi3Causality[causality], initial=initial,
                variability=Fmi3Variability.continuous, dimensions=[Dimension(start="2")],
                getter=lambda w=values: list(w), setter=lambda x, w=values: w.__setitem__(slice(None), list(x))))
        self.register_variable(Float64("acceleration", causality=Fmi3Causality.output, initial=Fmi3Initial.calculated,
            variability=Fmi3Variability.continuous, dimensions=[Dimension(start="2")],
            getter=lambda: [p.acceleration(i, p.v[i]) for i in (0, 1)]))

    def do_step(self, t, h):
        self.plant.advance(t, h)
        self.time = t + h
        return Fmi3StepResult(status=Fmi3Status.ok)
"""


def _build(tool, script, out, **options):
    """Run a tool's builder in a process of its own.

    An FMU of such a tool that was loaded into this process has put the tool's package that it carries before others on
    the module path; that one has no binaries to give to an archive.
    """
    code = f"import sys; from {tool}.builder import FmuBuilder; "
    code += f"FmuBuilder.build_FMU(sys.argv[1], dest=sys.argv[2], **{options!r})"
    out.mkdir()
    call = [sys.executable, "-c", code, script.name, str(out)]
    done = subprocess.run(call, cwd=script.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (made,) = out.glob("*.fmu")
    return made


def by_pythonfmu(folder):
    """Write the FMU of FMI 2.0 that PythonFMU makes of the equations."""
    script = Path(folder, "other_gantry_2.py")
    script.write_text(_EQUATIONS + _FMI2)
    return _build("pythonfmu", script, Path(folder, "fmi2"), needsExecutionTool=True)


def by_pythonfmu3(folder):
    """Write the FMU of FMI 3.0 that PythonFMU3 makes of the equations."""
    script = Path(folder, "other_gantry_3.py")
    script.write_text(_EQUATIONS + _FMI3)
    return _build("pythonfmu3", script, Path(folder, "fmi3"))


def by_casadi(folder):
    """Write the FMU of FMI 3.0 for model exchange that CasADi makes of the equations, compiled with FMPy's headers."""
    import casadi as ca
    import fmpy

    from loopwright.fmus.export.compiler import compile_shared
    from loopwright.fmus.platform import native_platform

    mass, coulomb, viscous, weight = (36.87, 21.20), (65.42, 37.69), (175.93, 62.83), (0.0, 9.81 * 4.41)
    dae = ca.DaeBuilder("casadi_gantry", "")
    u, f = ([dae.add(f"{name}[{i}]", "input") for i in (1, 2)] for name in ("motor_force", "external_force"))
    s = [
        dae.add(f"position[{i + 1}]", "output", {"start": start, "initial": "exact"})
        for i, start in enumerate((0.8, 0.5))
    ]
    v = [dae.add(f"velocity[{i}]", "output", {"start": 0.0, "initial": "exact"}) for i in (1, 2)]
    for i in (0, 1):
        a = (u[i] + f[i] - coulomb[i] * ca.tanh(v[i] / 0.01) - viscous[i] * v[i] - weight[i]) / mass[i]
        dae.eq(dae.der(s[i]), v[i])
        dae.eq(dae.der(v[i]), a)
        dae.eq(dae.add(f"acceleration[{i + 1}]", "output"), a)
    folder = Path(folder, "casadi")
    folder.mkdir()
    before = Path.cwd()
    os.chdir(folder)  # it writes there
    try:
        files = dae.export_fmu({"no_warning": True})
    finally:
        os.chdir(before)
    sources = {name: (folder / name).read_text() for name in files if name.endswith((".c", ".h"))}
    library = folder / "casadi_gantry.so"
    compile_shared(sources, library, include=[Path(fmpy.__file__).parent / "c-code"])
    path = folder / "casadi_gantry.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        for name, place in files.items():
            archive.write(folder / name, str(Path(place)))
        archive.write(library, f"binaries/{native_platform()}/casadi_gantry.so")
    return path
