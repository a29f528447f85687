"""The state of an FMU in a run: saved, restored, carried to another process; and how a step may end."""

import ctypes
import gc
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import loopwright.fmus
from loopwright.fmus import Fmu, FmuError, FmuFileError, FmuRuntimeError, gantry, read_description
from loopwright.fmus.calls.instance import FmuInstance
from support import TESTS

T, N, CUT = 1e-3, 200, 77
PLANTS = ("gantry", "gantry_contact", "gantry_stiction", "bouncing_ball")
RUN = """
import pickle, sys
import numpy as np
from test_saved_states import Loop
name, file, state, first, last = pickle.load(sys.stdin.buffer)
with Loop(name, file).open() as loop:
    loop.instance.restore(loop.instance.deserialize(state))
    sys.stdout.buffer.write(pickle.dumps((loop.y.copy(), loop.go(first, last))))
"""


class Loop:
    """A plant that is driven by a feedback of its outputs and a wave, so that an input's bit shows."""

    def __init__(self, name, file, **start):
        self.T = 2e-2 if name == "bouncing_ball" else T
        start = {"position": (0.8, 0.6399), "velocity": (0.2, 0.05)} | start if name == "gantry_contact" else start
        self.plant = Fmu(file, name="plant", start=start, isolate=False)

    def open(self, stop_time=None, start_time=0.0):
        return Opened(self, stop_time, start_time)

    def drive(self, k, y, u):
        if len(u):
            u[:2] = 300 * np.sin(7 * k * self.T + np.array([0.0, 1.0])) - 50 * y[2:4] + (0.0, 43.0)
            u[2:] = 5.0 * y[:2]


class Opened:
    def __init__(self, loop, stop_time, start_time):
        self.loop = loop
        self.context = loop.plant.instantiate(list(loop.plant.inputs), stop_time, start_time=start_time)

    def __enter__(self):
        self.instance = self.context.__enter__()
        ports = self.loop.plant.inputs, self.loop.plant.outputs
        self.u, self.y = (np.zeros(sum(int(np.prod(p.shape)) for p in group.values())) for group in ports)
        self.instance.bind(self.u, self.y)
        self.instance.begin()
        return self

    def __exit__(self, *error):
        return self.context.__exit__(*error)

    def go(self, first, last):
        rows = []
        for k in range(first, last):
            self.loop.drive(k, self.y, self.u)
            self.instance.step(k * self.loop.T, self.loop.T)
            rows.append(self.y.copy())
        return np.array(rows)


@pytest.fixture(scope="module", params=PLANTS)
def loop(request, cache):
    return Loop(request.param, getattr(loopwright.fmus, request.param).build())


@pytest.fixture(scope="module")
def file(cache):
    return gantry.build()


def without(file, folder, *flags):
    """The same FMU, whose description doesn't claim these capabilities."""
    bad = folder / "less.fmu"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(bad, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                for flag in flags:
                    assert f'{flag}="true"'.encode() in data
                    data = data.replace(f'{flag}="true"'.encode(), f'{flag}="false"'.encode())
            new.writestr(item, data)
    return bad


# --- exact ------------------------------------------------------------------------------------------------------------


@pytest.mark.drawn(1)
def test_a_run_that_is_cut_and_restored_goes_on_bit_by_bit(loop):
    with loop.open() as one:
        straight = one.go(0, N)
    assert np.isfinite(straight).all()
    assert np.abs(np.diff(straight[CUT:], axis=0)).max() > 1e-4  # something happens after the cut
    with loop.open() as two:
        before = two.go(0, CUT)
        state = two.instance.save()
        y = two.y.copy()
        for _ in range(2):
            after = two.go(CUT, N)
            assert np.array_equal(np.concatenate([before, after]), straight)
            two.instance.restore(state)
            assert np.array_equal(two.y, y)  # the shared vector is that of the restored time
            assert two.instance.t == pytest.approx(CUT * loop.T, rel=1e-15)


@pytest.mark.drawn(2)
def test_a_state_restored_from_bytes_into_a_fresh_instance_goes_on_bit_by_bit(loop):
    with loop.open() as one:
        straight = one.go(0, N)
    with loop.open() as two:
        two.go(0, CUT)
        data = two.instance.serialize()
        y = two.y.copy()
    with loop.open() as three:
        three.instance.restore(three.instance.deserialize(data))
        assert np.array_equal(three.y, y)
        assert np.array_equal(three.go(CUT, N), straight[CUT:])


@pytest.mark.slow
@pytest.mark.drawn(2)
def test_another_process_goes_on_from_the_bytes(loop):
    with loop.open() as one:
        one.go(0, CUT)
        data, y = one.instance.serialize(), one.y.copy()
        rest = one.go(CUT, N)
    name = loop.plant.description.model_name
    given = pickle.dumps((name, str(loop.plant.file), data, CUT, N))
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), str(TESTS), os.environ.get("PYTHONPATH", "")]),
    }
    done = subprocess.run([sys.executable, "-c", RUN], input=given, capture_output=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr.decode()
    found, after = pickle.loads(done.stdout)
    assert np.array_equal(found, y)
    assert np.array_equal(after, rest)


def test_branches_from_one_state_do_not_disturb_each_other(file):
    loop = Loop("gantry", file)
    with loop.open() as one:
        one.go(0, 20)
        state = one.instance.save()
        straight = one.go(20, 40)
        one.instance.restore(state)
        one.u[:] = 500.0
        one.instance.step(20 * T, T)  # another way
        assert not np.array_equal(one.y, straight[0])
        later = one.instance.save()
        one.instance.restore(state)
        assert np.array_equal(one.go(20, 40), straight)
        assert later.t == pytest.approx(21 * T)


def test_a_run_goes_on_beyond_its_end_where_it_was_given_none(file):
    loop = Loop("gantry", file)
    with loop.open(stop_time=0.01) as one, pytest.raises(FmuRuntimeError, match=r"passes the stop time of 0\.01 s"):
        one.go(0, 11)
    with loop.open(stop_time=None) as one:
        assert np.isfinite(one.go(0, 11)).all()


def test_a_run_starts_at_another_time(file):
    with Loop("gantry", file).open(start_time=2.0) as one:
        assert one.instance.t == 2.0
        one.instance.step(2.0, T)
        assert one.instance.t == 2.0 + T


# --- after errors, and freed ------------------------------------------------------------------------------------------


def test_a_saved_state_outlives_an_error(file):
    loop = Loop("gantry", file)
    with loop.open() as one:
        one.go(0, 10)
        state = one.instance.save()
        straight = one.go(10, 20)
        one.u[:] = np.nan
        with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0\.02 s: setting the inputs failed with fmi3Error"):
            one.instance.step(20 * T, T)
        one.instance.restore(state)
        assert np.array_equal(one.go(10, 20), straight)


@pytest.mark.slow
def test_states_are_freed_once_by_hand_by_their_end_or_with_the_instance(file, monkeypatch):
    import fmpy.fmi3

    calls = []
    for name in ("freeFMUState", "freeInstance"):
        go = getattr(fmpy.fmi3.FMU3Slave, name)
        monkeypatch.setattr(
            fmpy.fmi3.FMU3Slave, name, lambda self, *a, go=go, name=name: (calls.append(name), go(self, *a))[1]
        )
    with Loop("gantry", file).open() as one:
        state = one.instance.save()
        assert not state.is_free
        state.free()
        state.free()
        assert calls == ["freeFMUState"]
        with pytest.raises(FmuError, match=r"^plant: found a state that has been freed, FmuState\(plant, t=0, freed\)"):
            one.instance.restore(state)
        lost = one.instance.save()
        del lost
        gc.collect()
        assert calls == ["freeFMUState"] * 2
        kept = [one.instance.save() for _ in range(3)]
    assert calls == ["freeFMUState"] * 5 + ["freeInstance"]
    del kept
    gc.collect()
    assert len(calls) == 6


@pytest.mark.slow
def test_many_states_cost_no_memory_when_they_are_dropped(file):
    import resource

    with Loop("gantry", file).open() as one:
        for _ in range(1000):
            one.instance.save()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(100_000):
            one.instance.save()
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 5000  # kB; a state has 700 bytes


# --- refused ----------------------------------------------------------------------------------------------------------


def test_a_state_of_another_instance_is_refused(file):
    loop = Loop("gantry", file)
    with loop.open() as one, loop.open() as two:
        state = one.instance.save()
        for use in (two.instance.restore, two.instance.serialize):
            with pytest.raises(FmuError, match=r"^plant: found a state of another instance.*deserialize"):
                use(state)
        one.instance.restore(state)


def test_bytes_of_another_fmu_are_refused(file, cache, tmp_path):
    other = shutil.copy(file, tmp_path / "other.fmu")
    with zipfile.ZipFile(other, "a") as archive:
        archive.writestr("documentation/edition.html", "<p>Another edition.</p>")
    with Loop("gantry", other).open() as one:
        data = one.instance.serialize()
    with Loop("gantry", file).open() as two:
        with pytest.raises(
            FmuError,
            match=r"^plant: found the state of another FMU: SHA-256 [0-9a-f]{12}… on \S+, expected",
        ):
            two.instance.deserialize(data)
        for wrong in (b"", b"hello", data[8:]):
            with pytest.raises(FmuError, match=rf"found {len(wrong)} bytes that are no state of an FMU"):
                two.instance.deserialize(wrong)
        with pytest.raises(FmuRuntimeError, match=r"reading a serialized state failed.*are no state of this FMU"):
            two.instance.deserialize(two.instance.serialize() + b"!")


def test_after_the_run_nothing_is_saved_or_restored(file):
    with Loop("gantry", file).open() as one:
        state = one.instance.save()
    for use in (one.instance.save, lambda: one.instance.restore(state)):
        with pytest.raises(FmuError, match=r"^plant: its run is over, so no state can be (saved|restored)"):
            use()


def test_an_fmu_that_cannot_says_so(file, tmp_path):
    loop = Loop("gantry", without(file, tmp_path, "canGetAndSetFMUState"))
    assert not loop.plant.can_save
    assert not loop.plant.can_serialize
    with loop.open() as one:
        with pytest.raises(
            FmuError,
            match=r"^plant: its state can't be saved: canGetAndSetFMUState is false .* run again from the start",
        ):
            one.instance.save()
        with pytest.raises(FmuError, match=r"can't be turned into bytes: canSerializeFMUState"):
            one.instance.serialize()
        assert np.isfinite(one.go(0, 5)).all()


def test_an_fmu_that_saves_but_does_not_serialize_says_so(file, tmp_path):
    loop = Loop("gantry", without(file, tmp_path, "canSerializeFMUState"))
    assert loop.plant.can_save
    with loop.open() as one:
        one.instance.restore(one.instance.save())
        for use in (one.instance.serialize, lambda: one.instance.deserialize(b"")):
            with pytest.raises(FmuError, match="canSerializeFMUState is false"):
                use()


# --- what the description claims --------------------------------------------------------------------------------------


def test_the_description_says_what_it_can(file, tmp_path):
    plant = Fmu(file)
    assert plant.variable_step
    assert plant.can_save
    assert plant.can_serialize
    assert plant.fixed_internal_step is None
    assert plant.description.has_derivatives
    assert plant.description.model_exchange == "gantry"
    assert plant.description.states == {"position": "der(position)", "velocity": "der(velocity)"}
    less = without(file, tmp_path, "canHandleVariableCommunicationStepSize", "providesDirectionalDerivatives")
    assert not Fmu(less).variable_step
    assert not read_description(less).has_derivatives
    assert not read_description(less).model_exchange_has_derivatives


def test_a_fixed_internal_step_is_read(file, tmp_path):
    bad = tmp_path / "fixed.fmu"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(bad, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                data = data.replace(b"<CoSimulation ", b'<CoSimulation fixedInternalStepSize="2e-4" ')
            new.writestr(item, data)
    assert Fmu(bad).fixed_internal_step == 2e-4


# --- how a step may end -----------------------------------------------------------------------------------------------


@pytest.fixture
def ending(file, monkeypatch):
    """A running plant whose next doStep ends as told."""

    def make(status=0, terminate=False, early=False, reached=0.0, source=file):
        loop = Loop("gantry", source)
        opened = loop.open()
        one = opened.__enter__()
        real = one.instance._fmu.dll

        def do_step(component, now, width, final, event, end, left, last):
            ctypes.c_bool.from_address(end.value).value = terminate
            ctypes.c_bool.from_address(left.value).value = early
            last._obj.value = reached
            finals.append(final.value)
            return status

        class Library:
            def __getitem__(self, name):
                return do_step if name == "fmi3DoStep" else real[name]

        monkeypatch.setattr(one.instance._fmu, "dll", Library())
        one.instance.bind(one.u, one.y)
        monkeypatch.setattr(one.instance._fmu, "dll", real)
        left.append(opened)
        return one

    left, finals = [], []
    make.finals = finals
    yield make
    for opened in left:
        opened.__exit__(None, None, None)


def test_a_discarded_step_says_what_to_do(ending, file, tmp_path):
    one = ending(status=2)
    with pytest.raises(
        FmuRuntimeError,
        match=r"^plant, t = 0 s: the step from t = 0 s by 0\.001 s was discarded, as the FMU can't compute it: it failed with fmi3Discard.*Take a smaller step, or",
    ) as e:
        one.instance.step(0.0, T)
    assert "of one length only" not in str(e.value)
    assert not one.instance.failed  # it is as it was, and may go on
    assert one.instance.t == 0.0
    fixed = without(file, tmp_path, "canHandleVariableCommunicationStepSize")
    with pytest.raises(FmuRuntimeError, match="from the start: this FMU takes steps of one length only"):
        ending(status=2, source=fixed).instance.step(0.0, T)


def test_an_error_and_a_fatal_one_are_told_apart(ending, monkeypatch):
    one = ending(status=3)
    with pytest.raises(FmuRuntimeError, match=r"the step from t = 0 s by 0\.001 s failed with fmi3Error"):
        one.instance.step(0.0, T)
    assert one.instance.failed
    assert not one.instance.fatal
    dead = ending(status=4)
    state = dead.instance.save()
    with pytest.raises(FmuRuntimeError, match="failed with fmi3Fatal"):
        dead.instance.step(0.0, T)
    calls = []
    for name in ("terminate", "freeInstance", "freeFMUState"):
        monkeypatch.setattr(dead.instance._fmu, name, lambda *a: calls.append(a))
    dead.instance.close()
    assert calls == []  # FMI 3.0, 2.2.3: nothing may be called any more
    assert state.t == 0.0


def test_an_fmu_that_asks_to_end_is_named(ending):
    with pytest.raises(
        FmuRuntimeError,
        match=r"^plant, t = 0 s: the FMU asks to end the simulation \(terminateSimulation\) at 0 s, in the step from ",
    ):
        ending(terminate=True).instance.step(0.0, T)


def test_a_step_that_returns_early_is_named(ending):
    with pytest.raises(
        FmuRuntimeError,
        match=r"^plant, t = 0 s: the step from t = 0 s by 0\.001 s returned early, at 0\.00025 s \(earlyReturn\)",
    ):
        ending(early=True, reached=2.5e-4).instance.step(0.0, T)


def test_a_step_that_ends_beyond_its_end_is_named(ending):
    with pytest.raises(
        FmuRuntimeError,
        match=r"^plant, t = 0 s: the step from t = 0 s by 0\.001 s ended at 0\.0015 s \(lastSuccessfulTime\); expected 0\.001 s",
    ):
        ending(reached=1.5e-3).instance.step(0.0, T)
    ending(reached=T).instance.step(0.0, T)  # as it should be
    ending(reached=T * (1 + 1e-12)).instance.step(0.0, T)  # but for rounding


def test_the_fmu_is_told_whether_it_may_forget_the_past(ending):
    one = ending()
    one.instance.step(0.0, T)
    one.instance.save()
    one.instance.step(T, T)
    assert ending.finals == [True, False]  # noSetFMUStatePriorToCurrentPoint


# --- the cache --------------------------------------------------------------------------------------------------------


def test_a_cache_that_cannot_be_written_is_not_the_fmus_fault(file, tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(blocked / "cache"))
    with pytest.raises(FmuError, match=r"^plant: the cache folder .* can't be used: .* Set LOOPWRIGHT_CACHE") as e:
        Loop("gantry", file).open().__enter__()
    assert not isinstance(e.value, FmuFileError)


def test_an_instance_knows_what_its_fmu_can(file):
    with Loop("gantry", file).open() as one:
        assert isinstance(one.instance, FmuInstance)
        assert one.instance.can_save
        assert one.instance.can_serialize
