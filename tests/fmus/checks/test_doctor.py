"""The doctor: verdicts, findings with next steps, trial runs that may crash, JSON; for good, broken and hostile FMUs."""

import json
import pickle
import re
import sys
import zipfile

import numpy as np
import pytest

from loopwright.blocks import ParameterError
from loopwright.diagrams import Diagram
from loopwright.diagrams.cli import main
from loopwright.fmus import ArchiveLimits, Fmu, FmuFileError, doctor, mass_spring_damper, read_description
from loopwright.fmus.platform import native_platform
from loopwright.types import FmuFault, FmuSeverity, FmuVerdict
from support.hostile import CASES, XML, binaries, described, good_files, library, packed, without_library
from support.zoo import zoo_fmu

LINUX = pytest.mark.skipif(native_platform() != "x86_64-linux", reason="its libraries are for x86_64-linux")
NOT_HERE = {FmuFault.NO_BINARY, FmuFault.OTHER_PLATFORM, FmuFault.INTERFACE, FmuFault.VERSION}


@pytest.fixture(scope="module")
def good(cache):
    return good_files(mass_spring_damper.build())


@pytest.fixture
def examine(good, tmp_path, monkeypatch):
    """examine(maker, **options) -> the diagnosis of what a maker of `support.hostile` makes; no process looks for libraries."""

    def run(make, **options):
        path = tmp_path / "plant.fmu"
        path.write_bytes(make(good))
        return doctor(path, **{"run": False, **options})

    monkeypatch.setattr("loopwright.fmus.checks.libraries.find_missing", lambda *_: ([], []))
    return run


def findings(diagnosis, fault):
    return [f for f in diagnosis.findings if f.fault == fault]


@pytest.mark.parametrize("name", [n for n in CASES if n != "archive: bomb"])
def test_a_bad_file_gets_the_verdict_and_the_finding_of_its_fault(examine, name):
    case = CASES[name]
    diagnosis = examine(case.make, limits=case.limits)
    if case.fault is None:
        assert diagnosis.verdict == FmuVerdict.EXPECTED
        assert not diagnosis.of(FmuSeverity.ERROR)
        assert diagnosis.findings  # it runs, and what is wrong is told
        assert case.finding is None or findings(diagnosis, case.finding)
    else:
        assert diagnosis.verdict == (FmuVerdict.NOT_HERE if case.fault in NOT_HERE else FmuVerdict.REFUSED)
        first = diagnosis.findings[0]
        assert (first.fault, first.severity) == (case.fault, FmuSeverity.ERROR)
        assert first.found.endswith(".")
        assert first.step.endswith(".")
        assert len(findings(diagnosis, case.fault)) == 1
    assert all(f.found and f.step for f in diagnosis.findings)
    assert "\n" not in diagnosis.headline
    assert json.loads(json.dumps(diagnosis.as_dict()))["runs"] == (case.fault is None)


def test_a_good_file_has_nothing_wrong(examine):
    diagnosis = examine(packed)
    assert diagnosis.verdict == FmuVerdict.EXPECTED
    assert diagnosis.findings == ()
    assert diagnosis.headline == "should run here, but was not tried; nothing is wrong with it"
    assert dict(diagnosis.counts)["input"] == 1
    text = str(diagnosis)
    assert f"this machine  {native_platform()}" in text
    assert "not tried     co-simulation: as asked for" in text


@LINUX
@pytest.mark.parametrize(
    ("folder", "says"),
    [
        ("x86_64-windows/mass_spring_damper.dll", "Run it on 64-bit Windows, or here in Wine"),
        ("x86-linux/mass_spring_damper.so", "Run it on Linux with a 32-bit Python"),
        ("aarch64-darwin/mass_spring_damper.dylib", "Run it on macOS on Apple silicon"),
    ],
)
def test_it_says_what_would_run_an_fmu_for_another_platform(examine, folder, says):
    diagnosis = examine(lambda files: packed(without_library(files), (f"binaries/{folder}", b"x")))
    (found,) = findings(diagnosis, FmuFault.NO_BINARY)
    assert folder.split("/")[0] in found.found
    assert says in found.step
    assert "from its sources (fmpy compile)" in found.step
    assert diagnosis.headline.startswith("does not run here: it has no library for this machine, x86_64-linux")


@pytest.mark.parametrize(
    ("attributes", "found"),
    [
        ('startTime="NaN"', "has the start time NaN; expected a finite number"),
        ('stopTime="INF"', "has the stop time INF; expected a finite number"),
        ('startTime="5" stopTime="1"', "stops at 1 s, before its start at 5 s; expected a later"),
        ('stepSize="0"', "has the step size 0; expected a positive number"),
        ('stepSize="-0.1"', "has the step size -0.1; expected a positive number"),
        ('stepSize="soon"', "has the step size soon; expected a positive number"),
        ('startTime="0" stopTime="10" stepSize="0.1"', None),
    ],
)
def test_an_impossible_default_experiment_is_told(examine, attributes, found):
    change = (r"(?s)<DefaultExperiment[^>]*/>", f"<DefaultExperiment {attributes}/>")
    diagnosis = examine(described(change))
    assert diagnosis.runs
    told = findings(diagnosis, FmuFault.EXPERIMENT)
    assert len(told) == (found is not None)
    if found:
        assert found in told[0].found


@LINUX
def test_a_capability_without_its_function_is_told(examine):
    """The name in the library's table is changed by one letter."""
    change = library(lambda data: data.replace(b"fmi3SerializeFMUState\0", b"fmi3serializeFMUState\0"))
    (found,) = findings(examine(change), FmuFault.MISSING_SYMBOL)
    assert found.found.startswith("it declares canSerializeFMUState, but binaries/")
    assert found.found.endswith("lacks fmi3SerializeFMUState; expected them.")
    other = library(lambda data: data.replace(b"fmi3SetDebugLogging\0", b"fmi3setDebugLogging\0"))
    (found,) = findings(examine(other), FmuFault.MISSING_SYMBOL)
    assert "lacks fmi3SetDebugLogging, which the standard asks for" in found.found


def test_missing_libraries_and_symbols_are_told_by_name(examine, monkeypatch):
    """Found by the system's loader in the slow tests of the commands; here by a stand-in for it."""
    place = "loopwright.fmus.checks.libraries.find_missing"
    monkeypatch.setattr(place, lambda *_: (["libone.so.3", "libtwo.so"], []))
    diagnosis = examine(lambda files: packed(files, ("resources/lib/libtwo.so", b"x")))
    (found,) = findings(diagnosis, FmuFault.MISSING_LIBRARY)
    assert diagnosis.verdict == FmuVerdict.NOT_HERE
    assert found.found == "its library needs shared libraries that are missing here: libone.so.3, libtwo.so."
    assert "libtwo.so is in the FMU, as resources/lib/libtwo.so: set LD_LIBRARY_PATH" in found.step
    monkeypatch.setattr(place, lambda *_: ([], ["acos", "cos"]))
    diagnosis = examine(packed)
    (found,) = findings(diagnosis, FmuFault.UNDEFINED_SYMBOL)
    assert diagnosis.runs
    assert found.found == "its library takes the symbol acos and 1 more from the program that loads it."


def test_nothing_is_loaded_without_a_run_where_the_system_cannot_be_asked(examine, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("code of the FMU ran")

    monkeypatch.setattr("loopwright.fmus.checks.libraries.find_missing", refuse)
    for module in ("summary", "examination"):
        monkeypatch.setattr(f"loopwright.fmus.checks.{module}.native_platform", lambda: "x86_64-darwin")
    diagnosis = examine(
        lambda files: packed(
            files, ("binaries/x86_64-darwin/mass_spring_damper.dylib", b"\xcf\xfa\xed\xfe\x07\0\0\x01")
        )
    )
    assert diagnosis.summary["native"]["available"]


def test_an_fmu_that_needs_another_program_is_tried_if_asked_only(examine, monkeypatch):
    tried = []
    monkeypatch.setattr("loopwright.fmus.checks.examination.try_out", lambda path, kind, *_, **__: tried.append(kind))
    needs = described((r"<CoSimulation ", '<CoSimulation needsExecutionTool="true" '))
    diagnosis = examine(needs, run=None)
    assert tried == ["ModelExchange"]
    (note,) = findings(diagnosis, FmuFault.TOOL)
    assert note.severity == FmuSeverity.NOTE
    assert "--run tries it" in str(diagnosis)
    examine(needs, run=True)
    assert tried == ["ModelExchange", "CoSimulation", "ModelExchange"] or set(tried[1:]) == {
        "CoSimulation",
        "ModelExchange",
    }
    examine(needs, run=False)
    assert len(tried) == 3


def test_an_fmu_of_many_variables_is_examined_in_time(examine):
    """A parser of the names' grammar took 8 ms for each name."""
    rows = "".join(f'<Float64 name="part{k}.x[{k % 7 + 1}]" valueReference="{k + 100}"/>' for k in range(1000))
    convention = (r'variableNamingConvention="[^"]*"', 'variableNamingConvention="structured"')
    diagnosis = examine(described(convention, (r"</ModelVariables>", rows + r"\g<0>")))
    assert diagnosis.findings == ()
    assert sum(diagnosis.counts.values()) > 1000
    row = '<Float64 name="a b" valueReference="100"/>'
    bad = described(convention, (r"</ModelVariables>", row + r"\g<0>"))
    (found,) = findings(examine(bad), FmuFault.STANDARD)
    assert found.found.startswith('The variable "a b" (line')


def test_an_output_that_is_called_time_runs_and_is_told(good, tmp_path):
    """Its values are those of the output, not of the time."""
    path = tmp_path / "plant.fmu"
    rename = ((r'name="time"', 'name="t0"'), (r'name="position"', 'name="time"'))
    path.write_bytes(described(*rename)(good))
    (note,) = findings(doctor(path, run=False), FmuFault.NAME)
    assert note.severity == FmuSeverity.NOTE
    other = tmp_path / "other.fmu"
    other.write_bytes(packed(good))
    values = [
        Diagram("d", Fmu(file, name="plant", start={"force": 1.0}, isolate=False)()).simulate(
            0.01, step=1e-3, progress=False
        )[f"plant.{name}"]
        for file, name in ((path, "time"), (other, "position"))
    ]
    assert np.array_equal(*values)


def test_a_token_of_another_fmu_is_refused_with_its_words(good, tmp_path):
    path = tmp_path / "plant.fmu"
    path.write_bytes(described((r'instantiationToken="[^"]*"', 'instantiationToken="another"'))(good))
    with pytest.raises(FmuFileError, match=r"can't be loaded.* The FMU says: .*token") as caught:
        Diagram("d", Fmu(path, name="plant", start={"force": 1.0}, isolate=False)()).simulate(
            0.01, step=1e-3, progress=False
        )
    assert caught.value.fault == FmuFault.LOADING
    assert caught.value.block == "plant"


# --- trials -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fault",
    [
        "step segfault 0",
        *(
            pytest.param(fault, marks=pytest.mark.slow)
            for fault in ("", "instantiate exit 0", "enter abort 0", "get fatal 0")
        ),
    ],
)
def test_a_trial_run_may_crash(tmp_path, fault):
    file = zoo_fmu(tmp_path, 3, fault)
    diagnosis = doctor(file)
    trial = next(t for t in diagnosis.trials if t.interface == "CoSimulation")
    assert trial.ran == (not fault)
    assert trial.seconds > 0.0
    if fault:
        assert diagnosis.verdict == (FmuVerdict.RUNS if any(t.ran for t in diagnosis.trials) else FmuVerdict.FAILS)
        assert diagnosis.findings[0].fault == FmuFault.TRIAL
        assert diagnosis.findings[0].severity == FmuSeverity.ERROR
        assert "co-simulation" in diagnosis.headline
    else:
        assert diagnosis.verdict == FmuVerdict.RUNS
        assert diagnosis.headline.startswith("runs here")


@pytest.mark.parametrize("fmi", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_a_trial_run_that_hangs_is_announced(tmp_path, monkeypatch, capsys, fmi):
    monkeypatch.setattr("loopwright.fmus.checks.trial.PATIENCE", 1.5)
    monkeypatch.setattr("loopwright.fmus.checks.trial.NOTICE", 0.01)
    diagnosis = doctor(zoo_fmu(tmp_path, fmi, "enter hang 0"))
    assert diagnosis.verdict == FmuVerdict.FAILS
    assert "may wait for a licence" in diagnosis.findings[0].step
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "10 steps by co-simulation" in line and "longer than 1.5 s counts as hung" in line]
    doctor(zoo_fmu(tmp_path, fmi, "enter hang 0"), progress=False)
    assert not capsys.readouterr().err


@pytest.mark.parametrize("name", ["true", "false", "12", "1e3"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn
def test_a_model_identifier_is_a_text_whatever_it_reads_as(tmp_path, fmi, name):
    """No C identifier, which is said; the library has that name nevertheless, and is found."""
    sound = zoo_fmu(tmp_path, fmi)
    file = tmp_path / "named.fmu"
    with zipfile.ZipFile(sound) as old, zipfile.ZipFile(file, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                data = data.replace(b'modelIdentifier="zoo"', f'modelIdentifier="{name}"'.encode())
            new.writestr(item.replace("zoo.so", f"{name}.so"), data)
    diagnosis = doctor(file)
    assert diagnosis.summary["interfaces"]["CoSimulation"]["modelIdentifier"] == name
    assert diagnosis.verdict == FmuVerdict.RUNS, diagnosis.headline
    assert str(diagnosis)


def test_one_of_two_interfaces_may_fail(examine, monkeypatch):
    from loopwright.fmus.checks.trial import _failure

    def run(path, kind, *_, **__):
        return _failure("its first step crashed.", "Report it.") if kind == "CoSimulation" else None

    monkeypatch.setattr("loopwright.fmus.checks.examination.try_out", run)
    diagnosis = examine(packed, run=True)
    assert diagnosis.verdict == FmuVerdict.RUNS
    assert diagnosis.headline == "runs here by model exchange only: its first step crashed"


# --- the command --------------------------------------------------------------------------------------------------------


def test_the_command(good, tmp_path, capsys):
    path = tmp_path / "plant.fmu"
    path.write_bytes(packed(good))
    assert main(["doctor", str(path), "--no-run"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{path}: should run here, but was not tried; nothing is wrong with it\n")
    assert main(["doctor", str(path), "--no-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["findings"]) == ("expected", [])
    assert told["summary"]["native"]["missing_libraries"] == []

    path.write_bytes(packed(without_library(good)))
    assert main(["doctor", str(path), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["findings"][0]["fault"]) == ("not_here", "no_binary")
    path.write_bytes(packed(good)[:-50])
    assert main(["doctor", str(path)]) == 1
    assert ": is refused: it is no FMU" in capsys.readouterr().out
    assert main(["doctor", str(path), "--max-size", "-1"]) == 2
    path.write_bytes(packed(good))
    assert main(["doctor", str(path), "--no-run", "--max-size", "0.00001"]) == 1
    assert "bytes; expected at most 1e+04" in capsys.readouterr().out
    assert main(["doctor", str(tmp_path / "absent.fmu")]) == 2


def test_texts_of_an_fmu_do_not_control_the_terminal(examine):
    """XML has no escape characters; C1 controls and texts of a trial may hold some."""
    diagnosis = examine(described((r'modelName="[^"]*"', 'modelName="a&#x9b;2Jb"')))
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", str(diagnosis))


def test_the_library_is_not_loaded_in_this_process(examine, good):
    name = binaries(good)[0].rpartition("/")[2]
    examine(packed)
    if sys.platform == "linux":
        with open("/proc/self/maps", encoding="utf-8") as maps:
            assert f"/{XML}" not in (text := maps.read())
            assert f"binaries/x86_64-linux/{name}" not in re.sub(r"unpacked/\S+", "", text)


def test_a_block_takes_limits_of_its_file(good, tmp_path):
    path = tmp_path / "plant.fmu"
    path.write_bytes(packed(good))
    with pytest.raises(FmuFileError, match=r"plant: .* expected at most 1e\+03") as caught:
        Fmu(path, name="plant", limits=ArchiveLimits(size=1000))
    assert caught.value.fault == FmuFault.TOO_LARGE
    with pytest.raises(ParameterError, match=r"plant\.limits: found 1000; expected ArchiveLimits"):
        Fmu(path, name="plant", limits=1000)
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.fault) == (str(caught.value), FmuFault.TOO_LARGE)


# --- paths and words ----------------------------------------------------------------------------------------------------


def test_a_folder_is_said_to_be_one(tmp_path):
    with pytest.raises(FmuFileError, match="is a folder; expected an FMU") as refused:
        Fmu(tmp_path)
    assert refused.value.fault == FmuFault.NO_FILE


@pytest.mark.parametrize("name", ["absent.fmu", "."])
def test_a_path_that_is_no_file_gives_json_too(tmp_path, capsys, name):
    assert main(["doctor", str(tmp_path / name), "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert found["findings"][0]["fault"] == "no_file"
    assert not found["runs"]


@LINUX
def test_a_trial_says_its_simulated_time_apart_from_that_of_the_clock(cache, tmp_path):
    diagnosis = doctor(mass_spring_damper.build(), run=True)  # its default experiment has steps of 1 ms
    (trial,) = (t for t in diagnosis.trials if t.interface == "CoSimulation")
    assert trial.step == 1e-3
    assert re.search(r"co-simulation: run for 10 steps of 0\.001 s; took \d+\.\d s\n", str(diagnosis))
    assert re.search(r"model exchange: evaluated at its start; took \d+\.\d s\b", str(diagnosis))


# --- versions -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fmi", "states", "fault", "says"),
    [
        (2, "3.9", FmuFault.VERSION, "FMI 3.9; expected FMI 1.0, 2.0 or 3.0"),
        (2, "3.0-beta.1", FmuFault.VERSION, "FMI 3.0-beta.1; expected FMI 1.0, 2.0 or 3.0"),
        (2, "3.0.1", FmuFault.DESCRIPTION, "in the form of FMI 2.0; expected the form of FMI 3.0.1"),
        (2, "1.0", FmuFault.DESCRIPTION, "in the form of FMI 2.0; expected the form of FMI 1.0"),
        (3, "1.0", FmuFault.DESCRIPTION, "in the form of FMI 3.0; expected the form of FMI 1.0"),
        (3, "2.0", FmuFault.DESCRIPTION, "in the form of FMI 3.0; expected the form of FMI 2.0"),
    ],
)
def test_a_version_that_a_description_is_not_written_in(cache, tmp_path, fmi, states, fault, says):
    files = good_files(mass_spring_damper.build(fmi=fmi))
    path = tmp_path / "plant.fmu"
    path.write_bytes(described((r'fmiVersion="[^"]*"', f'fmiVersion="{states}"'))(files))
    with pytest.raises(FmuFileError, match=re.escape(says)) as refused:
        read_description(path)
    diagnosis = doctor(path, run=False)
    assert refused.value.fault == diagnosis.findings[0].fault == fault
    assert says in diagnosis.findings[0].found


# --- values of the description ------------------------------------------------------------------------------------------


FORCE = r'(name="force".*\n.*)start="0.0"'


@pytest.mark.parametrize(
    ("before", "after", "subject", "says", "step"),
    [
        (FORCE, r'\1start="abc"', "force", "'abc'; expected a number", "Export it again."),
        (FORCE, r'\1start="0.0" min="low"', "force", "'low'; expected a number", "Export it again."),
        (FORCE, r'\1start="NaN"', "force", "'force' has the start value NaN; expected a number", "Give it one"),
        (FORCE, r'\1start="0.0" min="5" max="1"', "force", "'force' has min = 5 above max = 1", "Export it"),
        (r'<Unknown index="[0-9]*"', '<Unknown index="77"', "", "lists the index 77, which doesn't exist.", "Export"),
    ],
)
def test_an_impossible_value_of_the_description_is_found_by_name(cache, tmp_path, before, after, subject, says, step):
    with zipfile.ZipFile(mass_spring_damper.build(fmi=2)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    path = tmp_path / "plant.fmu"
    path.write_bytes(described((before, after))(files))
    found = [f for f in doctor(path, run=False).findings if says in f.found]
    assert found
    assert {f.subject for f in found} == {subject}
    assert all(f.step.startswith(step) for f in found)


def test_a_wrong_number_of_start_values_is_said(cache, tmp_path):
    file = tmp_path / "plant.fmu"
    array = (r'(<Float64 name="force"[^>]*)start="0.0"([^>]*)/>', r'\1start="1 2"\2><Dimension start="3"/></Float64>')
    file.write_bytes(described(array)(good_files(mass_spring_damper.build(fmi=3))))
    with pytest.raises(FmuFileError, match="has 2 start values; expected 3, as its dimensions say, or one") as refused:
        read_description(file)
    assert refused.value.subject == "force"
