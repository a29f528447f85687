"""SSPs of other tools, run by Loopwright and by other readers: python benchmarks/foreign_ssps.py FILE ... --step 0.01.

FILE is an .ssp, or a folder with SystemStructure.ssd and the files next to it. The readers are FMPy, ecos (ecospy) and
libcosim (libcosimpy); one that isn't installed is left out. Each run has its own process and a time limit. A line
for each reader says how many outputs of the FMUs, of type real, have the same bits at the end, and the largest
difference, relative to 1 + the value. Without FILE a small SSP of our own is run.

An FMU is a program: run those of strangers without a network, `unshare -rn python benchmarks/foreign_ssps.py ...`.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import zipfile
from importlib.util import find_spec
from pathlib import Path

READERS = {"loopwright": "loopwright", "fmpy": "fmpy", "ecos": "ecospy", "libcosim": "libcosimpy"}
"""Readers, and the packages that they need."""
SECONDS = 120


def main() -> None:
    """Run files in all readers, and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE")
    parser.add_argument("--step", type=float, default=0.01, help="communication step in s (default: 0.01)")
    parser.add_argument("--stop", type=float, default=1.0, help="end of the runs in s (default: 1)")
    parser.add_argument("--set", default="", metavar="NAME", help="parameter set that ecos is asked to apply")
    parser.add_argument("--reader", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.reader:
        names = json.loads(sys.stdin.read())
        print("OUT", json.dumps(_OF[given.reader](given.files[0], given, names)))
        return
    with tempfile.TemporaryDirectory() as folder:
        for file in given.files or [own_file(Path(folder))]:
            compare(str(file), given, Path(folder))


def own_file(folder: Path) -> Path:
    """Write an SSP of two masses that a spring joins."""
    from loopwright import Diagram, Fmu
    from loopwright.fmus import mass_spring_damper

    file = mass_spring_damper.build(fmi=2)
    a, b = Fmu(file, name="a"), Fmu(file, name="b", start={"mass": 2.0})
    return Diagram("two", a(force=5.0 * b.position), b(force=20.0 * a.position)).to_ssp(folder / "two.ssp", flat=True)


def compare(file: str, given: argparse.Namespace, folder: Path) -> None:
    """Run a file in all readers, and print how they agree with Loopwright."""
    packed = Path(file)
    if packed.is_dir():
        packed = folder / "packed.ssp"
        with zipfile.ZipFile(packed, "w") as archive:
            for path in Path(file).rglob("*"):
                if path.is_file() and path.suffix != ".ssp":
                    archive.write(path, path.relative_to(file))
    print(file)
    ours: dict[str, float] = {}
    for reader, package in READERS.items():
        if find_spec(package) is None:
            print(f"  {reader:10s} is not installed")
            continue
        found = run(reader, str(packed) if reader == "fmpy" else file, given, [*ours])
        if isinstance(found, str):
            print(f"  {reader:10s} {found[:200]}")
        elif reader == "loopwright":
            ours = found
            print(f"  {reader:10s} {len(ours)} outputs")
        else:
            known = [name for name in ours if name in found]
            same = sum(ours[name] == found[name] for name in known)
            worst = max((abs(ours[n] - found[n]) / (1.0 + abs(ours[n])) for n in known), default=0.0)
            print(f"  {reader:10s} {same} of {len(known)} have the same bits, largest difference {worst:.2g}")


def run(reader: str, file: str, given: argparse.Namespace, names: list[str]) -> dict[str, float] | str:
    """Return the outputs at the end of a run in its own process, or why there are none."""
    options = ["--reader", reader, "--step", str(given.step), "--stop", str(given.stop), "--set", given.set]
    try:
        done = subprocess.run(
            [sys.executable, __file__, file, *options],
            input=json.dumps(names),
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no end within {SECONDS} s"
    lines = [line for line in done.stdout.splitlines() if line.startswith("OUT ")]
    if lines:
        found: dict[str, float] = json.loads(lines[0][4:])
        return found
    said = [line for line in done.stderr.splitlines() if line.strip()]
    return f"ended by signal {-done.returncode}" if done.returncode < 0 else said[-1] if said else "failed"


def _loopwright(file: str, given: argparse.Namespace, names: list[str]) -> dict[str, float]:
    from loopwright import Diagram, Fmu

    diagram = Diagram.from_ssp(file)
    record = diagram.simulate(given.stop, step=given.step, progress=False)
    found = {}
    for path, block in diagram.blocks.items():
        for name, variable in block.description.scalars.items() if isinstance(block, Fmu) else ():
            if variable.causality == "output" and variable.type == "Float64":
                array = re.fullmatch(r"(.*)\[(\d+)\]", name)
                full = f"{path}.{name}"
                if full in record:
                    found[full] = float(record[full][-1])
                elif array and f"{path}.{array[1]}" in record:
                    found[full] = float(record[f"{path}.{array[1]}"][-1][int(array[2]) - 1])
    return found


def _fmpy(file: str, given: argparse.Namespace, names: list[str]) -> dict[str, float]:
    from fmpy.ssp.simulation import simulate_ssp

    record = simulate_ssp(file, stop_time=given.stop - given.step / 2, step_size=given.step)
    return {name: float(record[name][-1]) for name in names if name in record.dtype.names}


def _ecos(file: str, given: argparse.Namespace, names: list[str]) -> dict[str, float]:
    import ctypes

    tbb = Path(sys.prefix) / "lib" / "libtbb.so.12"
    if tbb.exists():  # where no loader looks
        ctypes.CDLL(str(tbb), ctypes.RTLD_GLOBAL)
    import ecospy

    found = {}
    with ecospy.EcosSimulation(given.step, ssp_path=file) as simulation:
        if not simulation.init(parameter_set=given.set or None):
            raise RuntimeError(ecospy.EcosLib.get_last_error())
        simulation.step(round(given.stop / given.step))
        for name in names:
            try:
                found[name] = simulation.get_real(name.replace(".", "::", 1))
            except Exception:  # of a system within the root, which ecos has not
                continue
        simulation.terminate()
    return found


def _libcosim(file: str, given: argparse.Namespace, names: list[str]) -> dict[str, float]:
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver

    execution = CosimExecution.from_ssp_file(file, round(given.step * 1e9))
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    if not execution.step(round(given.stop / given.step)):
        raise RuntimeError("a step failed")
    found = {}
    for slave in execution.slave_infos():
        known = {v.name.decode(): v.reference for v in execution.slave_variables(slave.index)}
        for name in names:
            element, _, variable = name.partition(".")
            if element == slave.name.decode() and variable in known:
                found[name] = observer.last_real_values(slave.index, [known[variable]])[0]
    return found


_OF = {"loopwright": _loopwright, "fmpy": _fmpy, "ecos": _ecos, "libcosim": _libcosim}

if __name__ == "__main__":
    main()
