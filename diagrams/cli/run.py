"""The command ``loopwright run``: a diagram of a user's, or experiments of the paper."""

from __future__ import annotations

import argparse

from ...blocks.core import OptionError
from ..paper import DEFINITIONS
from .command import Argument, Command, argument, repeated
from .command_arguments import PLANT, as_json, duration, experiment_option, set_parameters, solver, step
from .options_of_experiments import option_lines
from .run_diagram import run_diagram
from .run_experiments import run_experiments
from .subjects import is_user_file

_OF_EXPERIMENTS = (
    PLANT,
    repeated(
        "--rename",
        "NAME=PORT",
        "the plant's name of a port, and the name that Fig. 3 has for it, such as 's_y=position[1]'; repeat it "
        "for several",
        dest="renames",
    ),
    experiment_option("an option of the experiments"),
)
_HEADING = "of FILE.py:NAME"
_OF_DIAGRAMS = (
    duration("simulated time in s (experiments: theirs)", heading=_HEADING),
    set_parameters(heading=_HEADING),
    step(heading=_HEADING),
    solver("solver of the continuous part, such as RK45", heading=_HEADING),
    as_json("the results", heading=_HEADING),
)


def _run(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright run``, for a diagram or for experiments; options of the other kind are errors."""
    files = [given for given in arguments.letters if is_user_file(given)]
    if not files:
        _refuse(_OF_DIAGRAMS, arguments, "it is for diagrams, FILE.py:NAME; experiments have --option.")
        return run_experiments(arguments.letters, arguments)
    if len(arguments.letters) > 1:
        raise OptionError(f"found {' '.join(arguments.letters)}; expected one diagram. Run them one by one.")
    _refuse(_OF_EXPERIMENTS, arguments, "it is for experiments; write --set PATH=VALUE for a diagram.")
    return run_diagram(files[0], arguments)


def _refuse(options: tuple[Argument, ...], arguments: argparse.Namespace, text: str) -> None:
    """Raise an OptionError for the first of these options that is given."""
    for option in options:
        if getattr(arguments, option.destination):
            raise OptionError(text, port=option.names[0])


_WIDTH = max(len(name) for name in DEFINITIONS)
RUN = Command(
    name="run",
    help="run a diagram of yours, or the experiments of the paper",
    usage="loopwright run FILE.py:NAME --duration S [options]\n       loopwright run [LETTER ...] [options]",
    description="Run a diagram of yours, FILE.py:NAME, where NAME may be a function that returns one. Writes all\n"
    "samples (NAME.csv), a summary (NAME.json) and a figure of the named wires (NAME.png, .svg) to the\n"
    "folder --out, and prints the named wires.\n\n"
    "Or run experiments of the paper: A path following, B compliance, C hand guiding, D force tracking.\n"
    "Writes the samples (A.csv), the key numbers (A.json, SI units) and two figures (A_path, A_signals;\n"
    ".png and .svg) of each, in place of an earlier run's. A run that fails writes its record until then, and the\n"
    'reason ("error" in A.json). A run without a record writes nothing, and an earlier run\'s files stay.',
    examples=(
        "run loop.py:loop --duration 2",
        "run loop.py:loop --duration 2 --set pid.kp=3 --json",
        "run C --option tool_mass=0.3 --option delay=1",
    ),
    notes="options of experiments (--option), with their defaults:\n  "
    + "\n  ".join(option_lines())
    + "\n  An option that only some experiments have is given to those.\n\nkey numbers:\n"
    + "\n".join(f"  {name:{_WIDTH}}  [{unit}] {text}" for name, (unit, text) in DEFINITIONS.items())
    + '\n  In A.json a number that does not exist is null; "never" lists the settling times without end.',
    exit_status={
        0: "done",
        1: "a run failed, or a plant could not be built",
        2: "wrong usage; nothing was run",
        130: "interrupted (Ctrl-C); the record until then is written",
    },
    arguments=(
        argument(
            "letters",
            nargs="*",
            metavar="FILE.py:NAME or LETTER",
            help="a diagram of yours, or A, B, C, D, also as A,B or AB; all four experiments without one",
        ),
        argument("--out", metavar="DIR", default="out", help="folder for the files (default: out)"),
        *_OF_EXPERIMENTS,
        *_OF_DIAGRAMS,
    ),
    carry_out=_run,
)
