"""What a run recorded, reached by name: in the whole, at an instant, and as a picture."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, OptionError, Reference, Sine, UnitDelay, UnknownNameError
from loopwright.diagrams import Diagram, Run, subsystem
from loopwright.diagrams.results import stored as _stored
from loopwright.types import Occurrence, Stopped


@subsystem(sample_time=0.5, name="a")
def first(u):
    return Gain(gain=1.0)(u).named("w")


@subsystem(sample_time=0.5, name="b")
def second(u):
    return Gain(gain=10.0)(u).named("w")


@pytest.fixture(scope="module")
def run():
    u = Constant(value=3.0)
    return Diagram("twins", first(u).named("left"), second(u).named("right")).simulate(1.0, progress=False)


def test_a_snapshot_refuses_a_name_that_stands_for_two_wires_as_the_run_does(run):
    for recorded in (run, run.at(0.5)):
        with pytest.raises(UnknownNameError, match=r"'w' stands for several signals: a\.w, b\.w\. Write more") as error:
            recorded["w"]
        assert error.value.candidates == ("a.w", "b.w")


def test_a_snapshot_takes_the_names_that_the_run_takes(run):
    at = run.at(0.7)
    assert (at.t, at.tick) == (0.5, 1)
    assert [float(at[n]) for n in ("a.w", "b.w", "left", "right")] == [3.0, 30.0, 3.0, 30.0]
    assert all(np.array_equal(at[n], run[n][1]) for n in run.names)
    assert at.names == run.wires


def test_one_wire_under_one_name_in_two_frames_is_not_ambiguous():
    y = first(Constant(value=2.0)).named("w")  # inside and outside the name is on the same port
    run = Diagram("same", Gain(gain=1.0)(y)).simulate(0.5, progress=False)
    assert sorted(run.wires) == ["a.w", "w"]
    assert float(run.at(0.5)["w"]) == run["w"][-1] == 2.0


def test_a_part_of_a_vector_has_its_unit_and_its_row():
    r = Reference(2.0, unit="m", name="r")
    run = Diagram("parts", Gain(gain=1.0)(r.y[0].named("first")), Gain(gain=1.0)(r.y[1:].named("rates"))).simulate(
        1.0, step=0.5, progress=False
    )
    assert run.unit("first") == "m"
    assert run.unit("rates") == ("m/s", "m/s2")
    assert np.array_equal(run.at(1.0)["rates"], [0.0, 0.0])


def test_a_loop_over_a_run_is_told_where_its_names_are(run):
    """Python asks for run[0], as a run has names in place of numbers."""
    with pytest.raises(UnknownNameError, match=r"found 0; expected the name of a signal.*'left'.*run\.names has all"):
        list(run)
    assert [name for name in run.names if name in run] == run.names


def test_names_complete_in_a_notebook(run):
    assert {"a.w", "b.w", "constant.y"} <= set(run._ipython_key_completions_())


# --- selections ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def waves():
    """Two signals of two entries, and a state each."""

    @subsystem(sample_time=0.125, name="box")
    def box(u):
        return UnitDelay(initial_value=(1.0, 2.0), name="delay")(u).named("late")

    r = Reference(2.0, unit="m", name="r")
    u = Gain(gain=(1.0, -3.0))(Sine(amplitude=2.0, frequency=7.0))
    return Diagram("waves", box(u).named("out"), Gain(gain=1.0)(r.y[1].named("rate"))).simulate(10.0, progress=False)


def chosen(run, *names, states=True):
    """Return the run as it is when only these signals were recorded."""
    signals = run.signals.choose(names, states=states)
    return replace(run, data=run.data[:, signals.columns], signals=signals)


def test_a_run_of_chosen_signals_gives_them_as_the_whole_run_does(waves):
    part = chosen(waves, "late", "rate")
    assert part.data.shape[1] == 5  # with the states
    assert set(part.names) == {"box.late", "out", "rate", "box.delay.y"}
    for name in (*part.names, "late", "delay.y"):
        assert np.array_equal(part[name], waves[name])
        assert np.array_equal(part.part(name, slice(3, 9)), waves[name][3:9])
        assert part.unit(name) == waves.unit(name)


def test_a_signal_that_was_not_recorded_is_told_apart_from_one_that_is_not_there(waves):
    part = chosen(waves, "late", "rate")
    with pytest.raises(UnknownNameError, match=r"'sine\.y' was not recorded .* Run again with record=\[…, 'sine\.y'\]"):
        part["sine.y"]
    with pytest.raises(UnknownNameError, match=r"'r\.y' was not recorded"):
        part["r.y"]  # one of its entries was
    with pytest.raises(UnknownNameError, match=r"no signal 'sime\.y' was recorded\. Did you mean 'sine\.y'"):
        part["sime.y"]
    assert "rate" in part
    assert not {"sine.y", "r.y", "sime"} & {n for n in ("sine.y", "r.y", "sime") if n in part}


def test_a_snapshot_of_chosen_signals_has_them_and_all_states(waves):
    whole, part = waves.at(5.0), chosen(waves, "rate").at(5.0)
    assert np.array_equal(part.state, whole.state)
    assert len(part.state) == 2
    assert set(part.values) == {"rate"}
    assert (part["rate"], part.t, part.tick) == (whole["rate"], 5.0, 40)


def test_an_operating_point_needs_the_states(waves):
    text = r"the states at t = 5\.0 s were not recorded .* Run again with the states recorded; .* run\[name\]\[40\]"
    with pytest.raises(OptionError, match=text):
        chosen(waves, "rate", states=False).at(5.0)
    with pytest.raises(OptionError, match=r"found t = 11\.0; the run holds 0 s to 10 s"):
        chosen(waves, "rate", states=False).at(11.0)


def test_steps_need_not_be_equal_and_of_two_samples_at_one_time_the_later_counts(waves):
    t = np.array([0.0, 0.1, 0.1, 0.35, 2.0])
    run = replace(waves, t=t, data=waves.data[:5])
    assert [run.at(s).tick for s in (0.0, 0.09, 0.1, 0.2, 0.35, 1.9, 2.0)] == [0, 0, 2, 2, 3, 3, 4]


# --- stored runs --------------------------------------------------------------------------------------------------------

EVENTS = (Occurrence(0.25, "wall", "hit", {"v": -1.5}, {"v": 1.5}), Occurrence(1 / 3, "relay", "on", {}, {"on": 1.0}))


@pytest.mark.parametrize("names", [None, ("late", "rate"), ()])
@pytest.mark.parametrize("states", [True, False])
@pytest.mark.parametrize("block", [2**24, 64])
def test_a_saved_run_opens_without_its_diagram_exact_to_the_last_bit(
    waves, names, states, block, tmp_path, monkeypatch
):
    monkeypatch.setattr(_stored, "_BLOCK", block)
    run = waves if names is None and states else chosen(waves, *(names or ()), states=states)
    residual = np.linspace(0, 1e-15, len(run.t))
    run = replace(run, events=EVENTS, stopped=Stopped(10.0, "box.stop"), residual=residual, messages=("a", "b"))
    run.save(tmp_path / "run")
    again = Run.open(tmp_path / "run")
    assert again.diagram is None
    assert again.diagram_name == "waves"
    assert np.array_equal(again.t, run.t)
    assert np.array_equal(again.residual, residual)
    assert again.names == run.names
    for name in run.names:
        assert np.array_equal(again[name], run[name])
        assert again.unit(name) == run.unit(name)
    assert (tuple(again.events), again.stopped) == (EVENTS, Stopped(10.0, "box.stop"))
    assert (again.elapsed, again.messages, again.has_states) == (run.elapsed, ("a", "b"), states)
    if states:
        assert np.array_equal(again.at(3.0).state, run.at(3.0).state)
    again.save(tmp_path / "copy")
    for name in ("rows.f64", "events.jsonl", "end.json"):
        assert (tmp_path / "copy" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    heads = [json.loads((tmp_path / f / "header.json").read_text(encoding="utf-8")) for f in ("run", "copy")]
    assert heads[0] | {"created": None} == heads[1] | {"created": None}


def test_an_opened_run_reads_only_what_is_asked_for_and_is_drawn_and_pickled(waves, tmp_path):
    waves.save(tmp_path / "run")
    run = Run.open(tmp_path / "run")
    assert isinstance(run.data.base.base, np.memmap)
    assert not run.data.flags.writeable
    assert len(run.plot("late", "rate").axes) == 2
    assert np.array_equal(pickle.loads(pickle.dumps(run))["late"], waves["late"])


def test_a_run_that_stands_there_is_replaced_only_when_asked(waves, tmp_path):
    waves.save(tmp_path / "run")
    with pytest.raises(OptionError, match=r"found a run at .* already"):
        waves.save(tmp_path / "run")
    waves.save(tmp_path / "run", overwrite=True)
    again = Run.open(tmp_path / "run")
    again.save(tmp_path / "run", overwrite=True)  # onto itself
    assert np.array_equal(Run.open(tmp_path / "run")["late"], waves["late"])


def test_what_is_no_run_does_not_open(tmp_path):
    for content in (None, "no JSON", "[]", '{"format": "other"}'):
        if content:
            (tmp_path / "header.json").write_text(content)
        step = r"Simulate again" if content else r"Check the path"
        with pytest.raises(OptionError, match=rf"and no stored run; expected a folder .* {step}"):
            Run.open(tmp_path)


def test_what_opens_in_another_way_says_in_which(waves, tmp_path):
    waves.save(tmp_path / "runs" / "first")
    with pytest.raises(OptionError, match=r"found a folder of 1 run at .*Run\.open\('.*runs.first'\)"):
        Run.open(tmp_path / "runs")
    waves.to_csv(tmp_path / "waves.csv", "late")
    with pytest.raises(OptionError, match=r"found a file at .* are read by pandas, and by Recorded\.from_csv"):
        Run.open(tmp_path / "waves.csv")
    with pytest.raises(OptionError, match=r"found nothing at .* Check the path"):
        Run.open(tmp_path / "nowhere")
    (tmp_path / "sweep.json").write_text("{}")
    with pytest.raises(OptionError, match=r"found a sweep at .* diagram\.sweep\(…, to="):
        Run.open(tmp_path)
    with pytest.raises(AttributeError, match=r"the class Run has no 'load'\. Write Run\.open\(\"folder\"\)"):
        _ = Run.load
    with pytest.raises(AttributeError, match=r"the class Run has no 'from_csv'\. Write pandas\.read_csv"):
        _ = Run.from_csv
    assert not hasattr(Run, "load")


def test_a_run_of_a_later_format_says_which_loopwright_reads_it(waves, tmp_path):
    waves.save(tmp_path / "run")
    file = tmp_path / "run" / "header.json"
    head = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(head | {"version": 2, "versions": {"loopwright": "9.1"}}), encoding="utf-8")
    with pytest.raises(
        OptionError, match=r"of version 2 of the format .* reads version 1\. Open it with loopwright 9\.1"
    ):
        Run.open(tmp_path / "run")


def test_plots_take_lists_all_named_wires_and_say_what_is_no_name():
    run = Diagram("d", Gain(gain=2.0)(Constant(value=1.0)).named("y")).simulate(0.2, step=0.1, progress=False)
    assert [ax.get_ylabel() for ax in run.plot().axes] == ["y"]
    assert [ax.get_ylabel() for ax in run.plot("y", "gain.y").axes] == ["y", "gain.y"]
    assert len(run.plot("y", ("y", "y")).axes) == 2
    with pytest.raises(OptionError, match=r"found <signal constant\.y> to draw; expected the name of a signal"):
        run.plot(Constant(value=1.0).y)
    with pytest.raises(UnknownNameError, match="no signal 'z'"):
        run.plot(["z"])
    bare = Diagram("d", Gain(gain=2.0)(Constant(value=1.0))).simulate(0.2, step=0.1, progress=False)
    with pytest.raises(OptionError, match=r"no wire has a name; expected names, such as 'constant\.y', 'gain\.y'"):
        bare.plot()


def test_exports_leave_the_old_file_if_they_fail(tmp_path, monkeypatch):
    run = Diagram("d", Gain(gain=2.0)(Constant(value=1.0)).named("y")).simulate(0.2, step=0.1, progress=False)
    run.to_csv(tmp_path / "a.csv")
    before = (tmp_path / "a.csv").read_bytes()

    def cut(path, *arguments, **options):
        Path(path).write_text("t,y\n0,")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savetxt", cut)
    with pytest.raises(OSError, match="no space is left on the disk at "):
        run.to_csv(tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]
