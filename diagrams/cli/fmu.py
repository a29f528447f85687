"""The commands for FMUs: ``loopwright build``, ``inspect``, ``validate``, ``doctor``."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import pkgutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ...blocks.core import (
    Block,
    OptionError,
    TraceError,
    close_names,
    explain_disk_errors,
    near,
)
from ...fmus.checks import INTERFACES, summarize, validate
from ...fmus.export import build as build_model
from ...fmus.export import build_python
from ...fmus.models import gantry
from ...fmus.platform import native_platform
from ...fmus.toolchain import TARGETS
from ..exporting import name_of
from .diagrams import parse_positive
from .doctor import add_doctor, run_doctor
from .ssp import inspect_ssp
from .subjects import is_ssp
from .text import add_json, check_file, fit, say, say_json
from .user_models import load_user_model

_WIDTH = 120  # of a table that goes into a file
_MOST = 6  # numbers of a start value that are shown
_SHOWN = {"parameter", "structuralParameter", "calculatedParameter", "input", "output"}
_STATUS = "\n\nexit status: 0 done, 1 {one}, 2 wrong usage"


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands to the parser of `main`."""
    raw = argparse.RawDescriptionHelpFormatter
    build = commands.add_parser(
        "build",
        help="build an FMU from a model",
        formatter_class=raw,
        description="Build an FMU from a model, with co-simulation and model exchange and no Python inside.\n\n"
        f"MODEL is a plant of the library ({', '.join(plants())})\nor FILE.py:Name, a Block class of yours or an "
        "instance with its parameters,\na diagram or a subsystem.",
        epilog="examples:\n  loopwright build gantry\n  loopwright build tank.py:Tank --fmi 2 --platform all\n"
        "  loopwright build loop.py:loop --subsystem controller\n\n"
        f"platforms: {', '.join(TARGETS)}, all" + _STATUS.format(one="the build failed; nothing is written"),
    )
    build.add_argument("model", metavar="MODEL", help="a plant's name, or FILE.py:Name")
    build.add_argument("--fmi", type=int, choices=(2, 3), help="version of FMI (default: 3; 2 with --python)")
    build.add_argument(
        "--platform", nargs="+", action="extend", metavar="NAME", help="binaries for these, or all (default: native)"
    )
    build.add_argument("--out", metavar="PATH", help="file (.fmu) or folder (default: the current folder)")
    build.add_argument("--name", help="the model's name (default: the plant's, or the class's in lower case)")
    build.add_argument(
        "--integrator", choices=("rk4", "dopri5", "rodas"), help="fixed step, adaptive, or implicit (default: rk4)"
    )
    build.add_argument("--tolerance", type=parse_positive, help="relative tolerance of dopri5 and rodas")
    build.add_argument("--internal-step", type=parse_positive, metavar="S", help="longest step of the integrator, in s")
    build.add_argument("--subsystem", metavar="PATH", help="export this subsystem of a diagram")
    build.add_argument(
        "--outside", nargs="+", action="extend", metavar="BLOCK", help="leave out these blocks of a diagram: the plant"
    )
    build.add_argument(
        "--outputs", nargs="+", action="extend", metavar="NAME", help="signals of a diagram that are outputs"
    )
    build.add_argument(
        "--communication", choices=("any", "ticks"), help="steps of any length, or from tick to tick (default: any)"
    )
    build.add_argument(
        "--solver", metavar="NAME", help="of a diagram with continuous states (default: RK45; Radau if it is stiff)"
    )
    build.add_argument(
        "--clocks", action="store_true", help="of a diagram in FMI 3.0: its sample times are input clocks (Event Mode)"
    )
    build.add_argument(
        "--own-functions", action="store_true", default=None, help="of a diagram: sine and so on by Loopwright"
    )
    add_json(build, "the file and its description")
    build.add_argument("--no-arrays", action="store_true", help="a scalar variable for each element of a vector")
    build.add_argument(
        "--python", action="store_true", help="put the Python code inside, for equations that can't be traced"
    )
    inspect = commands.add_parser(
        "inspect",
        help="show the description of an FMU or an SSP",
        formatter_class=raw,
        description="Show the description of an FMU of any tool (FMI 1.0 to 3.0), or of an SSP, without running it.",
        epilog="examples:\n  loopwright inspect plant.fmu\n  loopwright inspect plant.fmu --json\n"
        "  loopwright inspect system.ssp" + _STATUS.format(one="it can't be read"),
    )
    inspect.add_argument("file", metavar="FILE", help="a .fmu, .ssp or .ssd")
    inspect.add_argument("--all", action="store_true", help="local variables, too")
    add_json(inspect, "the same, with all variables,")
    check = commands.add_parser(
        "validate",
        help="check an FMU and run it for some steps",
        formatter_class=raw,
        description="Check an FMU of any tool: archive, description, model structure, binaries, sources; then run each "
        "interface\nfor some steps, in its own process.",
        epilog="examples:\n  loopwright validate plant.fmu\n  loopwright validate plant.fmu --no-run"
        + _STATUS.format(one="problems were found"),
    )
    check.add_argument("file", metavar="FILE.fmu")
    check.add_argument("--no-run", action="store_true", help="don't run it: an FMU is a program of its maker's")
    add_json(check, "the problems, and what was checked,")
    add_doctor(commands)


def _complain(error: object) -> int:
    say(f"loopwright: error: {error}", sys.stderr)
    return 1


def _progress(line: str) -> None:
    say(line, sys.stderr)


# --- build ----------------------------------------------------------------------------------------------------------


def plants() -> list[str]:
    """Return the names of the library's plants: the public modules of `loopwright.fmus`."""
    room = Path(gantry.__file__).parent
    return sorted(module.name for module in pkgutil.iter_modules([str(room)]) if not module.name.startswith("_"))


def run_build(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright build``."""
    options = _build_options(arguments)
    step = "Name another folder: --out."
    with explain_disk_errors("the FMU can't be written", arguments.out or ".", step, OptionError, port="--out"):
        out = Path.cwd() if arguments.out is None else Path(arguments.out).expanduser()
        out_is_file = out.suffix.lower() == ".fmu" and not out.is_dir()
        is_other_file = out.is_file() and not out_is_file
    if is_other_file:
        raise OptionError(f"found the file {str(out)!r}; expected a folder, or a file that ends in .fmu.", port="--out")
    try:
        with _find_model(arguments) as make:
            built = make(options, out if out_is_file else None, out)
        summary = summarize(built)
    except TraceError as error:
        hint = "" if arguments.python or error.is_mistake else " Or put its Python code inside: --python."
        return _complain(f"{error}{hint}")
    if arguments.json:
        say_json(summary)
        return 0
    say(f"{built}  ({_size_text(summary['size'])})")
    say(f"FMI {summary['fmi_version']}, {' and '.join(INTERFACES[kind] for kind in summary['interfaces'])}")
    say(f"platforms: {', '.join(summary['platforms'])}")
    for note in summary["notes"]:
        say(note)
    return 0


def _build_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the given keywords for ``build``, checked against each other."""
    names: tuple[str, ...] = ("name", "integrator", "tolerance", "internal_step", "fmi", "platform")
    names += ("subsystem", "outside", "outputs", "communication", "solver", "own_functions")
    options = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    if arguments.no_arrays:
        options["arrays"] = False
    if arguments.clocks:
        options["clocks"] = True
    name = options.get("name", "model")
    if not (name.isidentifier() and name.isascii()):
        raise OptionError(f"found {name!r}; expected letters, digits and _, such as my_model.", port="--name")
    if "platform" in options:
        chosen, known = options["platform"], {*TARGETS, native_platform()}
        for platform in chosen:
            if platform not in known | {"all"}:
                raise OptionError(
                    f"there is no platform {platform!r}. {near(platform, {*known, 'all'})}", port="--platform"
                )
        options["platform"] = "all" if "all" in chosen else list(dict.fromkeys(chosen))
    if arguments.python:
        if options.pop("fmi", 2) != 2:
            raise OptionError("found 3; an FMU with Python inside is one of FMI 2.0. Give --fmi 2.", port="--fmi")
        own = ("subsystem", "outside", "outputs", "communication", "solver", "own_functions", "clocks")
        for name in ("platform", "integrator", "tolerance", "arrays", *own):
            if name in options:
                raise OptionError("it can't be chosen with --python. Leave it out.", port=_option_text(name))
    return options


def _option_text(name: str) -> str:
    return "--no-arrays" if name == "arrays" else f"--{name.replace('_', '-')}"


Make = Callable[[dict[str, Any], Path | None, Path], Path]
"""Builds an FMU and returns it: takes the options, a file or None, and the folder for ``<name>.fmu`` without a file."""


@contextlib.contextmanager
def _find_model(arguments: argparse.Namespace) -> Iterator[Make]:
    """Yield the builder of the given model."""
    text = arguments.model
    if text in plants():
        module = importlib.import_module(f"{gantry.__package__}.{text}")
        yield _make_builder(module.nominal, arguments.python, module.build, text)
    elif text.endswith(".py") or ".py:" in text:
        with load_user_model(text) as model:
            is_block = isinstance(model.block, Block)
            name = type(model.block).__name__.lower() if is_block else name_of(model.block, arguments.subsystem)
            yield _make_builder(model.block, arguments.python, build_model, name, model.imported)
    else:
        hint = near(text, plants())  # names all of them where none is close
        known = f" The plants: {', '.join(plants())}." if close_names(text, plants()) else ""
        raise OptionError(f"there is no model {text!r}. {hint}{known} A model of yours is FILE.py:Name.", port="MODEL")


def _make_builder(block: Any, python: bool, build: Callable[..., Path], name: str, files: Iterable[Path] = ()) -> Make:
    def make(options: dict[str, Any], file: Path | None, folder: Path) -> Path:
        chosen = {"name": name, **options}
        target = file or folder / f"{chosen['name']}.fmu"
        if python:
            return build_python(block, target, files=files, notify=_progress, **chosen)
        _progress(f"tracing {chosen['name']}")
        return build(block, target, notify=_progress, **chosen)

    return make


def _size_text(n: int) -> str:
    return f"{n / 1e6:.2f} MB" if n >= 1e6 else f"{n / 1e3:.1f} kB"


# --- inspect --------------------------------------------------------------------------------------------------------


def run_inspect(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright inspect``."""
    if is_ssp(arguments.file):
        return inspect_ssp(arguments.file, as_json=arguments.json)
    path = check_file(arguments.file)
    summary = summarize(path)
    if arguments.json:
        say_json(summary)
        return 0
    for label, text in _summary_lines(summary):
        say(f"{label:<15}{text}")
    for note in summary["notes"]:
        say(f"{'note':<15}{note}")
    _print_variables(summary["variables"], everything=arguments.all)
    return 0


def _summary_lines(s: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    version = f", version {s['version']}" if s["version"] else ""
    yield "model", f"{s['model_name']}{version}"
    if s["description"]:
        yield "", s["description"]
    made = f", {s['generation_date_and_time']}" if s["generation_date_and_time"] else ""
    yield "made by", f"{s['generation_tool'] or '(not said)'}{made}"
    for key in ("author", "license", "copyright"):
        if s[key]:
            yield key, s[key]
    yield "file", f"{s['file']}  ({_size_text(s['size'])})"
    yield "SHA-256", s["sha256"]
    yield "FMI", s["fmi_version"]
    for kind, attributes in s["interfaces"].items():
        flags = [
            name if value is True else f"{name} = {value}"
            for name, value in attributes.items()
            if value is not False and name != "modelIdentifier"
        ]
        yield "interface", INTERFACES[kind]
        for line in flags or ["no capability flags"]:
            yield "", f"  {line}"
    if s["default_experiment"]:
        given = s["default_experiment"]
        text = [f"{key.replace('_', ' ')} {value}{'' if key == 'tolerance' else ' s'}" for key, value in given.items()]
        yield "experiment", ", ".join(text)
    yield "platforms", ", ".join(s["platforms"]) or "none"
    native = s["native"]
    state = "there is a binary" if native["available"] else "no binary"
    yield "this machine", f"{native['platform']}: {state}"
    if native["missing_libraries"]:
        missing = ", ".join(native["missing_libraries"])
        yield "", f"its binary needs libraries that are missing here: {missing}. Install them."
    elif native["undefined_symbols"]:
        first, n = native["undefined_symbols"][0], len(native["undefined_symbols"])
        more = f" and {n - 1} more" if n > 1 else ""
        yield "", f"its binary takes symbols from the program that loads it: {first}{more}"
    yield "sources", f"{len(s['sources'])} files" if s["sources"] else "none"
    counts = Counter(v["causality"] for v in s["variables"])
    yield "variables", ", ".join(f"{n} {name}" for name, n in counts.items()) or "none"
    yield "states", f"{s['continuous_states']} continuous; {s['event_indicators']} event indicators"


def _print_variables(variables: Iterable[Mapping[str, Any]], *, everything: bool) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    chosen, hidden = [], Counter[str]()
    for v in variables:
        if everything or v["causality"] in _SHOWN or v["state"]:
            chosen.append(v)
        else:
            hidden[v["causality"]] += 1
    if chosen:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, highlight=False)
        for column in ("name", "type", "shape", "causality", "variability", "unit", "start", "description"):
            table.add_column(column, overflow="fold", no_wrap=column not in ("name", "start", "description"))
        for v in chosen:
            causality = f"{v['causality']}, state" if v["state"] else v["causality"]
            shape = "×".join("?" if n is None else str(n) for n in v["shape"])
            cells = (
                v["name"],
                v["type"],
                shape,
                causality,
                v["variability"] or "",
                v["unit"] or "",
                _start_text(v["start"]),
                v["description"],
            )
            table.add_row(*(Text(fit(cell, sys.stdout)) for cell in cells))
        Console(file=sys.stdout, width=None if sys.stdout.isatty() else _WIDTH, highlight=False).print(table)
    if hidden:
        say(f"not shown: {', '.join(f'{n} {name}' for name, n in hidden.items())}; --all shows them.")


def _start_text(value: Any) -> str:
    if value is None:
        return ""
    values = value if isinstance(value, list) else [value]
    text = ", ".join(f"{v:.9g}" if isinstance(v, float) else str(v) for v in values[:_MOST])
    return f"{text}, … ({len(values)})" if len(values) > _MOST else text


# --- validate -------------------------------------------------------------------------------------------------------


def run_validate(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright validate``."""
    path = check_file(arguments.file)
    report = validate(path, run=not arguments.no_run)
    if arguments.json:
        problems = [{"found": problem.found, "next": problem.step} for problem in report.problems]
        checked = {"checked": list(report.done), "not_checked": list(report.left)}
        say_json({"file": path, "clean": not problems, "problems": problems} | checked)
        return 1 if problems else 0
    n = len(report.problems)
    say(f"{path}: {'clean' if n == 0 else '1 problem' if n == 1 else f'{n} problems'}")
    for i, problem in enumerate(report.problems, 1):
        say(f"  {i}. {problem.found}")
        say(f"     Next: {problem.step}")
    if report.done:
        say(f"checked: {'; '.join(report.done)}")
    for line in report.left:
        say(f"not checked: {line}")
    if report.problems:
        say(f"These are departures from the standard. Whether it runs here all the same: loopwright doctor {path}")
    return 1 if report.problems else 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "build": run_build,
    "inspect": run_inspect,
    "validate": run_validate,
    "doctor": run_doctor,
}
"""The function of each command, by the command's name."""
