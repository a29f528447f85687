"""Build of an FMU from a model: generate, compile, zip, cache.

The key of a build covers everything that goes into it (equations, variables, C sources, compiler, flags, version), so
that the second build of the same model only looks up a file.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import io
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import FmuError, accepts, explain_calls, explain_disk_errors, kinds, replace_file
from ..child_processes import temporary_folder
from ..platform import OWN_CACHE, cache_folder, explain_cache_errors, native_platform, record_build
from ..toolchain import DIAGRAM_FLAGS, SUFFIXES, TARGETS, flags
from .c_code import generate, read_fmu_sources
from .compiler import Compiler, check_platform, compile_shared, find_compiler
from .html_page import index_html
from .loop_description import describe_loop, loop_page, scalarize_loop
from .loop_fmu import generate_loop, read_loop_sources
from .loop_spec import LoopSpec, write_unit
from .model_description import describe_model
from .model_spec import ModelSpec, scalarize
from .xml_elements import package_version
from .xml_fmi2 import write_description2
from .xml_fmi3 import build_description, write_description3

OTHER_FOLDER = "Name another folder."
"""Step where an FMU can't be written where its user wants it."""
_TOKEN = "{instantiation-token}"
_DATE = (1980, 1, 1, 0, 0, 0)
# Folders of binaries in FMI 2.0 (2.3.1), where they differ from FMI 3.0's platform tuples.
FOLDERS2 = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"}


@dataclass(frozen=True)
class Options:
    """Options of a build, besides the model.

    ``platforms``: FMI 3.0 platform tuples.
    """

    fmi: int
    platforms: tuple[str, ...]
    documentation: str = ""


@lru_cache(maxsize=1)
def fmi_headers() -> tuple[Path, str]:
    """Return the folder of FMI's header files, which FMPy ships, and FMPy's version."""
    spec = importlib.util.find_spec("fmpy")
    folder = Path(spec.origin).parent / "c-code" if spec is not None and spec.origin is not None else None
    if folder is None or not all((folder / f"fmi{v}Functions.h").is_file() for v in (2, 3)):
        raise FmuError(f"found no FMI header files in {folder}. Reinstall FMPy: pip install --force-reinstall fmpy.")
    return folder, importlib.metadata.version("fmpy")


def _hash(*parts: str) -> str:
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode()
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


def _text(value: Any) -> str:
    """Return all of a model as text, to be hashed."""
    if isinstance(value, ca.Function):
        return str(value.serialize())
    if is_dataclass(value):
        return repr([(f.name, _text(getattr(value, f.name))) for f in fields(value)])
    if isinstance(value, (tuple, list)):
        return repr([_text(item) for item in value])
    if isinstance(value, (np.ndarray, np.generic)):
        return repr((np.shape(value), value.tolist()))
    return repr(value)


def _code_parts(spec: ModelSpec | LoopSpec, fmi: int) -> list[str]:
    """Return the text of this sub-package and of the C of an FMU, so that a change of them builds again."""
    modules = [file.read_text(encoding="utf-8") for file in sorted(Path(__file__).parent.glob("*.py"))]
    unit = [write_unit(spec)] if isinstance(spec, LoopSpec) else []
    return [package_version(), *(text for _, text in sorted(_sources_of(spec, fmi).items())), *modules, *unit]


def build_key(spec: ModelSpec | LoopSpec, options: Options, compiler: Compiler) -> str:
    """Return the hash of everything that goes into a build; nothing is generated for it."""
    toolchain = [f"{p} {flags(p, zig=compiler.zig)}" for p in options.platforms]
    made = [_text(spec), _text(options), *_code_parts(spec, options.fmi)]
    return _hash(*made, compiler.identity, fmi_headers()[1], *toolchain)


def zip_files(files: Mapping[str, bytes]) -> bytes:
    """Zip files with fixed dates, in sorted order: same content, same bytes (FMI 3.0, 2.5.1)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            info = zipfile.ZipInfo(name, _DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3
            info.external_attr = 0o644 << 16
            archive.writestr(info, files[name], compresslevel=6)
    return buffer.getvalue()


def _binary(
    spec: ModelSpec | LoopSpec, fmi: int, platform: str, sources: Mapping[str, str], compiler: Compiler
) -> dict[str, bytes]:
    suffix = SUFFIXES.get(platform.rpartition("-")[2], ".so")
    with temporary_folder(f"the FMU {spec.name!r} can't be built", FmuError) as folder:
        library = folder / f"{spec.name}{suffix}"
        headers = fmi_headers()[0]
        more = DIAGRAM_FLAGS if isinstance(spec, LoopSpec) else ()  # as a run of it is compiled, to the last bit
        compile_shared(
            sources,
            library,
            platform=platform,
            compiled=["model.c"],
            include=[headers],
            compiler=compiler,
            more_flags=more,
        )
        name = FOLDERS2.get(platform, platform) if fmi == 2 else platform
        return {f"binaries/{name}/{library.name}": library.read_bytes()}


def _first_build(platform: str) -> str:
    """Return how long the first build for a platform takes; for Windows the compiler builds the system's C library."""
    return {"x86_64-windows": "minutes"}.get(platform, "longer")


def _sources_of(spec: ModelSpec | LoopSpec, fmi: int) -> Mapping[str, str]:
    return read_loop_sources(fmi) if isinstance(spec, LoopSpec) else read_fmu_sources(fmi)


def _archive(spec: ModelSpec | LoopSpec, options: Options, compiler: Compiler, notify: Callable[[str], None]) -> bytes:
    fmi = options.fmi
    included = _sources_of(spec, fmi)
    if isinstance(spec, LoopSpec):
        model, about = generate_loop(spec, _TOKEN, fmi), describe_loop(spec, _TOKEN, fmi)
        page = loop_page(spec, options.documentation, fmi=fmi)
    else:
        model, derivatives = generate(spec, _TOKEN, fmi)
        about = describe_model(spec, _TOKEN, derivatives=derivatives, fmi=fmi)
        page = index_html(spec, options.documentation, fmi=fmi)
    description = write_description2(about) if fmi == 2 else write_description3(about)
    token = _hash(description, model, *included.values())[:32]
    sources = {**included, "model.c": model.replace(_TOKEN, token)}
    files = {
        "modelDescription.xml": description.replace(_TOKEN, token).encode(),
        "documentation/index.html": page.encode(),
    }
    if fmi == 3:
        files["sources/buildDescription.xml"] = build_description(spec.name).encode()
    files |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    for platform in options.platforms:
        notify(f"compiling {spec.name} for {platform} (the first build on a machine takes {_first_build(platform)})")
        files |= _binary(spec, fmi, platform, sources, compiler)
    return zip_files(files)


def file_for(out: Path | str, name: str) -> Path:
    """Return the file of an FMU: ``<name>.fmu`` in a folder; a path without the ending ``.fmu`` gets it.

    Other tools find FMUs by their ending, so none is written without it. Other endings stay: ``pend.v2.fmu``.

    Raises `FmuError` if this user can't look there.
    """
    out = Path(out)
    with explain_disk_errors(f"the FMU can't be written to {str(out)!r}", out, OTHER_FOLDER, FmuError):
        if out.is_dir():
            return out / f"{name}.fmu"
    return out if out.suffix.lower() == ".fmu" else out.with_name(f"{out.name}.fmu")


def write_atomically(path: Path, data: bytes, instead: str = OTHER_FOLDER) -> None:
    """Write a file so that it is complete or does not exist, never half written; make its folder.

    Raises `FmuError` if it can't be written; ``instead`` says how to use another place.
    """
    with explain_disk_errors(f"the FMU can't be written to {str(path)!r}", path, instead, FmuError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(path) as fresh:
            fresh.write_bytes(data)
            fresh.chmod(0o644)


def check_version(fmi: object) -> None:
    """Raise `FmuError` unless FMUs of this version of FMI are built."""
    if not kinds.whole.holds(fmi) or fmi not in (2, 3):
        raise FmuError(f"found fmi={fmi!r}, expected 3 (FMI 3.0) or 2 (FMI 2.0). Give one of them.")


@accepts(
    spec=kinds.one_of_class((ModelSpec, LoopSpec), "a ModelSpec, such as model_spec(block)"),
    out=kinds.path,
    fmi=kinds.whole,
    arrays=kinds.flag,
    platform=kinds.names,
    documentation=kinds.text,
    notify=kinds.function,
)
def build_fmu(
    spec: ModelSpec | LoopSpec,
    out: Path | str | None = None,
    *,
    fmi: int = 3,
    arrays: bool = True,
    platform: str | Iterable[str] | None = None,
    documentation: str = "",
    notify: Callable[[str], None] | None = None,
) -> Path:
    """Build an FMU, or find it in the cache.

    Equal inputs give equal bytes on every machine with the same version of the compiler's package.

    Parameters
    ----------
    spec : ModelSpec or LoopSpec
        The model, or a diagram.
    out : path, optional
        File to copy it to, which gets the ending ``.fmu`` if it lacks it; a folder gets
        ``<name>.fmu``. Without it, the file in the cache is returned.
    fmi : {3, 2}
        FMI 3.0 or FMI 2.0.
    arrays : bool
        Whether vectors and matrices are arrays of FMI 3.0. Else, and always in FMI 2.0, each element is a scalar
        variable: ``s[1]``, ``s[2]``, ``m[1,2]``.
    platform : str or iterable of str, optional
        FMI 3.0 platform tuples (2.5.1.4) to build binaries for, or "all" of them; native if not given.
    documentation : str
        Plain text for ``documentation/index.html``, besides the equations and the table of variables.
    notify : callable, optional
        Called with a line of text before each long step.

    Returns
    -------
    Path
        The FMU.

    Raises
    ------
    CompilerError
        If there is no C compiler, or it fails.
    FmuError
        For another ``fmi``, and if the cache or ``out`` can't be written.
    """
    check_version(fmi)
    chosen = TARGETS if platform == "all" else (platform,) if isinstance(platform, str) else platform
    platforms = tuple(sorted(set(chosen or (native_platform(),))))
    if not (arrays and fmi == 3):
        spec = scalarize_loop(spec) if isinstance(spec, LoopSpec) else scalarize(spec)
    options = Options(fmi, platforms, documentation)
    compiler = find_compiler()
    for name in platforms:
        check_platform(compiler, name)
    cached = cache_folder() / "fmus" / build_key(spec, options, compiler)[:32] / f"{spec.name}.fmu"
    with explain_cache_errors(f"the FMU {spec.name!r} can't be kept in the cache"):
        is_there = cached.is_file()
    if not is_there:
        write_atomically(cached, _archive(spec, options, compiler, notify or (lambda message: None)), OWN_CACHE)
    with explain_cache_errors(f"the FMU {spec.name!r} can't be read from the cache"):
        data = cached.read_bytes()
    record_build(hashlib.sha256(data).hexdigest())
    if out is None:
        return cached
    target = file_for(out, spec.name)
    write_atomically(target, data)
    return target


@explain_calls
def clear_cache() -> None:
    """Delete all cached FMUs and the compiler's own cache."""
    for name in ("fmus", "zig"):
        shutil.rmtree(cache_folder() / name, ignore_errors=True)
