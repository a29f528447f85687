"""Recording: what is kept, what it costs, and what is left of a run that was killed."""

import json
import os
import subprocess
import sys
import time
import tracemalloc
from fractions import Fraction

import numpy as np
import pytest

from loopwright.blocks import OptionError, SimulationError, UnknownNameError
from loopwright.diagrams import Run
from loopwright.diagrams.results import recorder as _recorder
from loopwright.diagrams.results.recorded_signals import RecordedSignals
from loopwright.diagrams.results.recorder import Recorder, check_memory
from loopwright.diagrams.results.stored import header
from loopwright.types import Layout, Occurrence, Stopped, Wire

LAYOUT = Layout.of({"a.y": (), "box.b.v": (2,), "box.c.z": ()})  # and two states
WIRES = {"e": Wire("box.b", "v", 1), "box.w": Wire("a", "y")}
WIDTH = 6


def head(columns=None, residual=False, layout=LAYOUT, width=WIDTH):
    units = {"a.y": "m", "box.b.v": ("m", "m/s")}
    kept = None if columns is None else np.array(columns)
    return header("d", RecordedSignals(layout, WIRES, units, width, kept), residual=residual)


def samples(n, width=WIDTH):
    random = np.random.default_rng(1)
    return np.cumsum(random.random(n)), random.standard_normal((n, width))


def record(recorder, t, vectors):
    buffer = np.empty(vectors.shape[1])
    for k in range(len(t) - 1):
        buffer[:] = vectors[k]  # as the engine does, into one vector over and over
        recorder.row(float(t[k]), buffer)
    recorder.last(float(t[-1]), vectors[-1])
    return recorder.finish(elapsed=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("to", [False, True], ids=["memory", "disk"])
@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("columns", [None, [0, 2, 5]])
@pytest.mark.parametrize(("every", "rows"), [(1, None), (1, 5000), (7, None), (7, 5000), (10**6, None)])
def test_every_nth_sample_and_the_last_are_kept_exactly(to, residual, columns, every, rows, tmp_path):
    t, vectors = samples(5000, WIDTH + residual)
    options = {"to": tmp_path / "run", "header": head(columns, residual)} if to else {}
    recorder = Recorder(WIDTH, columns, every=every, rows=rows, residual=residual, **options)
    found, data = record(recorder, t, vectors)
    kept = sorted({*range(0, 4999, every), 4999})
    assert np.array_equal(found, t[kept])
    assert np.array_equal(data, vectors[kept][:, range(WIDTH) if columns is None else columns])
    if residual:
        assert np.array_equal(recorder.residual, vectors[kept, -1])
    else:
        assert recorder.residual is None


@pytest.mark.parametrize("to", [False, True], ids=["memory", "disk"])
def test_the_last_sample_is_not_kept_twice_but_a_second_one_at_its_time_is(to, tmp_path):
    recorder = Recorder(
        2, **({"to": tmp_path / "run", "header": head(layout=Layout.of({"y": (2,)}), width=2)} if to else {})
    )
    recorder.row(0.0, np.array([1.0, np.nan]))
    recorder.flush()
    recorder.last(0.0, np.array([1.0, np.nan]))
    recorder.last(0.0, np.array([2.0, np.nan]))
    recorder.flush()
    recorder.last(0.0, np.array([2.0, np.nan]))
    t, data = recorder.finish()
    assert (t.tolist(), data[:, 0].tolist()) == ([0.0, 0.0], [1.0, 2.0])


@pytest.mark.parametrize("to", [False, True], ids=["memory", "disk"])
def test_nothing_is_taken_before_the_first_sample(to, tmp_path):
    tracemalloc.start()
    try:
        Recorder(10**5, rows=10**6, **({"to": tmp_path / "run", "header": {}} if to else {}))
        assert tracemalloc.get_traced_memory()[1] < 10**5
    finally:
        tracemalloc.stop()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("to", [False, True], ids=["memory", "disk"])
def test_a_run_without_a_sample_is_empty(to, tmp_path):
    options = {"to": tmp_path / "run", "header": head()} if to else {}
    t, data = Recorder(WIDTH, **options).finish()
    assert (t.shape, data.shape) == ((0,), (0, WIDTH))
    if to:
        run = Run.open(tmp_path / "run")
        assert (run["e"].shape, run["box.b.v"].shape) == ((0,), (0, 2))


@pytest.mark.slow
def test_memory_holds_little_more_than_the_samples(monkeypatch):
    monkeypatch.setattr(_recorder, "_LARGEST", 2**20)
    n, width = 40_000, 49
    vector = np.arange(width, dtype=float)
    tracemalloc.start()
    try:
        recorder = Recorder(width)
        for k in range(n):
            recorder.row(float(k), vector)
        held = tracemalloc.get_traced_memory()[0]
        t, data = recorder.finish()
    finally:
        tracemalloc.stop()
    size = 8 * n * (width + 1)
    assert size <= held < size + 2 * 2**20
    assert np.array_equal(t, np.arange(n))
    assert np.array_equal(data, np.broadcast_to(vector, (n, width)))
    assert recorder._done == []  # each chunk was freed when it was copied


@pytest.mark.slow
def test_a_run_on_disk_holds_one_chunk_in_memory(tmp_path):
    n, width = 20_000, 399
    vector = np.arange(width, dtype=float)
    layout = Layout.of({"y": (width,)})
    tracemalloc.start()
    try:
        recorder = Recorder(width, to=tmp_path / "run", header=head(layout=layout, width=width))
        for k in range(n):
            recorder.row(float(k), vector)
        t, data = recorder.finish()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert data.nbytes == 8 * n * width > 60e6
    assert peak < 2e6  # a chunk of 256 KiB, the header, and what JSON takes to write it
    assert np.array_equal(t, np.arange(n))
    assert np.array_equal(data[-1], vector)


def test_memory_that_fills_up_ends_the_run_with_what_was_kept(monkeypatch):
    monkeypatch.setattr(_recorder, "machine_memory", lambda: 2**20)
    recorder = Recorder(WIDTH)
    n = 0

    def fill():
        nonlocal n
        for k in range(10**5):
            recorder.row(float(k), np.full(WIDTH, float(k)))
            n = k + 1

    with pytest.raises(
        SimulationError, match=r"^t = .* s: the samples fill .* GiB.*record=\[…\] or every=…, or .* to="
    ) as e:
        fill()
    assert e.value.t == n
    t, data = recorder.finish()
    assert np.array_equal(t, np.arange(n))
    assert np.array_equal(data[:, 3], t)
    assert 8 * 7 * n < 0.8 * 2**20


# --- on disk ------------------------------------------------------------------------------------------------------------

KILLED = """
import os, signal, sys
import numpy as np
from loopwright.types import Layout, Occurrence
from loopwright.diagrams.results.recorded_signals import RecordedSignals
from loopwright.diagrams.results.recorder import Recorder
from loopwright.diagrams.results.stored import header
layout = Layout.of({"a.y": (), "b.v": (2,)})
recorder = Recorder(3, to=sys.argv[1], header=header("d", RecordedSignals(layout, {}, {}, 3)))
for k in range(20_000):
    recorder.row(k / 1000, np.array([k, -k, k * k], dtype=float))
    if k % 1000 == 0:
        recorder.event(Occurrence(k / 1000, "b", "hit", {"x": k}, {"x": -k}))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_what_was_flushed_survives_a_kill(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "run")], check=False, env=os.environ)
    assert done.returncode == -9
    run = Run.open(tmp_path / "run")
    n = len(run.t)
    assert 20_000 - 1024 <= n < 20_000
    k = np.arange(n)
    assert np.array_equal(run.t, k / 1000)
    assert np.array_equal(run["a.y"], k)
    assert np.array_equal(run["b.v"], np.stack([-k, k * k], axis=1))
    assert [e.t for e in run.events] == [float(s) for s in range(len(run.events))]
    assert len(run.events) >= 19
    assert run.messages == (
        f"This run did not end: it was killed, or still runs. It holds {n} samples, until t = {run.t[-1]:g} s.",
    )


def test_a_slow_run_is_written_every_second(monkeypatch, tmp_path):
    now = 100.0
    monkeypatch.setattr(_recorder, "monotonic", lambda: now)
    recorder = Recorder(WIDTH, to=tmp_path / "run", header=head())
    for k in range(50):
        recorder.row(float(k), np.full(WIDTH, float(k)))
        there = Run.open(tmp_path / "run").t  # while it runs
        assert k - 3 <= len(there) <= k + 1, "rows of the second before the newest one may be missing, at 3 a second"
        now += 1 / 3
    recorder.finish()


def test_a_row_that_was_cut_is_left_out(tmp_path):
    t, vectors = samples(100)
    record(Recorder(WIDTH, to=tmp_path / "run", header=head()), t, vectors)
    (tmp_path / "run" / "end.json").unlink()
    file = tmp_path / "run" / "rows.f64"
    os.truncate(file, file.stat().st_size - 3)
    with open(tmp_path / "run" / "events.jsonl", "a", encoding="utf-8") as events:
        events.write('{"t": 1.0, "block": "b"')
    run = Run.open(tmp_path / "run")
    assert np.array_equal(run.t, t[:99])
    assert np.array_equal(run["box.c.z"], vectors[:99, 3])
    assert list(run.events) == []


FULL = """
import resource, sys
import numpy as np
from loopwright.blocks import SimulationError
from loopwright.types import Layout
from loopwright.diagrams.results.recorded_signals import RecordedSignals
from loopwright.diagrams.results.recorder import Recorder
from loopwright.diagrams.results.stored import header
resource.setrlimit(resource.RLIMIT_FSIZE, (100_003, 100_003))  # in the middle of a row
layout = Layout.of({"a.y": (), "b.v": (2,)})
recorder = Recorder(3, to=sys.argv[1], header=header("d", RecordedSignals(layout, {}, {}, 3)))
try:
    for k in range(20_000):
        recorder.row(k / 1000, np.full(3, float(k)))
except SimulationError as error:
    print(error)
t, data = recorder.finish()
print(len(t), np.array_equal(data, np.arange(len(t))[:, None] * np.ones(3)))
"""


@pytest.mark.skipif(os.name != "posix", reason="limits of a process")
def test_a_full_disk_ends_the_run_with_whole_rows(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "run")], check=True, capture_output=True, text=True, env=os.environ
    )
    said, kept = done.stdout.splitlines()
    assert said.startswith("the run can't be written to ")
    assert "; the samples written before are kept: " in said
    assert said.endswith(
        " grows beyond 100003 bytes, the largest file that this process may write (RLIMIT_FSIZE); expected no such limit. "
        "Lift it with 'ulimit -f unlimited' in the shell that starts Python."
    )
    assert kept == f"{100_003 // 32 // 1024 * 1024} True"
    assert len(Run.open(tmp_path / "run").t) == 3072


def test_a_stored_run_is_only_replaced_when_asked_and_those_who_read_it_keep_it(tmp_path):
    t, vectors = samples(100)
    record(Recorder(WIDTH, to=tmp_path / "run", header=head()), t, vectors)
    old = Run.open(tmp_path / "run")
    with pytest.raises(
        OptionError, match=r"found a run at '.*run' already\. Choose another path, or give overwrite=True"
    ):
        Recorder(WIDTH, to=tmp_path / "run", header=head())
    record(Recorder(WIDTH, to=tmp_path / "run", header=head(), overwrite=True), t[:10], vectors[:10])
    assert len(Run.open(tmp_path / "run").t) == 10
    assert np.array_equal(old["a.y"], vectors[:, 0])


def test_other_files_are_never_touched(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("mine")
    with pytest.raises(OptionError, match="found a file at .* Choose another path"):
        Recorder(WIDTH, to=tmp_path / "file", header=head(), overwrite=True)
    with pytest.raises(OptionError, match="holds other things than a run. Choose another path"):
        Recorder(WIDTH, to=tmp_path / "thesis", header=head(), overwrite=True)
    assert (tmp_path / "thesis" / "chapter.tex").read_text() == "mine"


def test_the_rows_on_disk_are_plain_floats_that_the_header_describes(tmp_path):
    t, vectors = samples(50, WIDTH + 1)
    record(Recorder(WIDTH, [1, 4], residual=True, to=tmp_path / "run", header=head([1, 4], True)), t, vectors)
    text = json.loads((tmp_path / "run" / "header.json").read_text(encoding="utf-8"))
    assert text["columns"] == ["t", "box.b.v[1]", "x[1]", "residual"]
    raw = np.fromfile(tmp_path / "run" / "rows.f64", "<f8").reshape(-1, len(text["columns"]))
    assert np.array_equal(raw, np.column_stack([t, vectors[:, [1, 4, 6]]]))


def test_how_a_run_ended_is_read_back(tmp_path):
    recorder = Recorder(WIDTH, to=tmp_path / "run", header=head())
    recorder.row(0.0, np.zeros(WIDTH))
    recorder.event(Occurrence(0.25, "wall", "hit", {"v": -1.5, "x": np.array([0.1, np.inf])}, {"v": 1.5}))
    recorder.finish(elapsed=0.1, messages=("plant: ok",), stopped=Stopped(0.25, "box.stop"))
    run = Run.open(tmp_path / "run")
    assert (run.elapsed, run.messages, run.stopped) == (0.1, ("plant: ok",), Stopped(0.25, "box.stop"))
    assert tuple(run.events) == (Occurrence(0.25, "wall", "hit", {"v": -1.5, "x": [0.1, float("inf")]}, {"v": 1.5}),)


# --- what is chosen, and whether it fits --------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [0, -1, 1.5, True, "2"])
def test_every_is_a_positive_integer(every):
    with pytest.raises(OptionError, match=r"found every=.*; expected a positive integer"):
        Recorder(WIDTH, every=every)


@pytest.mark.parametrize(
    ("names", "states", "expected"),
    [
        (None, True, None),
        (None, False, [0, 1, 2, 3]),
        (["e"], True, [2, 4, 5]),
        (["e"], False, [2]),
        ("a.y", False, [0]),
        (["v", "w"], False, [0, 1, 2]),
        (["box"], False, [1, 2, 3]),
        (["box.b", "a"], False, [0, 1, 2]),
        ([], True, [4, 5]),
    ],
)
def test_a_selection_takes_signals_blocks_and_subsystems(names, states, expected):
    found = RecordedSignals(LAYOUT, WIRES, {}, WIDTH).choose(names, states=states).columns
    assert (found if found is None else found.tolist()) == expected


def test_a_selection_refuses_a_name_that_is_not_there():
    with pytest.raises(UnknownNameError, match=r"no signal 'box\.b\.u' .*Did you mean 'box\.b\.v'"):
        RecordedSignals(LAYOUT, WIRES, {}, WIDTH).choose(["box.b.u"])


def test_memory_is_checked_against_what_is_really_recorded(monkeypatch):
    monkeypatch.setattr(_recorder, "machine_memory", lambda: 10**9)
    tick = Fraction(1, 1000)
    with pytest.raises(
        OptionError, match=r"^d\.duration: found 999999 ticks of 0\.001 s; 100 numbers each need .*record=.*every=.*to="
    ):
        check_memory(10**6, 100, tick, "d")
    check_memory(10**6, 98, tick, "d")  # 0.792e9 bytes
    check_memory(10**8, 100, tick, "d", every=1000)
    with pytest.raises(OptionError, match="100 numbers of each 1000th need"):
        check_memory(10**9, 100, tick, "d", every=1000)


def test_a_run_to_disk_is_checked_against_what_is_free_there(monkeypatch, tmp_path):
    monkeypatch.setattr(_recorder, "machine_memory", lambda: 1)
    monkeypatch.setattr(_recorder, "free_on_disk", lambda path: 10**9)
    tick = Fraction(1, 1000)
    check_memory(10**6, 100, tick, "d", to=tmp_path / "run")
    with pytest.raises(OptionError, match="the disk has free .*choose another disk"):
        check_memory(10**7, 100, tick, "d", to=tmp_path / "run")


def test_free_space_is_that_of_the_nearest_folder_that_exists(tmp_path):
    assert _recorder.free_on_disk(tmp_path / "a" / "b") == pytest.approx(_recorder.free_on_disk(tmp_path), rel=0.1)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("columns", [None, range(1, 20_000, 2)], ids=["all", "some"])
def test_watching_many_outputs_takes_no_time(columns):
    """20,000 outputs took 3 s of the processor in two places: each copied all before it, or searched all columns."""
    recorder = Recorder(20_000, columns)
    began = time.process_time()
    recorder.watch({f"plant.y{k}": slice(k, k + 1) for k in range(20_000)})
    assert time.process_time() - began < 0.5
    row = np.arange(20_000.0)
    row[[7, 8]] = np.nan
    recorder.row(0.25, row)
    assert recorder.lost_outputs() == {f"plant.y{k}": 0.25 for k in ((7, 8) if columns is None else (7,))}
