"""``loopwright run``: files, tables, exit statuses, and what it says when it is used wrongly."""

import io
import json
import os
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ET

import matplotlib
import numpy as np
import pytest

from loopwright.blocks import OptionError, PathDomainError
from loopwright.diagrams import Interrupted, experiments
from loopwright.diagrams.cli import run_experiments as _experiments
from loopwright.diagrams.cli.command_arguments import parse_value
from loopwright.diagrams.cli.command_line import main, make_parser
from loopwright.diagrams.paper.experiment_figures import plot_experiment, plot_path
from loopwright.diagrams.paper.experiment_numbers import DEFINITIONS, key_numbers
from loopwright.diagrams.plotting import save
from loopwright.diagrams.plotting.style import STYLE
from support.waiting import FAR

HEADER = (
    "t,eta[1],eta[2],xi[1],xi[2],position[1],position[2],velocity[1],velocity[2],force[1],force[2],"
    "motor_force[1],motor_force[2],v_par,v_perp,theta,q,eta_p[1],eta_p[2],eta_p[3],xi_p[1],xi_p[2],xi_p[3]"
)
ALL = [".csv", ".json", "_path.png", "_path.svg", "_signals.png", "_signals.svg"]


def files(folder):
    return sorted(file.name for file in folder.iterdir())


def finite(text):
    raise AssertionError(f"{text} is no strict JSON")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Run experiment A once by the command; give the folder and what the same experiment gives in Python."""
    folder = tmp_path_factory.mktemp("done") / "new" / "out"
    assert main(["run", "a", "--out", str(folder)]) == 0
    experiment = experiments.path_following()
    return folder, experiment, experiment.simulate(progress=False)


# --- what a run writes ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_samples_are_written_exactly(done):
    folder, _, run = done
    with (folder / "A.csv").open() as file:
        assert file.readline() == HEADER + "\n"
    table = np.loadtxt(folder / "A.csv", delimiter=",", skiprows=1)
    signals = [run.t[:, None], *(run[name].reshape(len(run.t), -1) for name in _experiments.SIGNALS)]
    assert table.shape == (11001, 23)
    assert np.array_equal(table, np.hstack(signals))  # 17 digits: bit for bit


@pytest.mark.slow
def test_key_numbers_are_strict_json(done):
    folder, experiment, run = done
    content = json.loads((folder / "A.json").read_text(), parse_constant=finite)
    expected = key_numbers(experiment, run)
    assert list(content) == [*DEFINITIONS, "never"]
    assert content["never"] == []
    for name in set(DEFINITIONS) - {"real_time_factor"}:
        assert content[name] == expected[name], name
    assert content["overshoot_par"] == pytest.approx(0.248935, abs=2e-3)
    assert content["offset_par"] is None
    assert content["real_time_factor"] > 0


@pytest.mark.slow
def test_figures_are_pictures_and_reproducible(done, tmp_path):
    folder, experiment, run = done
    assert files(folder) == sorted(f"A{ending}" for ending in ALL)
    again = [
        *save(plot_path(experiment, run), tmp_path / "path"),
        *save(plot_experiment(experiment, run), tmp_path / "signals"),
    ]
    for file in again:
        assert file.read_bytes() == (folder / f"A_{file.name}").read_bytes()
        if file.suffix == ".png":
            assert file.read_bytes().startswith(b"\x89PNG")
        else:
            assert ET.parse(file).getroot().tag.endswith("svg")


@pytest.mark.slow
def test_drawing_leaves_matplotlib_alone(done):
    _, experiment, run = done
    assert all(matplotlib.rcParams[name] == matplotlib.rcParamsOrig[name] for name in STYLE)  # after the command, too
    before = dict(matplotlib.rcParams)
    figure = run.plot("eta", "v_par")
    plot_path(experiment, run)
    assert dict(matplotlib.rcParams) == before
    assert [ax.get_ylabel() for ax in figure.axes] == ["eta", "v_par [m/s²]"]
    assert figure.axes[-1].get_xlabel() == "t [s]"
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["eta[1] [m]", "eta[2] [m/s]"]
    assert figure._repr_png_().startswith(b"\x89PNG")  # a notebook shows it without pyplot
    with pytest.raises(OptionError, match="found 1 axes for 2 signals"):
        run.plot("eta", "xi", axes=figure.axes[:1])


@pytest.mark.slow
def test_table_fits_eighty_columns(tmp_path, capsys, undrawn):
    assert main(["run", "D", "B", "--out", str(tmp_path), "--option", "cubic=true", "--option", "delay=1"]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    first = next(i for i, line in enumerate(lines) if "key number" in line)
    last = max(i for i, line in enumerate(lines) if line.split()[:1] and line.split()[0] in DEFINITIONS)
    table = lines[first : last + 1]  # what stands around it holds the folder's path, of any length
    assert len(table) >= 1 + len(DEFINITIONS) / 2
    assert max(map(len, table)) <= 80
    head = lines[first]
    assert head.split() == ["key", "number", "unit", "D", "B", "theory"]
    row = next(line for line in lines if "offset_perp" in line)
    assert row.split() == ["offset_perp", "mm", "-", "-25", "B:", "-25", "✓"]
    assert "force_error_final" in out
    assert all(f"{letter}{ending}" in out for letter in "DB" for ending in ALL)
    assert "B: without cubic, which only D has." in err
    assert files(tmp_path) == sorted(f"{letter}{ending}" for letter in "BD" for ending in ALL)


def test_options_change_the_run(tmp_path, capsys, undrawn):
    options = ["--option", "motor_force_limit=(300, 250)", "--option", "coulomb_scale=1.2", "--option", "delay=1"]
    assert main(["run", "A", "--out", str(tmp_path), *options]) == 0
    content = json.loads((tmp_path / "A.json").read_text())
    assert content["peak_motor_force_y"] == 300.0
    assert content["peak_motor_force_z"] == 250.0


def test_what_never_settles_is_null(tmp_path, capsys, undrawn):
    assert main(["run", "A", "--out", str(tmp_path), "--option", "motor_force_limit=5"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "settling_par" in line)
    assert row.split() == ["settling_par", "s", "never"]
    content = json.loads((tmp_path / "A.json").read_text(), parse_constant=finite)
    assert content["settling_par"] is content["offset_par"] is None
    assert content["never"] == ["settling_par", "settling_perp"]  # the offset is not there, but is not awaited either


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("300", 300),
        ("1e-6", 1e-6),
        ("(300,200)", (300, 200)),
        ("300, 200", (300, 200)),
        ("[1.5, 2]", [1.5, 2]),
        ("true", True),
        ("False", False),
        ("none", None),
        ("null", None),
        ("semi_implicit", "semi_implicit"),
        ("'a'", "a"),
        ("nan", "nan"),
        ("", ""),
    ],
)
def test_option_values(text, value):
    assert parse_value(text) == value


# --- a run that fails -----------------------------------------------------------------------------------------------


def test_a_failed_run_keeps_its_files_and_the_others_run(tmp_path, capsys, undrawn):
    (tmp_path / "B.csv").write_text("of an older run")
    assert main(["run", "B", "A", "--out", str(tmp_path), "--option", "tool_mass=5"]) == 1
    out, err = capsys.readouterr()
    assert "loopwright: experiment B failed: controller.path_projection, t = 0.02" in err
    assert "experiment A failed" not in err  # without admittance a heavy tool does no harm
    assert files(tmp_path) == sorted(f"{letter}{ending}" for letter in "AB" for ending in ALL)
    with pytest.raises(PathDomainError) as caught:
        experiments.compliance(tool_mass=5).simulate(progress=False)
    run = caught.value.run
    table = np.loadtxt(tmp_path / "B.csv", delimiter=",", skiprows=1)
    assert np.array_equal(table[:, 0], run.t)
    assert np.array_equal(table[:, 1:3], run["eta"])
    content = json.loads((tmp_path / "B.json").read_text(encoding="utf-8"), parse_constant=finite)
    assert content["error"] == str(caught.value)
    assert content["settling_par"] is None
    assert content["end_time"] == run.t[-1]
    assert "error" not in json.loads((tmp_path / "A.json").read_text())
    assert next(line for line in out.splitlines() if "key number" in line).split()[3:] == ["B", "failed", "A", "theory"]


@pytest.mark.parametrize("older", [True, False])
def test_a_run_that_fails_before_its_first_sample_leaves_an_older_ones_files(tmp_path, capsys, monkeypatch, older):
    def fail(self, **options):
        raise PathDomainError("nothing was recorded", block="controller", t=0.0)

    monkeypatch.setattr(experiments.Experiment, "simulate", fail)
    if older:
        (tmp_path / "A.csv").write_text("of an older run")
    assert main(["run", "A", "--out", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert "experiment A failed: controller, t = 0 s: nothing was recorded" in err
    kept = f"; the files of an earlier run stay in {tmp_path}" if older else ""
    assert f"A: nothing was recorded, so nothing is written{kept}.\n" in err
    assert files(tmp_path) == (["A.csv"] if older else [])
    assert not out


@pytest.mark.slow
@pytest.mark.parametrize("ticks", [0, 1])
def test_figures_of_next_to_nothing(done, tmp_path, ticks):
    from dataclasses import replace

    _, experiment, run = done
    short = replace(run, t=run.t[:ticks], data=run.data[:ticks])
    for name, figure in (
        ("p", plot_path(experiment, short)),
        ("s", plot_experiment(experiment, short)),
        ("r", short.plot("xi")),
    ):
        assert all(file.stat().st_size > 1000 for file in save(figure, tmp_path / name))
    short.to_csv(tmp_path / "A.csv", *_experiments.SIGNALS)
    lines = (tmp_path / "A.csv").read_text().splitlines()
    assert lines[0] == HEADER
    assert len(lines) == 1 + ticks


def test_interrupted(tmp_path, capsys, monkeypatch, undrawn):
    simulate = experiments.Experiment.simulate

    def interrupt(self, **options):
        raise Interrupted(simulate(self, progress=False))

    monkeypatch.setattr(experiments.Experiment, "simulate", interrupt)
    assert main(["run", "A", "B", "--out", str(tmp_path)]) == 130
    assert files(tmp_path) == sorted(f"A{ending}" for ending in ALL)


# --- wrong usage ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["run", "E"], "loopwright: error: there is no experiment 'E'. Known: A, B, C, D."),
        (["run", "A", "--option", "delay"], "--option: found 'delay'; expected NAME=VALUE, such as --option delay=1."),
        (
            ["run", "A", "--option", "delya=1"],
            "--option delya: no experiment has such an option. Did you mean 'delay'?",
        ),
        (["run", "A", "--option", "delay=2"], "experiment A.delay: found 2; expected 0 or 1 samples."),
        (
            ["run", "A", "--option", "encoder=nan"],
            "experiment A.encoder: found 'nan'; expected a number that is not negative.",
        ),
        (["run", "A", "C", "--option", "cubic=true"], "--option cubic: A and C can't take it; an option of D only."),
        (
            ["run", "A", "--option", "velocity_limit=1"],
            "velocity_limit: A can't take it; an option of B, C and D only.",
        ),
        (
            ["run", "A", "--option", "delay=1", "--option", "delay=0"],
            "--option delay: it is given twice; give it once.",
        ),
        (["run", "A", "--plant", "no.fmu"], "plant: there is no file 'no.fmu'; expected an FMU. Check the path."),
        (
            ["run", "A", "--plant", "x.fmu", "--option", "plant='y.fmu'"],
            "--plant: the plant is given twice; give it once.",
        ),
        (["run", "A", "--solver", "RK45"], "--solver: it is for diagrams, FILE.py:NAME; experiments have --option."),
        (["run", "A", "--json"], "--json: it is for diagrams, FILE.py:NAME; experiments have --option."),
        (["run", "--out"], "expected one argument"),
        (["ran"], "there is no command 'ran'. Did you mean 'run'"),
        (["simulate", "loop.py:loop"], "there is no command 'simulate'. Did you mean 'run'?"),
        (
            ["run", "loop.py:loop", "--stop-time", "2"],
            "run: error: there is no option --stop-time. Did you mean '--dur",
        ),
        (["draw", "loop.py:loop", "--output=x.svg"], "draw: error: there is no option --output. Did you mean '--out'?"),
        (["run", "A", "--otpion", "delay=1"], "there is no option --otpion. Did you mean '--option'"),
        ([], "usage: loopwright"),
    ],
)
def test_wrong_usage(arguments, text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert text in err
    assert not out
    assert files(tmp_path) == []  # nothing was begun


@pytest.mark.slow
def test_a_plant_that_is_no_fmu(tmp_path, capsys):
    text = tmp_path / "plant.fmu"
    text.write_text("not a zip archive")
    assert main(["run", "A", "--plant", str(text), "--out", str(tmp_path / "out")]) == 2
    assert (
        f"plant: {str(text)!r} is no FMU: it is no zip archive (it starts with b'not a zi')" in capsys.readouterr().err
    )


def test_out_is_a_file(tmp_path, capsys):
    (tmp_path / "out").write_text("")
    assert main(["run", "A", "--out", str(tmp_path / "out")]) == 2
    assert "out' is a file; expected a folder. Name another folder." in capsys.readouterr().err


def test_a_plant_of_ones_own(tmp_path, undrawn):
    from loopwright.fmus import gantry

    plant = gantry.build(out=tmp_path / "mine.fmu")
    assert main(["run", "A", "--plant", str(plant), "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "A.json").read_text())["overshoot_par"] == pytest.approx(0.248935, abs=2e-3)


def test_a_plant_with_scalar_ports(tmp_path, capsys, undrawn):
    from support.scalar_gantry import RENAME, scalar_gantry

    plant = ["--plant", str(scalar_gantry(tmp_path)), "--out", str(tmp_path / "out")]
    renames = [text for name, port in RENAME.items() for text in ("--rename", f"{name}={port}")]
    assert main(["run", "A", *plant, *renames]) == 0
    assert json.loads((tmp_path / "out" / "A.json").read_text())["overshoot_par"] == pytest.approx(0.248935, abs=2e-3)
    capsys.readouterr()
    for words, text in (
        (["run", "A", *plant, "--rename", "s_Y"], "--rename: found 's_Y'; expected NAME=PORT"),
        (["run", "A", *plant, *renames[:2], *renames[:2]], "--rename F_my: it is given twice; give it once."),
        (["run", "A", *renames], "--rename: it names ports of another plant; give that plant, too."),
        (["run", "A", *plant, *renames[:-4], *renames[-2:]], "no variable that is renamed to acceleration[1]"),
    ):
        assert main(words) == 2
        assert text in capsys.readouterr().err


# --- the process ----------------------------------------------------------------------------------------------------


def test_a_stream_without_greek(tmp_path, monkeypatch, undrawn):
    streams = [io.TextIOWrapper(io.BytesIO(), encoding="ascii") for _ in range(2)]
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])
    assert main(["run", "B", "--option", "tool_mass=5", "--out", str(tmp_path / "ö")]) == 1
    out, err = (stream.detach().getvalue() for stream in streams)
    assert b"peak_acceleration  | m/s2 |" in out
    assert b"Nearest foot point theta = " in err
    assert files(tmp_path / "ö") == sorted(f"B{ending}" for ending in ALL)


@pytest.mark.slow
def test_terminal_without_greek(tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    command = [sys.executable, "-m", "loopwright", "run", "B", "--option", "tool_mass=5", "--out", "ö"]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert result.returncode == 1
    assert b"peak_acceleration  | m/s2 |" in result.stdout
    assert b"Nearest foot point theta = " in result.stderr
    assert files(tmp_path / "ö") == sorted(f"B{ending}" for ending in ALL)


@pytest.mark.parametrize("command", ["run", "draw", "sweep", "report", "build", "inspect", "validate", "doctor"])
def test_the_help_of_each_command_has_examples_that_it_takes(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    examples = re.findall(r"^  loopwright (.+)$", text.partition("examples:\n")[2].partition("\n\n")[0], re.MULTILINE)
    assert len(examples) >= 2
    for example in examples:
        assert vars(make_parser().parse_args(shlex.split(example)))["command"] == command


def test_version_and_help(capsys):
    from importlib.metadata import version

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"loopwright {version('loopwright')}\n"
    assert main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    assert text.isascii()  # it prints on any terminal
    assert all(f"  {name} " in text for name in DEFINITIONS)
    assert "cubic=False  (D only)" in text
    assert "velocity_limit=None  (B, C, D only)" in text


# --- interrupts and full disks --------------------------------------------------------------------------------------


def test_an_interrupt_while_figures_are_saved_leaves_the_earlier_files(tmp_path, capsys, monkeypatch, undrawn):
    assert main(["run", "A", "--out", str(tmp_path)]) == 0
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("loopwright.diagrams.plotting.save", interrupt)
    capsys.readouterr()
    assert main(["run", "A", "B", "--out", str(tmp_path)]) == 130
    err = capsys.readouterr().err
    assert "interrupted; nothing of A is written; the files of an earlier run stay in" in err
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_an_interrupt_while_plants_are_built_ends_without_a_traceback(tmp_path, capsys, monkeypatch):
    def interrupt(**options):
        raise KeyboardInterrupt

    monkeypatch.setattr(_experiments.gantry, "build", interrupt)
    assert main(["run", "A", "--out", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "loopwright: interrupted.\n"


def test_an_interrupt_while_the_command_is_loaded_ends_without_a_traceback():
    code = (
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'loopwright.diagrams.cli': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from loopwright.__main__ import main\n"
        "raise SystemExit(main())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=FAR, check=False)
    assert (done.returncode, done.stderr) == (130, "loopwright: interrupted.\n")


def test_files_that_cannot_be_written_leave_the_earlier_ones(tmp_path, capsys, monkeypatch, undrawn):
    assert main(["run", "A", "--out", str(tmp_path)]) == 0
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("loopwright.diagrams.plotting.save", full)
    capsys.readouterr()
    assert main(["run", "A", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert (
        f"its files can't be written; the files of an earlier run stay in {tmp_path}: no space is left on the" in said
    )
    assert said.count("Make room there.") >= 1
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
