"""FMUs of other tools, run by Loopwright and by FMPy: python benchmarks/foreign_fmus.py FOLDER --page PAGE.md.

FOLDER has one folder for each source of FMUs; without one, two FMUs of the library are in. Each run has a process of
its own, an empty working folder and a time limit. Both importers take the FMU's default stop time and step, at most
`STEPS` steps, and its start values; inputs without one are 0. ``--table`` has a row for each FMU and interface that
differ. ``--page`` writes counts, and the differences by their reasons (`REASONS`), between two marks of a page.

An FMU is a program: run those of strangers without a network, `unshare -rn python benchmarks/foreign_fmus.py …`.
"""

from __future__ import annotations

import argparse
import atexit
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from loopwright.fmus import dc_motor
from loopwright.fmus.platform import native_platform

STEPS = 200
CLOSE = 1e-9
"""Difference of two runs, relative to the signal's size, up to which they agree."""
MARKS = "<!-- written by benchmarks/foreign_fmus.py -->", "<!-- up to here -->"
REASONS = (
    (
        "rollback-",
        "",
        (
            "it wants its state of before restored before a shorter step; Loopwright continues from its "
            "`lastSuccessfulTime`"
        ),
    ),
    (
        "cannot open shared object file",
        "",
        (
            "shared libraries of another system are missing (`libgfortran.so.3` or `.so.4`, `libpython3.7m.so.1.0`, "
            "`libpython3.9.so.1.0`); the error and `loopwright doctor` name them"
        ),
    ),
    ("ModuleNotFoundError", "", "it is a Python program whose modules are not in it; the error names them"),
    (
        "Cannot find shared library",
        "CoSimulation",
        "the library is not named for the model identifier; it is the only one in its folder",
    ),
    ("uart", "", "the library lacks `fmi2DeSerializeFMUstate`, which no run calls"),
    (
        "FMI4j.*BouncingBall",
        "",
        (
            "a variable is parameter and constant at once: a rule broken, and no reason not to run; `run.messages` "
            "says it"
        ),
    ),
    (
        "only outputs that no wire carries",
        "CoSimulation",
        "its outputs are binary data and clocks: no signal of a diagram",
    ),
    ("altairengineering", "CoSimulation", "it wants Event Mode, which Loopwright uses where an FMU has clocks"),
    (
        "FMPy/.*(Controller|Drivetrain)",
        "ModelExchange",
        "nominal values of 0; 1 replaces them, and `run.messages` says it",
    ),
    ("Reference-FMUs.*Roberts", "ModelExchange", "stiff: Loopwright changes to an implicit method of its own accord"),
    (
        "MassSpringDamper|[Tt]hreetank|[Tt]hreewatertank",
        "CoSimulation",
        (
            "the FMU compares sums of rounded times, and takes an internal step more or less in some steps, at other "
            "places for each importer"
        ),
    ),
    (
        "(Consumer|ECS_HW|FS_OPSC)[.]fmu",
        "CoSimulation",
        (
            "its own solver, at a tolerance of 1e-4, follows the last bits of the times: FMPy's calls at Loopwright's "
            "communication points give Loopwright's bits, those at FMPy's give FMPy's"
        ),
    ),
    (
        "watertankController-Standalone",
        "CoSimulation",
        (
            "it counts a step in whole nanoseconds, cut off, and discards those of FMPy that end a bit below; FMPy "
            "repeats them without end, while Loopwright's steps are of one length"
        ),
    ),
    ("PumpAndValve", "", "its output `CPUtime` is the time that it took"),
    ("OSMP", "CoSimulation", "its outputs are addresses in memory"),
    (
        "Sensor_Block",
        "CoSimulation",
        "an output in 255 steps differs by one of them: its rounding follows the last bits of the times",
    ),
    (
        "FMI4j.*VanDerPol|periodic_clock",
        "ModelExchange",
        (
            "two solvers at a tolerance of 1e-8: against a run at 1e-12 Loopwright is off by 7e-8, CVODE in FMPy by "
            "2.4e-6"
        ),
    ),
    ("Feedthrough", "ModelExchange", "it refuses the start value of an input ahead of Initialization Mode"),
    ("periodic_clock", "CoSimulation", "it wants Event Mode, which Loopwright uses where an FMU has clocks"),
    ("fmi3functiontest", "", "FMI 3.0-beta.3"),
    ("ModelicaGym_CartPole", "", "it crashes in its instantiation: it requires a licence"),
    ("DYMOLA_RUNTIME_LICENSE", "", "it requires a licence"),
    ("LBNL71T_Emulation_Dymola|WeatherProcessor_Dymola", "", "it requires a licence"),
    (
        "fuelrail.* runs runs$",
        "CoSimulation",
        "its own solver follows the last bits of the times, as those of OMSimulator's FMUs do",
    ),
    (
        "fuelrail",
        "CoSimulation",
        "slow: 23 s of processor time with either importer, so the load of the machine decides",
    ),
    ("OSOM", "CoSimulation", "slow with either importer: 0.04 s of processor time for 0.5 s of 3500 s"),
    ("Roberts", "CoSimulation", "slow with either importer: its own step is 1e-3 s, its default stop time 1e8 s"),
)
"""Reasons of differences: a pattern for source, file and outcomes, an interface or none, and the reason."""
FOLDERS = {"x86_64-linux": ("linux64",), "x86_64-windows": ("win64",), "x86_64-darwin": ("darwin64",)}
"""Folders of libraries in FMI 1.0 and 2.0, for those of FMI 3.0."""
INTERFACES = {"CoSimulation": "co_simulation", "ModelExchange": "model_exchange"}


@dataclass
class Facts:
    """Facts of a description that both importers are run with, read without either of them."""

    fmi: str
    tool: str
    interfaces: list[str]
    stop: float
    step: float
    names: list[str]
    """Variables to compare: outputs with numbers, or else the first real local variables."""
    has_outputs: bool
    inputs: dict[str, str]
    """Start values of the inputs with numbers, as texts; 0 where there is none."""


def read_facts(file: str) -> Facts:
    """Read a description of FMI 1.0, 2.0 or 3.0."""
    with zipfile.ZipFile(file) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    fmi = root.get("fmiVersion", "?")
    if fmi.startswith("1"):
        interfaces = ["ModelExchange"] if root.find("Implementation") is None else ["CoSimulation"]
    else:
        interfaces = [name for name in INTERFACES if root.find(name) is not None]
    stop, step = plan(root.find("DefaultExperiment"))
    outputs, reals, inputs = [], [], {}
    for element in root.find("ModelVariables") or ():
        v = element if fmi.startswith("3") else next(iter(element), element)
        name, causality, kind = element.get("name", ""), element.get("causality", "local"), v.tag
        if kind in ("String", "Binary", "Clock"):
            continue
        if causality == "output":
            outputs.append(name)
        elif causality == "input":
            inputs[name] = v.get("start") or ("1" if kind == "Enumeration" else "0")
        elif element.get("variability") in ("parameter", "constant", "fixed", "tunable"):
            continue
        elif causality in ("local", "internal") and kind in ("Real", "Float64"):
            reals.append(name)
    return Facts(
        fmi,
        (root.get("generationTool") or "").strip(),
        interfaces,
        stop,
        step,
        outputs or reals[:10],
        bool(outputs),
        inputs,
    )


def plan(experiment: ElementTree.Element | None) -> tuple[float, float]:
    """Return stop time and step in s, from a default experiment; both importers start at 0."""
    given = {} if experiment is None else experiment.attrib
    stop, step = (float(given.get(name, "nan")) for name in ("stopTime", "stepSize"))
    stop = stop if math.isfinite(stop) and stop > 0.0 else 1.0
    if not 0.0 < step <= stop:
        step = float(f"{stop / STEPS:.6g}")
    return round(min(STEPS, max(1, round(stop / step))) * step, 12), step


def run_fmpy(file: str, interface: str) -> dict[str, np.ndarray]:
    """Run by FMPy and return t and the recorded signals.

    It gets no tolerance, as Loopwright gives none: FMPy would take that of the default experiment, and FMUs with a
    solver of variable step compute other digits.
    """
    import fmpy

    facts, about = read_facts(file), fmpy.read_model_description(file, validate=False)
    if about.defaultExperiment and interface == "CoSimulation":
        about.defaultExperiment.tolerance = None
    types = {v.name: v.type for v in about.modelVariables}
    start = {name: text == "true" if types[name] == "Boolean" else text for name, text in facts.inputs.items()}
    options = {"relative_tolerance": 1e-8} if interface == "ModelExchange" else {}
    result = fmpy.simulate_fmu(
        file,
        validate=False,
        start_time=0.0,
        stop_time=facts.stop,
        output_interval=facts.step,
        fmi_type=interface,
        output=facts.names,
        record_events=False,
        start_values=start,
        model_description=about,
        **options,
    )
    return {"time_": result["time"], **{name: result[name] for name in result.dtype.names[1:]}}


def run_loopwright(file: str, interface: str) -> dict[str, np.ndarray]:
    """Run by Loopwright, in a diagram of the FMU alone, and return t and the recorded signals."""
    from loopwright.diagrams import Diagram
    from loopwright.fmus import Fmu

    facts = read_facts(file)
    options = {} if facts.has_outputs else {"ports": [*facts.inputs, *facts.names]}
    if "interface" in Fmu.__annotations__:
        options["interface"] = INTERFACES[interface]
    elif interface != "CoSimulation":
        raise NotImplementedError("this version runs co-simulation only")
    plain = Fmu(file, name="fmu", **options)
    values = {name: np.zeros(v.shape) if v.start is None else v.start for name, v in plain.input_variables.items()}
    block = Fmu(file, name="fmu", **options, start=values)
    solver = {"rtol": 1e-8} if interface == "ModelExchange" else {}
    run = Diagram("alone", block()).simulate(facts.stop, step=facts.step, progress=False, **solver)
    found = {"time_": run.t}
    elements = block.description.elements
    for port, v in block.output_variables.items():
        signal = np.asarray(run[f"fmu.{port}"], dtype=float)
        scalars = {index: name for name, (array, index) in elements.items() if array == v.name}
        if v.shape and scalars:
            found |= {name: signal[(slice(None), *index)] for index, name in scalars.items()}
        else:
            found[v.name] = signal
    return found


TOOLS = {"Loopwright": run_loopwright, "FMPy": run_fmpy}


def one(tool: str, interface: str, file: str, out: str) -> None:
    """Run one FMU with one importer, and write the signals to a file; an error ends the process with its text."""
    np.seterr(all="ignore")
    try:
        signals = TOOLS[tool](file, interface)
    except BaseException as error:
        Path(out).write_text(json.dumps({"error": f"{type(error).__name__}: {error}"}))
        os._exit(1)
    np.savez(out + ".npz", **{name.replace("/", "\\"): np.asarray(v, dtype=float) for name, v in signals.items()})
    os._exit(0)  # a library that crashes at the end of the process has done its run


def outcome(tool: str, interface: str, file: Path, seconds: float) -> tuple[str, dict[str, np.ndarray]]:
    """Return "runs", or the reason why not, and the signals of one run in its own process."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        out = Path(folder, "out.json")
        work = Path(folder, "work")
        work.mkdir()
        command = [sys.executable, __file__, "--one", tool, interface, str(file), str(out)]
        try:
            done = subprocess.run(command, cwd=work, timeout=seconds, capture_output=True, check=False)
        except subprocess.TimeoutExpired:
            return f"no end within {seconds:g} s", {}
        npz = Path(f"{out}.npz")
        if npz.exists():
            with np.load(npz) as data:
                return "runs", {name.replace("\\", "/"): data[name] for name in data.files}
        if out.exists():
            return json.loads(out.read_text())["error"], {}
        return f"process ended by signal {-done.returncode}" if done.returncode < 0 else "process ended", {}


def compare(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> tuple[float, str]:
    """Return the largest difference, relative to the signal's size, at times of both, and its signal."""
    worst, where = 0.0, ""
    t, other = ours["time_"], theirs["time_"]
    places = np.searchsorted(other, t - 1e-9 * (1.0 + np.abs(t)))
    places = np.minimum(places, len(other) - 1)
    common = np.abs(other[places] - t) <= 1e-9 * (1.0 + np.abs(t))
    if not common.any():
        return math.nan, "no time in common"
    for name in (ours.keys() & theirs.keys()) - {"time_"}:
        a, b = ours[name].reshape(len(t), -1)[common], theirs[name].reshape(len(other), -1)[places[common]]
        if a.shape != b.shape:
            return math.nan, f"{name}: shapes {a.shape[1:]} and {b.shape[1:]}"
        gap = np.where(np.isnan(a) & np.isnan(b), 0.0, np.abs(a - b))
        size = max(float(np.nanmax(np.abs(b), initial=0.0)), 1e-12)
        if not (found := float(np.max(gap, initial=0.0)) / size) <= worst:
            worst, where = found, name
    return worst, where


def study(file: Path, seconds: float) -> list[dict[str, object]]:
    """Return a row for each interface of an FMU."""
    try:
        facts = read_facts(str(file))
    except Exception as error:  # both importers say their own word
        facts = Facts("?", f"{type(error).__name__}", ["CoSimulation"], 1.0, 0.01, [], True, {})
    rows = []
    for interface in facts.interfaces:
        ours, mine = outcome("Loopwright", interface, file, seconds)
        fmpy_says, other = outcome("FMPy", interface, file, seconds)
        gap, where = compare(mine, other) if mine and other else (None, "")
        rows.append(
            {
                "fmi": facts.fmi,
                "tool": facts.tool,
                "interface": interface,
                "ours": ours,
                "fmpy": fmpy_says,
                "gap": gap,
                "where": where,
            }
        )
    return rows


def as_table(rows: list[dict[str, object]]) -> str:
    """Return two tables as Markdown: counts for each source, and the runs in which the importers differ."""
    lines = ["| source | tools | FMI | run here | run in FMPy | of | agree |", "|---|---|---|---|---|---|---|"]
    for source in dict.fromkeys(row["source"] for row in rows):
        here = [row for row in rows if row["source"] == source]
        tools = ", ".join(sorted({short_name(str(row["tool"])) for row in here}))
        versions = ", ".join(sorted({str(row["fmi"]) for row in here}))
        both = [row for row in here if row["gap"] is not None]
        counts = [sum(row[importer] == "runs" for row in here) for importer in ("ours", "fmpy")]
        close = sum(agrees(row) for row in both)
        lines.append(
            f"| {source} | {tools} | {versions} | {counts[0]} | {counts[1]} | {len(here)} | {close} of {len(both)} |"
        )
    lines += ["", "| FMU | tool | FMI | Loopwright | FMPy | difference |", "|---|---|---|---|---|---|"]
    for row in rows:
        if row["ours"] == row["fmpy"] == "runs" and agrees(row):
            continue
        difference = "" if row["gap"] is None else f"{row['gap']:.1e} ({row['where']})"
        kind = {"CoSimulation": "CS", "ModelExchange": "ME"}.get(str(row["interface"]), "?")
        said = (shorten(str(row[k])) for k in ("ours", "fmpy"))
        lines.append(
            f"| {row['source']}: {row['file']} | {short_name(str(row['tool']))} | {row['fmi']} {kind} "
            f"| {' | '.join(said)} | {difference} |"
        )
    return "\n".join(lines) + "\n"


def as_page(rows: list[dict[str, object]]) -> str:
    """Return the text of the page: counts in words, those of each source, and the differences by their reasons."""
    from importlib.metadata import version

    ran = [sum(row[importer] == "runs" for row in rows) for importer in ("ours", "fmpy")]
    both = [row for row in rows if row["gap"] is not None]
    text = (
        f"Of {len(rows)} runs of {len({row['path'] for row in rows})} FMUs from {len({row['source'] for row in rows})} "
        f"sources, Loopwright completed {ran[0]}, and FMPy {version('fmpy')} {ran[1]}. In {sum(map(agrees, both))} of "
        f"the {len(both)} that both completed, they agree."
    )
    counts = as_table(rows).split("\n\n")[0]
    lines = ["| runs that differ, or fail | here | in FMPy | reason |", "|---|---|---|---|"]
    groups: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        if row["ours"] == row["fmpy"] == "runs" and agrees(row):
            continue
        kind = {"CoSimulation": "co-simulation", "ModelExchange": "model exchange"}[str(row["interface"])]
        name = f"{Path(str(row['file'])).stem} ({str(row['source']).split('/')[-1]}, FMI {row['fmi']} {kind})"
        groups.setdefault((explain(row), outline(str(row["ours"])), outline(str(row["fmpy"]))), []).append(name)
    for (reason, ours, fmpy_says), names in sorted(groups.items()):
        kept = ", ".join(f"{name} {n} times" if n > 1 else name for name, n in Counter(names).items())
        lines.append(f"| {kept} | {ours} | {fmpy_says} | {reason} |")
    return "\n\n".join([text, counts, "\n".join(lines)])


def explain(row: dict[str, object]) -> str:
    """Return the reason of a difference, as far as it is known."""
    for pattern, interface, reason in REASONS:
        if re.search(pattern, f"{row['source']}/{row['path']} {row['ours']} {row['fmpy']}") and interface in (
            "",
            row["interface"],
        ):
            return reason
    return "not known"


def outline(outcome: str) -> str:
    """Return the kind of an outcome: "runs", the end of the time, or the name of an error."""
    return outcome if outcome.startswith(("runs", "no end", "process")) else f"`{outcome.split(':')[0]}`"


def write_page(page: Path, rows: list[dict[str, object]]) -> None:
    """Write the text between the marks of a page."""
    before, rest = page.read_text().split(MARKS[0])
    page.write_text(f"{before}{MARKS[0]}\n\n{as_page(rows)}\n\n{MARKS[1]}{rest.split(MARKS[1])[1]}")


def agrees(row: dict[str, object]) -> bool:
    """Whether both runs are one, to rounding in co-simulation and to ten times the tolerance in model exchange."""
    return row["gap"] is not None and float(row["gap"]) <= (CLOSE if row["interface"] == "CoSimulation" else 1e-6)


def shorten(reason: str) -> str:
    """Return the beginning of an error, on one line and without this machine's paths."""
    line = re.sub(r"'?/[^' ]*/([^/' ]+)'?", r"\1", " ".join(reason.split()))
    return line.replace("|", "\\|")[:160]


def short_name(tool: str) -> str:
    """Return a tool's name without its version."""
    words = dict.fromkeys(re.split(r"[ /,:(]+", tool))
    skipped = {"version", "-", "compiler", "requires", "development", "inline"}
    kept = [
        word
        for word in words
        if word[-1:].isalpha() and word.lower() not in skipped and not re.match(r"\d\.|\d{4}", word)
    ]
    return " ".join(kept[:2]) or "not stated"


def collect(folder: Path, only: str) -> list[Path]:
    """Return the FMUs with a library for this machine, each content once for a source: repositories hold copies."""
    found: dict[tuple[str, str], Path] = {}
    for file in sorted(path for path in folder.rglob("*.fmu") if only in str(path)):
        content = hashlib.sha256(file.read_bytes()).hexdigest()
        if has_library(file):
            found.setdefault((file.relative_to(folder).parts[0], content), file)
    return list(found.values())


def has_library(file: Path) -> bool:
    """Whether an archive has a library for this machine; one that can't be read counts, as importers say why."""
    here = native_platform()
    folders = tuple(f"binaries/{name}/" for name in (here, *FOLDERS.get(here, ())))
    try:
        with zipfile.ZipFile(file) as archive:
            return any(name.startswith(folders) and not name.endswith("/") for name in archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return True


def main() -> None:
    """Run all FMUs of a folder, one after the other, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, help="without one: some plants of the library")
    parser.add_argument("--seconds", type=float, default=60.0, help="limit of each run")
    parser.add_argument("--only", default="", help="part of the path of the FMUs to run")
    parser.add_argument("--table", type=Path, help="file of the table, in Markdown")
    parser.add_argument("--json", type=Path, help="file of all results")
    parser.add_argument("--page", type=Path, help="page to write counts and differences into, between its marks")
    parser.add_argument(
        "--results", type=Path, help="take the results of an earlier run from its --json, and run nothing"
    )
    parser.add_argument("--one", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        return one(*given.one)
    os.nice(10)
    rows = json.loads(given.results.read_text()) if given.results else []
    if given.results:
        given.folder = Path(os.devnull)
    if given.folder is not None:
        given.folder = given.folder.resolve()  # each run has its own working folder
    else:
        given.folder = Path(tempfile.mkdtemp(prefix="loopwright-"))
        atexit.register(shutil.rmtree, given.folder, ignore_errors=True)
        for fmi in (2, 3):
            (given.folder / "loopwright+library").mkdir(exist_ok=True)
            shutil.copy(dc_motor.build(fmi=fmi), given.folder / "loopwright+library" / f"dc_motor{fmi}.fmu")
    for file in collect(given.folder, given.only):
        source = file.relative_to(given.folder).parts[0].replace("+", "/")
        for row in study(file, given.seconds):
            rows.append({"source": source, "file": file.name.split("__")[-1], "path": str(file), **row})
            print(
                f"{file.name[-50:]:50} {row['interface'][:5]} {row['fmi']:4} {str(row['ours'])[:60]!r:62} "
                f"{str(row['fmpy'])[:40]!r:42} {row['gap']}",
                flush=True,
            )
        if given.json:
            given.json.write_text(json.dumps(rows, indent=1))
        if given.table:
            given.table.write_text(as_table(rows))
    if given.page:
        write_page(given.page, rows)
    counts = Counter((row["interface"], row["ours"] == "runs", row["fmpy"] == "runs") for row in rows)
    for (interface, ours, fmpy_runs), n in sorted(counts.items(), key=str):
        print(
            f"{interface}: Loopwright {'runs' if ours else 'does not'}, FMPy {'runs' if fmpy_runs else 'does not'}: {n}"
        )
    return None


if __name__ == "__main__":
    main()
