"""FMUs with Python inside, made by the package PythonFMU, for equations that can't be traced.

They need an interpreter with NumPy and Loopwright where they run, and their description says so. Build a block that can
be traced with `loopwright.build`: such an FMU needs no other software.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import io
import json
import os
import pickle
import sys
import zipfile
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from types import FunctionType
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from ...blocks.core import (
    Block,
    DefinitionError,
    FmuError,
    Port,
    accepts,
    explain_disk_errors,
    kinds,
)
from ...blocks.tracing import bundle, traced_parameters
from ..child_processes import find_python, run_in_group, temporary_folder
from ..platform import record_build
from .fmu_package import file_for, write_atomically, zip_files
from .from_block import parameter_spec
from .html_page import block_text
from .model_spec import check_file_name
from .xml_elements import package_version, unit_element

NEEDS = "Needs Python where it runs, with NumPy and Loopwright {version}: its equations are Python code."
"""Sentence at the end of such an FMU's description."""

_INSTALL = 'Install it: pip install "loopwright[python-fmu]".'
_MAKE = (
    "import json, sys\n"
    "from pythonfmu.builder import FmuBuilder\n"
    "script, folder, files, options = json.loads(sys.argv[1])\n"
    "FmuBuilder.build_FMU(script, folder, files, **options)\n"
)


@accepts(
    block=kinds.one_of_class(Block, "a block"),
    out=kinds.path,
    name=kinds.text,
    internal_step=kinds.positive,
    stop_time=kinds.positive,
    step_size=kinds.positive,
    files=kinds.paths,
    notify=kinds.function,
)
def build_python(
    block: Block,
    out: Path | str | None = None,
    *,
    name: str | None = None,
    internal_step: float = 1e-3,
    stop_time: float = 1.0,
    step_size: float = 1e-3,
    files: Iterable[Path | str] = (),
    notify: Callable[[str], None] | None = None,
) -> Path:
    """Export a block with equations in any Python as an FMI 2.0 co-simulation FMU, which needs Python to run.

    A continuous block is integrated by the Runge-Kutta method of order 4. A sampled block has ``step_size`` as its
    sample time, and steps must be multiples of it. Vectors become scalars with an index, ``s[1]``, ``s[2]``. The file
    that defines the block's class goes into the FMU. A file of a package does not: install the package where the FMU
    runs.

    Parameters
    ----------
    block : Block
        The model.
    out : path, optional
        File or folder for the FMU; without it, the current folder. A file gets the ending ``.fmu`` if it lacks it.
    name : str, optional
        Name of the model; without it, the class name in lower case.
    internal_step : float
        Longest step of the integrator, s.
    stop_time, step_size : float
        Default experiment, s.
    files : iterable of path
        Further files to include: modules that the block's file imports, data.
    notify : callable, optional
        Called with a line of text before a long step.

    Raises
    ------
    DefinitionError
        For a block that can't be exported, or whose equations fail at the start values.
    FmuError
        If PythonFMU is not installed, or fails.
    """
    if importlib.util.find_spec("pythonfmu") is None:
        raise FmuError(f"found no package pythonfmu; expected it, to make an FMU with Python inside. {_INSTALL}")
    name = name or type(block).__name__.lower()
    if not (name.isidentifier() and name.isascii()):
        raise DefinitionError(f"found {name!r} as the model's name; expected letters, digits and _, such as my_model.")
    check_file_name(name)
    source, kind = _source(block, name), _kind(block, name)
    values = _values(block, name, kind)
    about: dict[str, Any] = {
        "name": name,
        "description": _description(block, name),
        "kind": kind,
        "internal_step": float(internal_step),
        "stop_time": float(stop_time),
        "step_size": float(step_size),
        "file": None if source is None else source.name,
        "values": {k: {"kind": v["kind"], "shape": v["shape"], "start": v["start"]} for k, v in values.items()},
        "variables": _variables(values, kind),
    }
    pickled = _pickle(block, name, None if source is None else type(block).__module__)
    taken = [path for path in (source, *map(Path, files)) if path is not None]
    for path in taken:
        if not path.exists():
            raise DefinitionError(f"found no file {str(path)!r} to include. Check the path.", block=name)
    slave = (Path(__file__).parent / "python_slave.py").read_text(encoding="utf-8")
    digest = hashlib.sha256(repr((about, pickled, slave, package_version())).encode())
    for path in taken:
        digest.update(path.read_bytes() if path.is_file() else b"")
    about["guid"] = digest.hexdigest()[:32]
    about["module"] = f"loopwright_{name}_{about['guid'][:8]}"  # one interpreter runs all FMUs, so names must differ
    (notify or (lambda message: None))(f"packing {name} with PythonFMU")
    with temporary_folder("the FMU can't be made", FmuError, block=name) as folder:
        (folder / "in").mkdir()
        script = folder / "in" / f"{about['module']}.py"
        script.write_text(slave, encoding="utf-8")
        (folder / "in" / "loopwright.json").write_text(json.dumps(about), encoding="utf-8")
        (folder / "in" / "loopwright.pickle").write_bytes(pickled)
        own = [folder / "in" / "loopwright.json", folder / "in" / "loopwright.pickle"]
        archive = _make(script, folder / "out", [*own, *taken], name, kind)
        data = _complete(archive, about, values, block)
    with explain_disk_errors("the FMU can't be written", os.curdir, "Name a folder: out=….", FmuError, block=name):
        target = file_for(Path.cwd() if out is None else out, name)
    write_atomically(target, data)
    record_build(hashlib.sha256(data).hexdigest())
    return target


# --- content of the FMU ---------------------------------------------------------------------------------------------


def _description(block: Block, name: str) -> str:
    first = (type(block).__doc__ or name).strip().splitlines()[0]
    return f"{first} {NEEDS.format(version=package_version())}"


def _kind(block: Block, name: str) -> str:
    if block.opaque:
        text = "found no equations of its own; expected a block with equations. Export the model that it represents."
        raise DefinitionError(text, block=name)
    if block.events:
        raise DefinitionError(
            f"it has events ({', '.join(block.events)}), which an FMU with Python inside can't have so far; write its "
            "equations with NumPy functions and build it without Python.",
            block=name,
        )
    for equation in ("constants", "initial"):
        if hasattr(block, equation) and not (equation == "constants" and block.computed_from):
            raise DefinitionError(
                f"it has {equation}(…), which an FMU with Python inside can't have; move it into the equations.",
                block=name,
            )
    if hasattr(block, "derivative"):
        return "continuous"
    if block.states and not hasattr(block, "update"):
        raise DefinitionError(
            f"it has states ({', '.join(block.states)}) but neither derivative(t, x, u) nor update(t, x, u); write "
            "one.",
            block=name,
        )
    return "sampled" if block.states else "static"


def _values(block: Block, name: str, kind: str) -> dict[str, dict[str, Any]]:
    """Return the FMU's values by name: kind, shape, start value, and the port or declaration."""
    found: dict[str, dict[str, Any]] = {}

    def put(key: str, role: str, start: Any, port: Any, **more: Any) -> None:
        array = np.asarray(start, dtype=float)
        found[key] = {"kind": role, "shape": list(array.shape), "start": array.ravel().tolist(), "port": port} | more

    shapes: dict[str, tuple[int, ...]] = {}
    for key, given in block.inputs.items():
        if given.shape is None:
            raise DefinitionError("found no declared shape; declare it with Input(shape=…).", block=name, port=key)
        shapes[key] = given.shape
        put(key, "input", np.broadcast_to(0.0 if given.default is None else given.default, given.shape), given)
    for key, value in traced_parameters(block):
        put(key, "parameter", value, parameter_spec(block, key))
    for key, state in block.states.items():
        put(key, "state", state.start_value(block, shapes), state)
    x, u = (
        {
            k: float(v["start"][0]) if not v["shape"] else np.reshape(v["start"], v["shape"])
            for k, v in found.items()
            if v["kind"] == role
        }
        for role in ("state", "input")
    )
    outputs = {k: p for k, p in block.outputs.items() if k not in block.states}
    if outputs and not hasattr(block, "output"):
        raise DefinitionError(
            f"it declares the outputs {', '.join(outputs)} but has no output(t, x, u); write it.", block=name
        )
    rates = {"continuous": ["derivative"], "sampled": ["update"]}.get(kind, [])
    # Each equation is called once at the start: a wrong shape is an error now, not in another tool.
    for equation, ports in [*((rate, block.states) for rate in rates), *([("output", outputs)] if outputs else [])]:
        made = _call_at_start(block, name, equation, x, u, len(ports))
        for (key, port), value in zip(ports.items(), made, strict=True):
            shape = list(np.shape(value))
            expected = tuple(found[key]["shape"]) if equation != "output" else port.shape
            if expected is not None and tuple(shape) != expected:
                raise DefinitionError(
                    f"its {equation} gives shape {tuple(shape)}; expected {expected}.", block=name, port=key
                )
            if equation == "output":
                put(key, "output", value, port)
    return found


def _call_at_start(block: Block, name: str, equation: str, x: Any, u: Any, count: int) -> tuple[Any, ...]:
    """Return an equation's results at the start values."""
    function = getattr(block, equation)
    sampled = "T" in inspect.signature(function).parameters and not hasattr(block, "derivative")
    try:
        made = function(0.0, bundle("x", x), bundle("u", u), **({"T": 1.0} if sampled else {}))
        parts = (made,) if count == 1 else tuple(made)
        [np.asarray(part, dtype=float) for part in parts]
    except Exception as error:
        failure = f"{type(error).__name__}: {error}".rstrip(".")
        step, line = error.__traceback__, ""
        while step is not None:
            if step.tb_frame.f_code.co_name == equation:
                line = f" in line {step.tb_lineno} of {step.tb_frame.f_code.co_filename}"
            step = step.tb_next
        raise DefinitionError(
            f"its {equation} fails at the start values{line}: {failure}. Correct it, or the start values.",
            block=name,
        ) from error
    if len(parts) != count:
        raise DefinitionError(f"its {equation} returned {len(parts)} values; expected {count}.", block=name)
    return parts


def _variables(values: dict[str, dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    """Return the scalar variables of the FMU, in order."""
    found = []
    running = "discrete" if kind == "sampled" else "continuous"
    for key, v in values.items():
        role, port = v["kind"], v["port"]
        causality = {"input": "input", "parameter": "parameter", "output": "output"}.get(role, "local")
        if role == "state" and port.output:
            causality = "output"
        variability = running if role != "parameter" else "tunable" if getattr(port, "tunable", True) else "fixed"
        for i, index in enumerate(np.ndindex(*v["shape"])):
            suffix = f"[{','.join(str(n + 1) for n in index)}]" if index else ""
            found.append(
                {
                    "name": key + suffix,
                    "of": key,
                    "index": i,
                    "causality": causality,
                    "variability": variability,
                    "initial": {"input": None, "output": "calculated"}.get(role, "exact"),
                    "description": port.description,
                }
            )
    return found


# --- Python code ----------------------------------------------------------------------------------------------------


def _source(block: Block, name: str) -> Path | None:
    """Return the file to include; None if the class belongs to a package that can be imported."""
    module = sys.modules.get(type(block).__module__)
    if module is not None and getattr(module, "__package__", None):
        return None
    file = getattr(module, "__file__", None)
    if file is None or not Path(file).is_file():
        raise DefinitionError(
            "found a class that is not defined in a file; expected a file to include. Write it into a .py file.",
            block=name,
        )
    return Path(file)


class _Pickler(pickle.Pickler):
    """Pickler that writes objects of the block's own file by their names in that file."""

    def __init__(self, stream: io.BytesIO, module: str | None):
        super().__init__(stream, protocol=4)
        self._module = module

    def persistent_id(self, item: Any) -> Any:
        own = isinstance(item, type | FunctionType) and item.__module__ == self._module
        return item.__qualname__ if own and self._module is not None else None


def _pickle(block: Block, name: str, module: str | None) -> bytes:
    stream = io.BytesIO()
    try:
        _Pickler(stream, module).dump(block)
    except Exception as error:  # the exception depends on the object
        raise DefinitionError(
            f"its parameters can't be written into the FMU: {error}. Keep to numbers, text and classes of its file.",
            block=name,
        ) from error
    if "<locals>" in type(block).__qualname__:
        text = "found a class that is defined inside a function; define it at the top of its file."
        raise DefinitionError(text, block=name)
    return stream.getvalue()


# --- the archive ----------------------------------------------------------------------------------------------------


def _make(script: Path, out: Path, files: list[Path], name: str, kind: str) -> Path:
    """Run PythonFMU's builder in its own process, since it leaves modules and paths behind and runs the block."""
    options = {
        "needsExecutionTool": True,
        "canHandleVariableCommunicationStepSize": kind != "sampled",
        "canGetAndSetFMUstate": True,
        "canSerializeFMUstate": True,
    }
    given = json.dumps([str(script), str(out), [str(path.resolve()) for path in files], options])
    done = run_in_group([find_python(), "-c", _MAKE, given], cwd=script.parent)
    made = out / f"{name}.fmu"
    if done.returncode or not made.is_file():
        said = "\n".join((done.stderr.strip() or done.stdout.strip() or "(nothing)").splitlines()[-12:])
        raise FmuError(
            f"PythonFMU failed for {name}. Its message:\n{said}\n"
            "If a module is missing, include it with files=[…], or install it."
        )
    return made


def _complete(file: Path, about: dict[str, Any], values: dict[str, dict[str, Any]], block: Block) -> bytes:
    """Add the parts that PythonFMU leaves out: units, limits, initial unknowns, a page of documentation."""
    with zipfile.ZipFile(file) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    root = ET.fromstring(files["modelDescription.xml"])
    root.attrib.pop("generationDateAndTime", None)  # same input, same bytes
    units: set[str] = set()
    variables = root.findall("ModelVariables/ScalarVariable")
    for element, v in zip(variables, about["variables"], strict=True):
        port, real = values[v["of"]]["port"], element.find("Real")
        assert real is not None
        unit = _unit_of(port, v["index"])
        if unit is not None:
            real.set("unit", unit)
            units.add(unit)
        for key, attribute in (("min", "minimum"), ("max", "maximum"), ("nominal", "nominal")):
            if (value := getattr(port, attribute, None)) is not None:
                real.set(key, repr(float(value)))
    structure, place = root.find("ModelStructure"), list(root).index(root.find("CoSimulation"))  # type: ignore[arg-type]
    assert structure is not None
    unknown = [str(i + 1) for i, v in enumerate(about["variables"]) if v["initial"] == "calculated"]
    if unknown:
        initial = ET.SubElement(structure, "InitialUnknowns")
        for index in unknown:
            ET.SubElement(initial, "Unknown", {"index": index})
    if units:
        definitions = ET.fromstring(f"<UnitDefinitions>{''.join(map(unit_element, sorted(units)))}</UnitDefinitions>")
        root.insert(place + 1, definitions)
    ET.indent(root)
    files["modelDescription.xml"] = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    files["documentation/index.html"] = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(about["name"])}</title></head>'
        f"<body><h1>{escape(about['name'])}</h1>\n<p>{escape(about['description'])}</p>\n"
        f"<pre>{escape(block_text(block))}</pre></body></html>\n"
    ).encode()
    return zip_files(files)


def _unit_of(port: Port | Any, index: int) -> str | None:
    if isinstance(port.unit, tuple):
        return str(port.unit[index]) if index < len(port.unit) else None
    return port.unit
