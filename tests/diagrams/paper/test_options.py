"""What may be given to an experiment, in Python and on the command line, and what is said where it may not."""

import json
import math
import pickle
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import OptionError
from loopwright.diagrams import experiments
from loopwright.diagrams.cli import options_of_experiments as _cli_options
from loopwright.diagrams.cli.command_arguments import parse_value
from loopwright.diagrams.cli.command_line import main
from loopwright.diagrams.paper.experiment_options import LIMITS
from loopwright.diagrams.paper.experiments import EXPERIMENTS, compliance, force_tracking, path_following

PROC = Path("/proc")
LINUX = pytest.mark.skipif(not PROC.is_dir(), reason="needs a folder to which nobody can write")


def files(folder):
    return sorted(file.name for file in folder.iterdir())


# --- truth values ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["no", "off", "yes", "", 1, 0, None, 1.0])
def test_only_truth_values_are_truth_values(value):
    with pytest.raises(OptionError, match=re.escape(f"experiment D.cubic: found {value!r}; expected True or False.")):
        force_tracking(cubic=value)
    with pytest.raises(OptionError, match="experiment B.smooth_reference: found .*; expected True or False"):
        compliance(smooth_reference=value)


def test_numpys_truth_values_are_some():
    assert force_tracking(cubic=np.True_).options["cubic"] is True


@pytest.mark.parametrize(
    ("word", "meant"), [("yes", True), ("On", True), ("TRUE", True), ("no", False), ("off", False)]
)
def test_words_for_truth_on_the_command_line(word, meant):
    assert parse_value(word) is meant


def test_a_word_that_is_no_truth_value(tmp_path, capsys):
    assert main(["run", "D", "--option", "cubic=maybe", "--out", str(tmp_path / "out")]) == 2
    assert "experiment D.cubic: found 'maybe'; expected True or False." in capsys.readouterr().err


# --- the sample time -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("letter", "value", "fits"),
    [
        ("A", 0.0003, "0.000275 or 0.0003125"),
        ("A", 7e-4, "0.0006875 or 0.000704"),
        ("C", 0.0007, "0.00064 or 0.00075"),
        ("D", 20, "9"),
        ("A", 1e-10, "1e-09"),
        ("A", Fraction(1, 3000), "0.00032 or 0.00034375"),
    ],
)
def test_a_sample_time_that_does_not_divide_the_duration(letter, value, fits):
    with pytest.raises(OptionError) as caught:
        EXPERIMENTS[letter](sample_time=value)
    message = str(caught.value)
    assert message.startswith(f"experiment {letter}.sample_time: found {value!r}; expected a whole number of nanosec")
    shown = message.rpartition("such as ")[2].removesuffix(".")
    assert shown == fits
    for text in shown.split(" or "):
        advised = EXPERIMENTS[letter](sample_time=float(text))
        assert (Fraction(str(advised.duration)) / Fraction(text)).denominator == 1


@pytest.mark.parametrize("value", ["1e-3", True, 0, -1e-3, math.nan, math.inf, None, 1j, [1e-3]])
def test_a_sample_time_that_is_no_positive_number(value):
    with pytest.raises(OptionError, match="experiment A.sample_time: found .*; expected a positive number"):
        path_following(sample_time=value)


def test_an_exact_sample_time_is_the_same_run():
    exact = path_following(sample_time=Fraction(1, 1000))
    assert exact.options == path_following().options
    assert exact.diagram.subsystems["controller"].sample_time == Fraction(1, 1000)


def test_a_wrong_sample_time_is_wrong_usage_and_leaves_earlier_files(tmp_path, capsys):
    (tmp_path / "A.csv").write_text("of an older run")
    assert main(["run", "A", "--out", str(tmp_path), "--option", "sample_time=0.0003"]) == 2
    assert "make the experiment's 11 s, such as 0.000275 or 0.0003125." in capsys.readouterr().err
    assert (tmp_path / "A.csv").read_text() == "of an older run"


# --- numbers and limits ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize(
    "value", [[[300], [200, 1]], (1, 2, 3), [], "300", (300, "1"), 0, (1, -1), True, (1, math.nan)]
)
def test_limits_that_are_none(name, value):
    with pytest.raises(
        OptionError, match=re.escape(f"experiment B.{name}: found {value!r}; expected a positive number")
    ):
        compliance(**{name: value})


@pytest.mark.parametrize("value", [np.array([0, 1]), [0], "1", 2, True, None, 0.5])
def test_delays_that_are_none(value):
    with pytest.raises(OptionError, match=r"experiment A.delay: found .*; expected 0 or 1 samples"):
        path_following(delay=value)


@pytest.mark.parametrize("value", [np.array([1.0]), 10**400, 1j, "0", None, True])
def test_numbers_that_are_none(value):
    with pytest.raises(OptionError, match="experiment A.tool_mass: found .*; expected a number that is not negative"):
        path_following(tool_mass=value)


@pytest.mark.drawn(5)
@pytest.mark.parametrize(
    ("value", "kept"),
    [
        (0.2, 0.2),
        (np.float64(0.2), 0.2),
        (math.inf, None),
        (None, None),
        ((None, math.inf), None),
        ((0.2, None), (0.2, None)),
        ([0.2, math.inf], (0.2, None)),
        (np.array([0.2, 0.1]), (0.2, 0.1)),
        ((0.2,), (0.2, 0.2)),
    ],
)
def test_limits_in_one_form(value, kept):
    options = dict.fromkeys(LIMITS, value)
    experiment = compliance(**options)
    assert [experiment.options[name] for name in LIMITS] == [kept] * 3
    sides = kept if isinstance(kept, tuple) else (kept, kept)
    for side, limit in zip(("par", "perp"), sides, strict=True):
        admittance = experiment.diagram[f"admittance_{side}"]
        assert (admittance.velocity_limit, admittance.acceleration_limit) == (limit, limit)
    assert ("controller.saturation" in experiment.diagram.blocks) == (kept is not None)


@pytest.mark.slow
def test_a_force_limit_on_one_axis_leaves_the_other_alone(runs):
    _, free = runs("A")
    _, run = runs("A", motor_force_limit=(300, math.inf))
    y, z = np.abs(run["motor_force"]).max(axis=0)
    assert y == 300.0 < np.abs(free["motor_force"][:, 0]).max()
    assert z > 1000.0
    _, same = runs("A", motor_force_limit=(300, None))
    assert np.array_equal(same.data, run.data)


@pytest.mark.slow
def test_a_velocity_limit_on_one_direction_leaves_the_other_alone(runs):
    _, free = runs("B")
    _, run = runs("B", velocity_limit=(0.2, None))
    assert np.abs(run["eta_p"][:, 1]).max() <= 0.2 + 1e-12
    assert np.abs(free["eta_p"][:, 1]).max() > 0.3
    np.testing.assert_allclose(run["xi_p"], free["xi_p"], atol=1e-12)


def test_an_unlimited_limit_is_none_where_there_is_nothing_to_limit():
    assert path_following(velocity_limit=math.inf).options["velocity_limit"] is None


# --- what an experiment is -------------------------------------------------------------------------------------------


@pytest.mark.drawn(2)
@pytest.mark.parametrize("letter", EXPERIMENTS)
def test_an_experiment_can_be_pickled(letter, runs):
    experiment, run = runs(letter)
    again = pickle.loads(pickle.dumps(experiment))
    assert again.options == experiment.options
    assert (again.letter, again.title, again.duration, again.path) == (
        *(letter, experiment.title, experiment.duration, experiment.path),
    )
    with pytest.raises(TypeError):
        again.options["delay"] = 1
    assert np.array_equal(again.simulate(progress=False).data, run.data)


@pytest.mark.parametrize("letter", EXPERIMENTS)
@pytest.mark.drawn(2)
def test_references_have_units(letter, runs):
    _, run = runs(letter)
    for name in ("eta_p", "xi_p", "eta_d.y", "xi_d.y"):
        assert run.unit(name) == ("m", "m/s", "m/s2")
    assert run.plot("eta_p").axes[0].get_legend().get_texts()[0].get_text() == "eta_p[1] [m]"


# --- the command line ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "letters"),
    [
        ([], "ABCD"),
        (["AB"], "AB"),
        (["A,B"], "AB"),
        (["b,", "a"], "BA"),
        (["D", "CD", "d"], "DC"),
    ],
)
def test_letters(given, letters):
    assert _cli_options.parse_letters(given) == list(letters)


@pytest.mark.parametrize(
    ("given", "named"), [("AE", "AE"), ("A,EF", "EF"), ("", ""), ("path_following", "path_following")]
)
def test_letters_that_are_none(given, named, capsys):
    assert main(["run", given]) == 2
    assert f"error: there is no experiment {named!r}. Known: A, B, C, D.\n" in capsys.readouterr().err


def test_options_of_several_experiments(capsys):
    shares = _cli_options.share("AB", {"velocity_limit": 1.0})
    assert shares == {"A": {}, "B": {"velocity_limit": 1.0}}
    assert capsys.readouterr().err == "A: without velocity_limit, which only B, C and D have.\n"


def test_a_path_is_for_python(capsys):
    assert main(["run", "A", "--option", "path=circle"]) == 2
    assert (
        "--option path: a path can't be given on the command line; take Python: "
        "loopwright.experiments.path_following(path=…).simulate()."
    ) in capsys.readouterr().err
    assert main(["run", "A", "--option", "pth=circle"]) == 2
    assert "'path'" not in capsys.readouterr().err


@LINUX
def test_a_folder_to_which_nothing_can_be_written_is_noticed_before_the_run(capsys, monkeypatch):
    monkeypatch.setattr(experiments.Experiment, "simulate", lambda self: pytest.fail("it ran"))
    assert main(["run", "A", "--out", "/proc"]) == 2
    assert "--out: nothing can be written to the folder '/proc': " in capsys.readouterr().err


def test_help_tells_the_exit_statuses_and_what_becomes_of_files(capsys):
    assert main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    assert "  130  interrupted (Ctrl-C); the record until then is written" in text
    assert "A run without a record writes nothing, and an earlier run's files stay." in text
    assert "path=" not in text


def test_never_is_told_apart_from_not_applicable_after_a_failure(tmp_path, undrawn):
    assert main(["run", "B", "--out", str(tmp_path), "--option", "tool_mass=5"]) == 1
    content = json.loads((tmp_path / "B.json").read_text(encoding="utf-8"))
    assert content["never"] == []
    assert content["error"].startswith("controller.path_projection, t = 0.02")
    assert files(tmp_path)[:2] == ["B.csv", "B.json"]
