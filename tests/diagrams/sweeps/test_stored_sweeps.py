"""Sweeps on disk: a sweep that was cut off goes on, and nothing is run twice."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from loopwright.blocks import Block, Input, OptionError, Output, Ramp, Step, parameter
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.sweeps import InterruptedSweep, final, maximum, store
from loopwright.diagrams.sweeps.revision import describe_differences
from loopwright.diagrams.sweeps.worker import Worker

QUIET = {"progress": False, "workers": 1, "compile": False}
T = 0.01


class Guarded(Block):
    """Refuses inputs from a limit on."""

    limit: float = parameter(default=0.5)
    gain: float = parameter(default=2.0)
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return self.gain * u.u

    def guards(self, t, x, u):
        return {"below the limit": self.limit - u.u}


def guarded(slope=1.0):
    @subsystem(sample_time=T, name="box")
    def box(u):
        return Guarded(name="guard")(u)

    return Diagram("guarded", box(Ramp(slope=slope, name="ramp")).named("y"))


@pytest.fixture
def runs(monkeypatch):
    """The samples that were run."""
    run, found = Worker.run, []

    def counted(self, sample, tell=lambda t: None):
        found.append(sample.index)
        return run(self, sample, tell)

    monkeypatch.setattr(Worker, "run", counted)
    return found


GAINS = (1.0, 2.0, 3.0, 4.0)
KEPT = {"signals": "y", "reduce": {"end": final("y")}}


def assert_equal(first, second):
    assert first.names == second.names
    for name in first.names:
        assert first[name].tobytes() == second[name].tobytes()
    assert first.failures == second.failures
    assert first.t.tobytes() == second.t.tobytes()
    assert first.units == second.units
    assert first.end.tobytes() == second.end.tobytes()


def test_what_is_there_is_not_run_again_and_has_the_same_bits(tmp_path, runs):
    grid = {"guard.gain": GAINS, "guard.limit": (0.05, 1.0)}
    plain = guarded().sweep(grid, 0.1, **KEPT, **QUIET)
    first = guarded().sweep(grid, 0.1, **KEPT, to=tmp_path / "s", **QUIET)
    assert (len(runs), first.reused, len(first.failures)) == (16, 0, 4)
    again = guarded().sweep(grid, 0.1, **KEPT, to=tmp_path / "s", **QUIET)
    assert (len(runs), again.reused) == (16, 8)
    assert_equal(plain, first)
    assert_equal(plain, again)
    more = guarded().sweep({**grid, "guard.gain": (0.5, *GAINS)}, 0.1, **KEPT, to=tmp_path / "s", **QUIET)
    assert (len(runs), more.reused) == (18, 8)
    assert more["y"][2:].tobytes() == plain["y"].tobytes()
    np.testing.assert_allclose(more["end"], np.where(np.arange(10) % 2, 0.1, np.nan) * np.repeat((0.5, *GAINS), 2))


def test_an_interrupted_sweep_keeps_its_results_and_goes_on(tmp_path, runs, monkeypatch):
    run = Worker.run

    def interrupt(self, sample, tell=lambda t: None):
        if sample.index == 2:
            raise KeyboardInterrupt
        return run(self, sample, tell)

    with monkeypatch.context() as patch:
        patch.setattr(Worker, "run", interrupt)
        with pytest.raises(InterruptedSweep, match="interrupted after 2 of 4 samples") as error:
            guarded().sweep({"guard.gain": GAINS}, 0.1, **KEPT, to=tmp_path / "s", **QUIET)
    np.testing.assert_allclose(error.value.sweep["end"], [0.1, 0.2, np.nan, np.nan])
    np.testing.assert_array_equal(error.value.sweep.failed, [False, False, True, True])
    assert repr(error.value.sweep).endswith("guard.gain, 2 not run>")
    assert runs == [0, 1]
    rest = guarded().sweep({"guard.gain": GAINS}, 0.1, **KEPT, to=tmp_path / "s", **QUIET)
    assert runs == [0, 1, 2, 3]
    np.testing.assert_allclose(rest["end"], [0.1, 0.2, 0.3, 0.4])


def test_an_interrupt_before_the_first_run_is_one_of_the_sweep(tmp_path, runs, monkeypatch):
    def interrupt(sample, *, seeded):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["loopwright.diagrams.sweeps.sweep"], "key_of", interrupt)
    with pytest.raises(InterruptedSweep, match="interrupted after 0 of 4 samples"):
        guarded().sweep({"guard.gain": GAINS}, 0.1, **KEPT, to=tmp_path / "s", **QUIET)
    assert not runs


def _power(run):
    return run["y"] @ run["y"]


def _other_power(run):
    return run["y"] @ run["y"] + 1.0


@pytest.mark.parametrize(
    ("change", "differs"),
    [
        ({}, ""),
        ({"diagram": guarded(slope=2.0)}, r"the parameter ramp\.slope \(1\.0 there, 2\.0 here\)"),
        ({"diagram": guarded().replace({"box.sample_time": 0.02})}, r".*box\.sample_time \(1/100 there, 1/50 here\)"),
        ({"diagram": guarded().replace(ramp=Step(times=0.0, values=1.0))}, r".*the block ramp"),
        ({"duration": 0.2}, r"the duration \(0\.1 there, 0\.2 here\)"),
        ({"signals": ()}, r"the signals \(\('y',\) there, \(\) here\)"),
        ({"reduce": {"end": maximum("y")}}, "the reduction 'end'"),
        ({"reduce": {"end": _power}}, "the reduction 'end'"),
        ({"reduce": {"end": final("y"), "top": maximum("y")}}, r"the reduction 'top' \(here alone\)"),
        ({"every": 2}, r"the option every \(not given there, 2 here\)"),
        ({"step": 0.005}, r"the option step \(not given there, 0\.005 here\)"),
        ({"workers": 2}, ""),
        ({"compile": True}, ""),
    ],
)
def test_a_folder_belongs_to_one_diagram_with_one_set_of_options(tmp_path, change, differs):
    arguments = {"diagram": guarded(), "parameters": {"guard.gain": (1.0,)}, "duration": 0.1, **KEPT, **QUIET}

    def sweep(*, diagram, parameters, duration, **more):
        return diagram.sweep(parameters, duration, to=tmp_path / "s", **more)

    sweep(**arguments)
    if not differs:
        assert sweep(**{**arguments, **change}).reused == 1
        return
    with pytest.raises(
        OptionError, match=rf"holds a sweep of 'guarded' that differs from this one in {differs}.* overwrite=True"
    ):
        sweep(**{**arguments, **change})
    assert sweep(**{**arguments, **change}, overwrite=True).reused == 0
    assert sweep(**{**arguments, **change}).reused == 1


def test_several_differences_are_told_and_the_others_counted(tmp_path):
    arguments = {"parameters": {"guard.limit": (1.0,)}, "duration": 0.1, "to": tmp_path / "s", **KEPT, **QUIET}
    guarded().sweep(**arguments)
    other = guarded(slope=2.0).replace({"guard.gain": 3.0, "box.sample_time": 0.02})
    with pytest.raises(OptionError, match=r"2\.0 there, 3\.0 here.* and [1-9] more\. Choose") as error:
        other.sweep(**{**arguments, "duration": 0.2, "reduce": {"top": maximum("y")}}, every=2, rtol=1e-3)
    assert "equations" not in str(error.value)  # they only follow from the parameters
    head = tmp_path / "s" / store.HEAD
    head.write_text(json.dumps({**json.loads(head.read_text()), "format": 1}))
    with pytest.raises(OptionError, match="differs from this one in the version of Loopwright that wrote it"):
        guarded().sweep(**arguments)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ({"content": {"plant": "#1"}}, {"content": {"plant": "#2"}}, "the content of plant"),
        ({"parameter": {"plant.start.m": "1.0"}}, {}, "the parameter plant.start.m (1.0 there, not given here)"),
        (
            {"block": {"a": "Gain"}, "parameter": {"a.gain": "1.0"}, "wire": {"a.u": "#"}},
            {},
            "the block a (there alone)",
        ),
        ({"wire": {"a.u": "#1"}}, {"wire": {"a.u": "#2"}}, "the wire to a.u"),
        (
            {"sweep": {"version of CasADi": "1"}},
            {"sweep": {"version of CasADi": "2"}},
            "the version of CasADi (1 there, 2 here)",
        ),
        ({"parameter": {"a.gain": "#1"}}, {"parameter": {"a.gain": "2.0"}}, "the parameter a.gain"),
        ({"equations": {"a": "#1"}}, {"equations": {"a": "#1"}}, ""),
    ],
)
def test_differences_are_told_by_the_names_of_parts(old, new, said):
    assert describe_differences(old, new) == said


def test_a_function_counts_by_its_code(tmp_path):
    def sweep(function):
        return guarded().sweep({"guard.gain": (1.0,)}, 0.1, reduce={"n": function}, to=tmp_path / "s", **QUIET)

    sweep(_power)
    assert sweep(_power).reused == 1
    with pytest.raises(OptionError, match=r"differs from this one in the reduction 'n'\. "):
        sweep(_other_power)


def test_equations_count_by_what_they_do(tmp_path, monkeypatch):
    sweep = {"parameters": {"guard.gain": (1.0,)}, "duration": 0.1, "to": tmp_path / "s"}
    guarded().sweep(**sweep, **KEPT, **QUIET)
    assert guarded().sweep(**sweep, **KEPT, **QUIET).reused == 1
    monkeypatch.setattr(Guarded, "output", lambda self, t, x, u: self.gain * u.u + 1.0)
    with pytest.raises(OptionError, match=r"differs from this one in the equations of box\.guard\. "):
        guarded().sweep(**sweep, **KEPT, **QUIET)


def test_other_files_are_left_alone_and_broken_ones_are_told(tmp_path):
    def sweep(folder):
        return guarded().sweep({"guard.gain": (1.0,)}, 0.1, **KEPT, to=folder, **QUIET)

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(OptionError, match=r"mine' holds other files, and no sweep"):
        sweep(tmp_path / "mine")
    with pytest.raises(OptionError, match=r"found a file at .*notes.txt'; expected a folder"):
        sweep(tmp_path / "mine" / "notes.txt")
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"
    sweep(tmp_path / "s")
    (part,) = (tmp_path / "s").glob("part-*.npz")
    (tmp_path / "s" / ".part-1.abcd.part.npz").write_bytes(b"cut off")  # as a kill in the middle of writing leaves it
    assert sweep(tmp_path / "s").reused == 1
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(OptionError, match=r"part-.*can't be read: .* Remove it; its samples are then run again"):
        sweep(tmp_path / "s")
    part.unlink()
    assert sweep(tmp_path / "s").reused == 0
    head = json.loads((tmp_path / "s" / store.HEAD).read_text())
    assert head["diagram"] == "guarded"
    (tmp_path / "s" / store.HEAD).write_text("{")
    with pytest.raises(OptionError, match="overwrite=True"):
        sweep(tmp_path / "s")


@pytest.mark.slow
def test_the_revision_of_an_experiment_is_equal_in_every_process():
    code = """
from loopwright.diagrams import experiments
from loopwright.sweeps import final
from loopwright.diagrams.sweeps.plan import Plan
from loopwright.diagrams.sweeps.revision import digest_of, parts_of
diagram = experiments.force_tracking().diagram
print(digest_of(parts_of(Plan(diagram.wired, 1.0, {}, ("xi",), {"a": final("xi"), "b": lambda run: run["xi"]}))))
print(digest_of(parts_of(Plan(diagram.replace({"plant.start.coulomb_scale": 1.5}).wired, 1.0, {}, ("xi",)))))
"""
    found = []
    for seed in ("1", "2"):
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        )
        found.append(done.stdout.split())
    assert found[0] == found[1]
    assert found[0][0] != found[0][1]


def test_what_can_not_be_compared_is_told(tmp_path):
    class Odd:
        def __init__(self):
            self.inside = lambda run: 1.0

        def __call__(self, run):
            return self.inside(run)

    with pytest.raises(OptionError, match=r"found .*Odd.* in a sweep that is to be kept on disk; .* leave out to="):
        guarded().sweep({"guard.gain": (1.0,)}, 0.1, reduce={"odd": Odd()}, to=tmp_path / "s", **QUIET)


SCALE = 1.0


def scaled(run):
    return SCALE * run["y"].max()


def test_other_numbers_that_a_reduction_takes_are_another_sweep(tmp_path, monkeypatch):
    def by_keyword(factor):
        def found(run, *, factor=factor):
            return factor * run["y"].max()

        return found

    for place, reduce in (("global", scaled), ("keyword", by_keyword(1.0))):
        guarded().sweep({"guard.gain": (1.0,)}, 0.1, reduce={"e": reduce}, to=tmp_path / place, **QUIET)
    again = guarded().sweep({"guard.gain": (1.0,)}, 0.1, reduce={"e": scaled}, to=tmp_path / "global", **QUIET)
    assert again.reused == 1
    monkeypatch.setattr(sys.modules[__name__], "SCALE", 2.0)
    for place, reduce in (("global", scaled), ("keyword", by_keyword(2.0))):
        with pytest.raises(OptionError, match="differs from this one"):
            guarded().sweep({"guard.gain": (1.0,)}, 0.1, reduce={"e": reduce}, to=tmp_path / place, **QUIET)


@pytest.mark.parametrize(
    ("to", "found"), [("a_file/x", "a_file' is a file; expected a folder. "), (3, "found 3"), ("\0", "found '\\x00'")]
)
def test_a_folder_that_cannot_be_made_is_told_before_the_first_run(to, found, runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").write_text("")
    with pytest.raises(OptionError) as caught:
        guarded().sweep({"guard.gain": GAINS}, 0.1, to=to, **KEPT, **QUIET)
    assert (caught.value.block, caught.value.port) == ("guarded", "to")
    assert found in str(caught.value)
    assert "folder" in caught.value.message
    assert not runs


def test_a_sweep_that_is_replaced_takes_no_other_files_of_its_folder_along(tmp_path):
    folder, kept = tmp_path / "found", {"to": tmp_path / "found", **KEPT, **QUIET}
    guarded().sweep({"guard.gain": GAINS}, 0.1, **kept)
    (folder / "chapter.tex").write_text("mine")
    replaced = guarded().sweep({"guard.gain": GAINS}, 0.2, overwrite=True, **kept)
    assert replaced.reused == 0
    assert (folder / "chapter.tex").read_text() == "mine"
    assert guarded().sweep({"guard.gain": GAINS}, 0.2, **kept).reused == 4


@pytest.mark.parametrize("text", ["", "{", '{"mine": 1}'])
def test_a_head_that_is_no_sweeps_is_named(tmp_path, text):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(OptionError, match="sweep.json' is damaged, or of something else; expected the head of a sweep"):
        guarded().sweep({"guard.gain": GAINS}, 0.1, to=tmp_path, **KEPT, **QUIET)


def test_an_empty_part_is_named(tmp_path):
    guarded().sweep({"guard.gain": GAINS}, 0.1, to=tmp_path, **KEPT, **QUIET)
    (part,) = tmp_path.glob("part-*.npz")
    part.write_bytes(b"")
    with pytest.raises(OptionError, match=f"{part.name}' of a sweep can't be read: .* Remove it"):
        guarded().sweep({"guard.gain": GAINS}, 0.1, to=tmp_path, **KEPT, **QUIET)
