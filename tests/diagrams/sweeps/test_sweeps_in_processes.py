"""Sweeps in worker processes and on a cluster: equal results, and a worker that ends harms no other sample."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from loopwright.diagrams import experiments
from loopwright.diagrams.sweeps import Sample, final
from loopwright.diagrams.sweeps.cluster import Parcel
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from loopwright.diagrams.sweeps.plan import Plan
from loopwright.diagrams.sweeps.worker import Worker
from loopwright.fmus import Fmu, gantry
from support.lanes import noisy
from support.swept import double_end, fragile
from support.waiting import FAR, wait_for

QUIET = {"progress": False}
GAINS = {"fragile.gain": (1.0, 2.0, 3.0, 4.0, 5.0)}


@pytest.mark.slow
def test_interpreted_runs_are_the_same_in_processes():
    kept = {"signals": "y", "reduce": {"double": double_end, "here": lambda run: run["y"][-1] + 1.0}}
    here = fragile().sweep(GAINS, 0.2, workers=1, **kept, **QUIET)
    there = fragile().sweep(GAINS, 0.2, workers=2, **kept, **QUIET)
    np.testing.assert_allclose(there["double"], [0.4, 0.8, 1.2, 1.6, 2.0])
    for name in here.names:
        assert here[name].tobytes() == there[name].tobytes()


@pytest.mark.slow
def test_a_process_that_ends_is_a_failure_of_its_sample_alone_and_is_run_again_when_the_sweep_goes_on(tmp_path, capfd):
    table = {"fragile.gain": (1.0, 2.0, 3.0, 4.0, 5.0), "fragile.kill": (0.0, 0.0, 1.0, 0.0, 0.0)}
    sweep = {"parameters": None, "duration": 0.2, "samples": table, "reduce": {"end": final("y")}, "workers": 2}
    found = fragile().sweep(**sweep, to=tmp_path / "s", **QUIET)
    np.testing.assert_allclose(found["end"], [0.2, 0.4, np.nan, 0.8, 1.0])
    (failure,) = found.failures
    assert (failure.index, failure.kind) == (2, "WorkerEnded")
    assert "the worker process ended by signal SIGKILL in this run. Run it alone: diagram.replace({" in failure.message
    assert "about to end" in capfd.readouterr().err  # what is printed there is not lost, and breaks nothing
    again = fragile().sweep(**sweep, to=tmp_path / "s", **QUIET)
    assert again.reused == 4
    assert len(again.failures) == 1


@pytest.mark.slow
def test_a_script_without_a_guard_and_with_blocks_of_its_own_is_swept(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        """
from loopwright.blocks import Block, Input, Output, Ramp, parameter
from loopwright.diagrams import Diagram, subsystem

class Twice(Block):
    opaque = True
    gain: float = parameter(default=2.0)
    u = Input()
    y = Output()
    def output(self, t, x, u):
        return self.gain * u.u

@subsystem(sample_time=0.1)
def box(u):
    return Twice(name="twice")(u)

diagram = Diagram("script", box(Ramp(slope=1.0)).named("y"))
found = diagram.sweep({"twice.gain": (1.0, 2.0, 3.0)}, 1.0, reduce={"end": lambda run: run["y"][-1]}, workers=2, progress=False)
print(found["end"].tolist(), found.failures)
"""
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=FAR)
    assert (done.stdout, done.stderr) == ("[1.0, 2.0, 3.0] ()\n", ""), done.stderr


@pytest.mark.slow
def test_an_isolated_fmu_runs_in_worker_processes():
    diagram = experiments.hand_guiding(plant=Fmu(gantry.build(), isolate=True)).diagram
    parameters = {"controller.admittance_perp.stiffness": (150.0, 250.0, 350.0)}
    found = diagram.sweep(parameters, 0.05, signals="xi", workers=2, **QUIET)
    assert not found.failures
    for i, sample in enumerate(found.samples):
        single = diagram.replace(sample.parameters).simulate(0.05, **QUIET)
        assert found["xi"][i].tobytes() == single["xi"].tobytes()


@pytest.fixture
def cluster():
    distributed = pytest.importorskip("distributed")
    import dask

    with (
        dask.config.set({"distributed.worker.daemon": False}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as local,
        distributed.Client(local) as client,
    ):
        yield client


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Dask, when a worker is killed
def test_a_cluster_gives_equal_results_though_a_worker_is_killed_in_the_middle(cluster):
    diagram = experiments.hand_guiding().diagram
    parameters = {
        "plant.coulomb_scale": np.linspace(0.5, 1.5, 16),
        "controller.admittance_perp.stiffness": np.linspace(100.0, 300.0, 20),
    }
    kept = {"signals": "xi", "every": 50, "reduce": {"end": final("motor_force")}}
    pids = cluster.run(os.getpid)
    assert len(set(pids.values())) == 2

    def kill():
        time.sleep(3.0)
        os.kill(min(pids.values()), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    there = diagram.sweep(parameters, 2.0, client=cluster, **kept, **QUIET)
    killer.join()
    here = diagram.sweep(parameters, 2.0, workers=2, **kept, **QUIET)
    assert not there.failures
    assert min(pids.values()) not in set(cluster.run(os.getpid).values())  # it was killed
    for name in here.names:
        assert here[name].tobytes() == there[name].tobytes()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_sample_that_kills_the_workers_of_a_cluster_is_a_failure_of_its_own(cluster):
    table = {"fragile.gain": (1.0, 2.0, 3.0, 4.0, 5.0), "fragile.kill": (0.0, 0.0, 1.0, 0.0, 0.0)}
    found = fragile().sweep(None, 0.2, samples=table, reduce={"end": double_end}, client=cluster, **QUIET)
    np.testing.assert_allclose(found["end"], [0.4, 0.8, np.nan, 1.6, 2.0])
    assert [(f.index, f.kind) for f in found.failures] == [(2, "WorkerEnded")]


def test_fmus_travel_as_bytes_and_are_files_of_the_cache_where_they_arrive(tmp_path, monkeypatch):
    import cloudpickle

    file = Path(shutil.copy(gantry.build(), tmp_path / "mine.fmu"))
    content = file.read_bytes()
    diagram = experiments.hand_guiding(plant=Fmu(file)).diagram
    plan = Plan(diagram.wired, 0.01, {"compile": False}, ("xi",))
    with Worker(plan) as worker:
        here = worker.run(Sample(0, {}, 0))
    made, contents = Parcel.of(plan)
    data = cloudpickle.dumps(made)
    assert [*contents.values()] == [content]
    assert content[:1000] not in data
    file.unlink()
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "there"))
    arrived = cloudpickle.loads(data).unpack(contents)
    path = Path(arrived.diagram["plant"].file)
    assert path.is_relative_to(tmp_path / "there")
    assert path.read_bytes() == content
    assert not arrived.obstacle
    with Worker(arrived) as worker:
        there = worker.run(Sample(0, {}, 0))
    assert here.failure is there.failure is None
    assert here.signals["xi"].tobytes() == there.signals["xi"].tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [True, False], ids=["threads", "processes"])
def test_ctrl_c_ends_a_sweep_at_once_and_keeps_what_was_run(tmp_path, compiled):
    script = tmp_path / "script.py"
    script.write_text(
        f"""
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job begins with it ignored
from loopwright.diagrams import experiments
from loopwright.sweeps import InterruptedSweep, final
diagram = experiments.hand_guiding().diagram
try:
    diagram.sweep({{"plant.coulomb_scale": [0.5 + 1e-3 * i for i in range(3000)]}}, 100.0, reduce={{"end": final("xi")}},
                  workers=2, compile={compiled}, to={str(tmp_path / "s")!r}, progress=False)
except InterruptedSweep as error:
    done = sum(outcome is not None for outcome in error.sweep.outcomes)
    print(done, len(error.sweep["end"]) if done else 0, flush=True)
"""
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert wait_for(lambda: any((tmp_path / "s").glob("part-*")))
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=FAR)  # all runs take 450 s in C, 2000 s interpreted
    done, rows = out.split()
    assert (process.returncode, err) == (0, "")
    assert 0 < int(done) < 3000 == int(rows)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_lanes_on_a_cluster_give_the_bits_of_lanes_here(cluster):
    parameters = {"kp.gain": np.linspace(0.5, 1.5, 23)}
    options = {"signals": "x", "lanes": 4, "seeds": "noise.seed", **QUIET}
    there, here = (noisy().sweep(parameters, 0.3, **options, **more) for more in ({"client": cluster}, {"workers": 1}))
    assert not there.failures
    assert DIFFER in there.messages
    assert there["x"].tobytes() == here["x"].tobytes()
