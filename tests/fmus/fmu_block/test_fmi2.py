"""FMUs of FMI 2.0 in a run: the numbers of FMI 3.0's, of FMPy, and of closed forms; states, derivatives, statuses."""

import ctypes
import platform
import zipfile

import fmpy
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import UnknownNameError
from loopwright.diagrams import Diagram, experiments
from loopwright.fmus import (
    Fmu,
    FmuError,
    FmuFileError,
    FmuRuntimeError,
    bouncing_ball,
    gantry,
    gantry_contact,
    mass_spring_damper,
    read_description,
)
from loopwright.fmus.isolation.callbacks import Logger, format_message
from support.plants import run

T = 1e-3
M, D, K = 2.0, 0.7, 30.0
WAYS = [("model_exchange", True), ("co_simulation", True), ("model_exchange", False), ("co_simulation", False)]


@pytest.fixture(scope="module")
def file(cache):
    return gantry.build(fmi=2)


@pytest.fixture(scope="module")
def msd(cache):
    return mass_spring_damper.build(mass_spring_damper.MassSpringDamper(mass=M, damping=D, stiffness=K), fmi=2)


def edited(file, folder, change=None, entries=None):
    """The same FMU with another description, or other names of its files."""
    path = folder / f"edited{len(list(folder.iterdir()))}.fmu"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml" and change is not None:
                text = data.decode()
                assert change(text) != text
                data = change(text).encode()
            new.writestr(entries(item) if entries else item, data)
    return path


def forces(n):
    t = np.arange(n)[:, None] * T
    return 300.0 * np.sin(7.0 * t + np.array([0.0, 1.0])) + (0.0, 43.0)


# --- the numbers ------------------------------------------------------------------------------------------------------


@pytest.mark.drawn(1)
@pytest.mark.parametrize("plant", [gantry, gantry_contact], ids=["gantry", "contact"])
def test_both_versions_of_a_model_give_the_same_numbers(plant, cache):
    start = {"position": (0.8, 0.6399), "velocity": (0.2, 0.05)}
    two, three = (run(plant.build(fmi=fmi), T, start=start, motor_force=forces(300)) for fmi in (2, 3))
    assert two.keys() == three.keys()
    for name in two:
        assert two[name].shape == three[name].shape
        assert np.abs(two[name] - three[name]).max() <= 1e-13 * (1.0 + np.abs(three[name]).max()), name


def test_fmpy_steps_to_the_same_numbers(file):
    n, force = 200, (120.0, 90.0)
    ours = run(file, T, motor_force=np.tile(force, (n, 1)))
    names = ["position[1]", "position[2]", "velocity[1]", "acceleration[2]"]
    start = {"motor_force[1]": force[0], "motor_force[2]": force[1]}
    theirs = fmpy.simulate_fmu(
        str(file),
        stop_time=n * T,
        output_interval=T,
        step_size=T,
        start_values=start,
        output=names,
        set_stop_time=False,
    )
    mine = [ours["position"][:, 0], ours["position"][:, 1], ours["velocity"][:, 0], ours["acceleration"][:, 1]]
    for name, values in zip(names, mine, strict=True):
        assert np.abs(values[1:] - theirs[name][1:]).max() < 1e-12


def test_a_free_motion_is_the_matrix_exponential(msd):
    found = run(msd, 0.01, start={"position": 0.1, "velocity": -0.3}, force=np.full((100, 1), 5.0))
    A, rest = np.array([[0.0, 1.0], [-K / M, -D / M]]), np.array([5.0 / K, 0.0])
    want = [rest + expm(A * 0.01 * k) @ ((0.1, -0.3) - rest) for k in range(101)]
    assert np.abs(np.column_stack([found["position"], found["velocity"]]) - want).max() < 1e-10


@pytest.mark.parametrize("letter", "ABCD")
@pytest.mark.drawn(2)
def test_the_experiments_run_with_either_version(letter, file, cache):
    make = experiments.EXPERIMENTS[letter]
    two, three = (
        make(plant=Fmu(f, name="plant")).diagram.simulate(0.3, progress=False) for f in (file, gantry.build())
    )
    assert two.names == three.names
    for name in three.names:
        assert np.abs(two[name] - three[name]).max() <= 1e-9 * (1.0 + np.abs(three[name]).max()), name


def test_the_stop_time_and_the_start_time_are_told(file):
    plant = Fmu(file, name="plant")
    u, y = np.zeros(4), np.zeros(6)
    with plant.instantiate(list(plant.inputs), 1.002, start_time=1.0) as one:
        one.bind(u, y)
        one.begin()
        one.step(1.0, T)
        one.step(1.0 + T, T)
        with pytest.raises(
            FmuRuntimeError,
            match=r"failed with fmi2Error. .*fmi2DoStep: a step of 0.001 s from t = 1.002 s passes the stop",
        ):
            one.step(1.0 + 2 * T, T)


# --- states and derivatives -------------------------------------------------------------------------------------------


@pytest.mark.drawn(1)
@pytest.mark.parametrize("plant", [gantry_contact, bouncing_ball], ids=["contact", "ball"])
def test_a_run_that_is_cut_goes_on_bit_by_bit_here_and_in_a_fresh_instance(plant, cache):
    block = Fmu(plant.build(fmi=2), name="plant")
    width, h = sum(int(np.prod(p.shape)) for p in block.inputs.values()), 0.02
    y = np.zeros(sum(int(np.prod(p.shape)) for p in block.outputs.values()))

    def go(one, first, last):
        return np.array([(one.step(k * h, h), y.copy())[1] for k in range(first, last)])

    with block.instantiate(list(block.inputs), None) as one:
        one.bind(np.full(width, 60.0), y)
        one.begin()
        go(one, 0, 30)
        here, data = one.save(), one.serialize()
        straight = go(one, 30, 60)
        one.restore(here)
        assert np.array_equal(go(one, 30, 60), straight)
    with block.instantiate(list(block.inputs), None) as two:
        two.bind(np.full(width, 60.0), y)
        two.begin()
        two.restore(two.deserialize(data))
        assert two.t == pytest.approx(0.6, rel=1e-15)
        assert np.array_equal(go(two, 30, 60), straight)


@pytest.mark.parametrize(("interface", "exact"), WAYS)
def test_linear_models_are_the_matrices(msd, interface, exact):
    state = {"position": 0.3, "velocity": -1.2}
    model = Fmu(msd).linear_model(1.5, state=state, inputs={"force": 4.0}, interface=interface, exact=exact)
    bound = (1e-9 if exact else 1e-6) * K / M
    assert np.abs(model.A - [[0, 1], [-K / M, -D / M]]).max() < bound
    assert np.abs(model.B - [[0], [1 / M]]).max() < bound
    assert model.f == pytest.approx([-1.2, (4.0 + D * 1.2 - K * 0.3) / M], rel=1e-14)


def test_linear_models_of_vectors_are_those_of_fmi_3(file, cache):
    point = {"state": {"position": (0.6, 0.4), "velocity": (0.004, -0.3)}, "inputs": {"motor_force": (3.0, 50.0)}}
    two, three = (Fmu(f).linear_model(0.2, **point) for f in (file, gantry.build()))
    assert (two.states, two.inputs, two.outputs, two.how) == (three.states, three.inputs, three.outputs, three.how)
    for name in ("A", "B", "C", "D", "x0", "u0", "f", "y0"):
        assert np.abs(getattr(two, name) - getattr(three, name)).max() <= 1e-12 * (1 + np.abs(three.A).max())
    step = Fmu(file).step_difference(T, **point)
    assert np.abs(step.A - Fmu(gantry.build()).step_difference(T, **point).A).max() < 1e-9


def test_states_whose_order_is_not_that_of_their_names_are_set_where_they_belong(file, tmp_path):
    def swap(text):  # the Unknowns of the derivatives: velocities first, and each vector backwards
        head, _, rest = text.partition("<Derivatives>")
        body, _, tail = rest.partition("</Derivatives>")
        rows = [row for row in body.split("<Unknown") if row.strip()]
        return head + "<Derivatives>" + "".join("<Unknown" + row for row in reversed(rows)) + "</Derivatives>" + tail

    description = read_description(edited(file, tmp_path, swap))
    assert list(description.states) == ["velocity", "position"]
    assert description.state_order == (1, 0, 3, 2)
    assert read_description(file).state_order == (0, 1, 2, 3)


def test_an_fmu_that_cannot_says_so_in_its_own_words(file, tmp_path):
    flags = ("canGetAndSetFMUstate", "canSerializeFMUstate", "providesDirectionalDerivative")

    def less(text):
        for flag in flags:
            text = text.replace(f'{flag}="true"', f'{flag}="false"')
        return text

    plant = Fmu(edited(file, tmp_path, less), name="plant")
    assert (plant.can_save, plant.can_serialize) == (False, False)
    assert plant.linear_model().how == "differences in model-exchange"
    with plant.instantiate([], None) as one:
        one.bind(np.zeros(0), np.zeros(6))
        one.begin()
        with pytest.raises(FmuError, match="canGetAndSetFMUstate is false"):
            one.save()
        with pytest.raises(FmuError, match="canSerializeFMUstate is false"):
            one.serialize()
        with pytest.raises(FmuError, match="providesDirectionalDerivative is false"):
            one.directional_derivative(["velocity"], ["motor_force"], [1.0, 0.0])


# --- how a step may end -----------------------------------------------------------------------------------------------


@pytest.fixture
def ending(file, monkeypatch):
    """A running plant whose next doStep returns a status; ``later`` are those of fmi2GetStatus."""
    left = []

    def make(status, later=(), terminated=False):
        plant = Fmu(file, name="plant")
        context = plant.instantiate([], None)
        one = context.__enter__()
        left.append(context)
        real, more = one._fmu.dll, list(later)

        class Library:
            def __getitem__(self, name):
                return (lambda *_: status) if name == "fmi2DoStep" else real[name]

        monkeypatch.setattr(one._fmu, "getStatus", lambda kind: more.pop(0))
        monkeypatch.setattr(one._fmu, "getBooleanStatus", lambda kind: terminated)
        monkeypatch.setattr(one._fmu, "dll", Library())
        one.bind(np.zeros(0), np.zeros(6))
        monkeypatch.setattr(one._fmu, "dll", real)
        one.begin()
        return one

    yield make
    for context in left:
        context.__exit__(None, None, None)


def test_a_pending_step_is_waited_for(ending):
    ending(5, later=[5, 5, 0]).step(0.0, T)
    with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0 s: the step .* failed with fmi2Error"):
        ending(5, later=[5, 3]).step(0.0, T)


def test_discarded_steps_and_ended_simulations_are_told_apart(ending):
    with pytest.raises(
        FmuRuntimeError, match=r"was discarded, as the FMU can't compute it: it failed with fmi2Discard"
    ):
        ending(2).step(0.0, T)
    with pytest.raises(FmuRuntimeError, match="asks to end the simulation"):
        ending(2, terminated=True).step(0.0, T)


def test_after_a_fatal_status_nothing_is_called(ending, monkeypatch):
    one, calls = ending(4), []
    with pytest.raises(FmuRuntimeError, match="failed with fmi2Fatal"):
        one.step(0.0, T)
    for name in ("terminate", "freeInstance"):
        monkeypatch.setattr(one._fmu, name, lambda *a: calls.append(a))
    one.close()
    assert calls == []


def test_ports_that_are_split_or_are_parameters_have_their_columns(file):
    whole, split = Fmu(file), Fmu(file, rename={"motor_force[2]": "hoist"})
    point = {"state": {"velocity": (0.004, -0.3)}}
    one, two = whole.linear_model(**point), split.linear_model(**point, inputs={"hoist": 0.0})
    assert two.inputs == ("motor_force[1]", "hoist", "external_force[1]", "external_force[2]")
    assert np.array_equal(one.B, two.B)
    more = Fmu(file, ports=["motor_force", "coulomb_scale", "velocity"])
    model = more.linear_model(**point, inputs={"coulomb_scale": 1.0})
    assert model.inputs == ("coulomb_scale", "motor_force[1]", "motor_force[2]")
    mass = np.array([7.61, 4.41]) + np.array([29.26, 16.79])
    friction = -np.array([65.42, 37.69]) * np.tanh(np.array([0.004, -0.3]) / 0.01) / mass
    assert np.abs(model.B[2:, 0] - friction).max() < 1e-6 * np.abs(friction).max()
    assert model.how.startswith("differences")


# --- names and files --------------------------------------------------------------------------------------------------


def test_scalars_of_an_array_are_read_set_and_renamed(file):
    plant = Fmu(file, name="plant", start={"position[2]": 0.25, "velocity": (0.1, 0.2)})
    assert plant.start["position"].tolist() == [0.8, 0.25]
    assert repr(plant["position[2]"]) == "<signal plant.position[1]>"
    again = plant.replace(start={**plant.start, "position[2]": 0.3})
    assert again.start["position"].tolist() == [0.8, 0.3]
    split = Fmu(file, name="plant", rename={"position[1]": "y_axis"})
    assert [*split.outputs] == ["y_axis", "position[2]", "velocity", "acceleration"]
    rest = {"motor_force": (0.0, 40.0), "external_force": (0.0, 0.0)}
    runs = [Diagram("d", p(**rest)).simulate(0.02, step=T, progress=False) for p in (Fmu(file, name="plant"), split)]
    assert np.array_equal(runs[0]["plant.position"][:, 0], runs[1]["plant.y_axis"])
    assert np.array_equal(runs[0]["plant.position"][:, 1], runs[1]["plant.position[2]"])
    with pytest.raises(UnknownNameError, match=r"no output 'position\[3\]'"):
        plant["position[3]"]


def test_the_only_library_of_the_folder_is_taken_whatever_its_name(msd, tmp_path):
    other = edited(msd, tmp_path, entries=lambda n: n.replace("mass_spring_damper.so", "any.so"))
    assert read_description(other).binary == "binaries/linux64/any.so"
    found = run(other, 0.01, start={"position": 0.1}, force=np.zeros((3, 1)))
    assert np.array_equal(
        found["position"], run(msd, 0.01, start={"position": 0.1}, force=np.zeros((3, 1)))["position"]
    )


def test_a_binary_for_other_platforms_only_is_named(msd, tmp_path):
    other = edited(msd, tmp_path, entries=lambda n: n.replace("/linux64/", "/win32/"))
    with pytest.raises(FmuFileError, match=r"has no binary for this platform, linux64 \(it has: win32\)"):
        Fmu(other)


def test_a_wrong_guid_is_quoted(msd, tmp_path):
    other = edited(msd, tmp_path, lambda text: text.replace('guid="', 'guid="0'))
    with pytest.raises(FmuFileError, match=r"can't be loaded: .*The FMU says: plant: error: .*"):
        Diagram("d", Fmu(other, name="plant")(force=0.0)).simulate(0.1, step=0.1, progress=False)


def test_an_fmu_of_which_a_process_can_have_one_instance_is_refused_a_second(msd, tmp_path):
    flag = 'canBeInstantiatedOnlyOncePerProcess="true" canGetAndSetFMUstate'
    one = Fmu(edited(msd, tmp_path, lambda text: text.replace("canGetAndSetFMUstate", flag)), name="one", isolate=False)
    with one.instantiate([], None):
        with pytest.raises(FmuError, match=r"^two: its FMU .*canBeInstantiatedOnlyOncePerProcess\), and one is one"):
            one.replace(name="two").instantiate([], None).__enter__()
        with Fmu(msd).instantiate([], None):  # another one
            pass
    with one.replace(name="two").instantiate([], None):
        pass


# --- messages ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "arguments", "expected"),
    [
        (b"plain", [], "plain"),
        (
            b"50 %% of %s at t=%g (%d, 0x%lx)",
            [ctypes.c_char_p(b"this"), ctypes.c_double(0.25), ctypes.c_int(-3), ctypes.c_long(255)],
            "50 % of this at t=0.25 (-3, 0xff)",
        ),
        (
            b"%-6s|%5.2f|%c|%u",
            [ctypes.c_char_p(b"ab"), ctypes.c_double(2.0), ctypes.c_int(65), ctypes.c_uint(7)],
            "ab    | 2.00|A|7",
        ),
        (b"%s%n", [ctypes.c_void_p(8)], "?%n"),
        (
            b"%999999999d|%*d|%.3s",
            [ctypes.c_int(1), ctypes.c_int(4), ctypes.c_int(2), ctypes.c_char_p(b"abcdef")],
            "1".rjust(200) + "|   2|abc",
        ),
    ],
)
def test_printf_formats_of_messages_are_filled_in(text, arguments, expected):
    if platform.system() != "Linux":
        pytest.skip("arguments are read on Linux only")
    found = []
    logger = Logger(lambda env, name, status, category, message, *more: found.append(format_message(message, more)))
    address = ctypes.cast(logger, ctypes.c_void_p).value
    fixed = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)
    call = ctypes.CFUNCTYPE(None, *fixed, *map(type, arguments))(address)
    call(None, b"i", 3, b"c", text, *arguments)
    assert found == [expected]
