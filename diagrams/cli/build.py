"""The command ``loopwright build``: an FMU of a plant of the library, or of a user's block, diagram or subsystem."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import pkgutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from ...blocks.core import Block, OptionError, TraceError, close_names, explain_disk_errors, near
from ...fmus.checks import INTERFACES, summarize
from ...fmus.export import build as build_model
from ...fmus.export import build_python
from ...fmus.models import gantry
from ...fmus.platform import native_platform
from ...fmus.toolchain import TARGETS
from ..exporting import name_of
from .command import Command, argument, flag, several
from .command_arguments import as_json, parse_positive
from .text import say, say_json, size_text
from .user_models import load_user_model


def plants() -> list[str]:
    """Return the names of the library's plants: the public modules of `loopwright.fmus`."""
    room = Path(gantry.__file__).parent
    return sorted(module.name for module in pkgutil.iter_modules([str(room)]) if not module.name.startswith("_"))


def _build(arguments: argparse.Namespace) -> int:
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
        say(f"loopwright: error: {error}{hint}", sys.stderr)
        return 1
    if arguments.json:
        say_json(summary)
        return 0
    say(f"{built}  ({size_text(summary['size'])})")
    say(f"FMI {summary['fmi_version']}, {' and '.join(INTERFACES[kind] for kind in summary['interfaces'])}")
    say(f"platforms: {', '.join(summary['platforms'])}")
    for note in summary["notes"]:
        say(note)
    return 0


def _build_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the given keywords for ``build``, checked against each other."""
    texts = {option.destination: option.names[0] for option in BUILD.arguments}
    keywords = texts.keys() - {"model", "out", "json", "python"}
    options = {name: value for name in texts if name in keywords and (value := getattr(arguments, name)) is not None}
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
        for name in options:
            if name not in ("name", "internal_step"):
                raise OptionError("it can't be chosen with --python. Leave it out.", port=texts[name])
    return options


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


def _notify(line: str) -> None:
    say(line, sys.stderr)


def _make_builder(block: Any, python: bool, build: Callable[..., Path], name: str, files: Iterable[Path] = ()) -> Make:
    def make(options: dict[str, Any], file: Path | None, folder: Path) -> Path:
        chosen = {"name": name, **options}
        target = file or folder / f"{chosen['name']}.fmu"
        if python:
            return build_python(block, target, files=files, notify=_notify, **chosen)
        _notify(f"tracing {chosen['name']}")
        return build(block, target, notify=_notify, **chosen)

    return make


BUILD = Command(
    name="build",
    help="build an FMU from a model",
    description="Build an FMU from a model, with co-simulation and model exchange and no Python inside.\n\n"
    f"MODEL is a plant of the library ({', '.join(plants())})\nor FILE.py:Name, a Block class of yours or an "
    "instance with its parameters,\na diagram or a subsystem.",
    examples=(
        "build gantry",
        "build tank.py:Tank --fmi 2 --platform all",
        "build loop.py:loop --subsystem controller",
    ),
    notes=f"platforms: {', '.join(TARGETS)}, all",
    exit_status="0 done, 1 the build failed; nothing is written, 2 wrong usage",
    # Options without a default are left out of the builder's keywords where they are not given.
    arguments=(
        argument("model", metavar="MODEL", help="a plant's name, or FILE.py:Name"),
        argument("--fmi", type=int, choices=(2, 3), help="version of FMI (default: 3; 2 with --python)"),
        several("--platform", "NAME", "binaries for these, or all (default: native)"),
        argument("--out", metavar="PATH", help="file (.fmu) or folder (default: the current folder)"),
        argument("--name", help="the model's name (default: the plant's, or the class's in lower case)"),
        argument(
            "--integrator",
            choices=("rk4", "dopri5", "rodas"),
            help="fixed step, adaptive, or implicit (default: rk4)",
        ),
        argument("--tolerance", type=parse_positive, help="relative tolerance of dopri5 and rodas"),
        argument("--internal-step", type=parse_positive, metavar="S", help="longest step of the integrator, in s"),
        argument("--subsystem", metavar="PATH", help="export this subsystem of a diagram"),
        several("--outside", "BLOCK", "leave out these blocks of a diagram: the plant"),
        several("--outputs", "NAME", "signals of a diagram that are outputs"),
        argument(
            "--communication", choices=("any", "ticks"), help="steps of any length, or from tick to tick (default: any)"
        ),
        argument(
            "--solver",
            metavar="NAME",
            help="of a diagram with continuous states (default: RK45; Radau if it is stiff)",
        ),
        flag("--clocks", "of a diagram in FMI 3.0: its sample times are input clocks (Event Mode)", default=None),
        flag("--own-functions", "of a diagram: sine and so on by Loopwright", default=None),
        as_json("the file and its description"),
        argument(
            "--no-arrays",
            action="store_false",
            default=None,
            dest="arrays",
            help="a scalar variable for each element of a vector",
        ),
        flag("--python", "put the Python code inside, for equations that can't be traced"),
    ),
    carry_out=_build,
    writes_at_the_end=True,
)
