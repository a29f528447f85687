"""Build an FMU from a model: generate, compile, zip, cache.

A build is keyed by everything that goes into it (equations, variables, runtime, compiler, flags, version), so that the
second build of the same model only looks up a file.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path

from ..blocks._errors import FmuError
from ._codegen import generate, runtime
from ._compiler import (
    SUFFIXES,
    Compiler,
    cache_folder,
    check_platform,
    compile_shared,
    find_compiler,
    flags,
    native_platform,
)
from ._description import build_description, model_description, package_version
from ._spec import ModelSpec

_TOKEN = "{instantiation-token}"
_DATE = (1980, 1, 1, 0, 0, 0)


@lru_cache(maxsize=1)
def fmi_headers() -> tuple[Path, str]:
    """Find the folder of the FMI 3.0 header files, which FMPy brings, and its version."""
    spec = importlib.util.find_spec("fmpy")
    folder = Path(spec.origin).parent / "c-code" if spec is not None and spec.origin is not None else None
    if folder is None or not (folder / "fmi3Functions.h").is_file():
        raise FmuError(
            f"FMI's header files are not in {folder}. Install FMPy anew: pip install --force-reinstall fmpy."
        )
    return folder, importlib.metadata.version("fmpy")


def _hash(*parts: str) -> str:
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode()
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


def _spec_parts(spec: ModelSpec) -> list[str]:
    groups = (spec.parameters, spec.inputs, spec.states, spec.outputs)
    variables = [
        repr([getattr(v, f) for f in v.__dataclass_fields__ if f != "start"] + v.flat_start) for g in groups for v in g
    ]
    sizes = repr([len(g) for g in groups])
    experiment = repr((float(spec.internal_step), float(spec.stop_time), float(spec.step_size)))
    functions = [spec.derivative.serialize(), spec.output.serialize()]
    return [spec.name, spec.description, sizes, *variables, experiment, *functions]


def _code_parts() -> list[str]:
    """Give the text of what writes the files, so that a change of it (while developing) builds anew."""
    folder = Path(__file__).parent
    modules = [(folder / name).read_text(encoding="utf-8") for name in ("_codegen.py", "_description.py", "_build.py")]
    return [package_version(), *(text for _, text in sorted(runtime().items())), *modules]


def build_key(spec: ModelSpec, platforms: Iterable[str], compiler: Compiler) -> str:
    """Hash all that goes into a build; nothing is generated for it."""
    toolchain = [f"{p} {flags(compiler, p)}" for p in platforms]
    return _hash(*_spec_parts(spec), *_code_parts(), compiler.identity, fmi_headers()[1], *toolchain)


def _zip(files: Mapping[str, bytes]) -> bytes:
    """Pack files with fixed dates, in sorted order: same content, same bytes (FMI 3.0, 2.5.1)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            info = zipfile.ZipInfo(name, _DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3
            info.external_attr = 0o644 << 16
            archive.writestr(info, files[name], compresslevel=6)
    return buffer.getvalue()


def _binary(spec: ModelSpec, platform: str, sources: Mapping[str, str], compiler: Compiler) -> tuple[str, bytes]:
    suffix = SUFFIXES.get(platform.rpartition("-")[2], ".so")
    with tempfile.TemporaryDirectory(prefix="loopwright-") as folder:
        library = Path(folder) / f"{spec.name}{suffix}"
        headers = fmi_headers()[0]
        compile_shared(sources, library, platform=platform, compiled=["model.c"], include=[headers], compiler=compiler)
        return f"binaries/{platform}/{library.name}", library.read_bytes()


def _archive(spec: ModelSpec, platforms: Iterable[str], compiler: Compiler, notify: Callable[[str], None]) -> bytes:
    model, derivatives = generate(spec, _TOKEN)
    description = model_description(spec, _TOKEN, derivatives=derivatives)
    token = _hash(description, model, *runtime().values())[:32]
    sources = {**runtime(), "model.c": model.replace(_TOKEN, token)}
    files = {"modelDescription.xml": description.replace(_TOKEN, token).encode()}
    files["sources/buildDescription.xml"] = build_description(spec).encode()
    files |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    for platform in platforms:
        notify(f"compiling {spec.name} for {platform} (the first build on a machine takes longer)")
        name, data = _binary(spec, platform, sources, compiler)
        files[name] = data
    return _zip(files)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file that is either there and complete, or not there."""
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=".writing-", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise FmuError(f"can't write {path}: {error}. Give another folder, or set LOOPWRIGHT_CACHE.") from error
        raise


def build_fmu(
    spec: ModelSpec,
    out: Path | str | None = None,
    *,
    platform: str | Iterable[str] | None = None,
    notify: Callable[[str], None] | None = None,
) -> Path:
    """Build an FMI 3.0 Co-Simulation FMU, or find it in the cache.

    Parameters
    ----------
    spec : ModelSpec
        The model.
    out : path, optional
        File to copy it to; a folder gets ``<name>.fmu``. Without it, the file in the cache is returned.
    platform : str or iterable of str, optional
        FMI 3.0 platform tuples (2.5.1.4) to build binaries for; native if not given.
    notify : callable, optional
        Is told what takes long, in one line.

    Returns
    -------
    Path
        The FMU.

    Raises
    ------
    CompilerError
        If there is no C compiler, or it fails.
    FmuError
        If the cache or ``out`` can't be written.
    """
    platforms = sorted({platform} if isinstance(platform, str) else set(platform or (native_platform(),)))
    compiler = find_compiler()
    for name in platforms:
        check_platform(compiler, name)
    cached = cache_folder() / "fmus" / build_key(spec, platforms, compiler)[:32] / f"{spec.name}.fmu"
    if not cached.is_file():
        write_atomically(cached, _archive(spec, platforms, compiler, notify or (lambda message: None)))
    if out is None:
        return cached
    out = Path(out)
    target = out / cached.name if out.is_dir() else out
    write_atomically(target, cached.read_bytes())
    return target


def clear_cache() -> None:
    """Delete all cached FMUs and the compiler's own cache."""
    for name in ("fmus", "zig"):
        shutil.rmtree(cache_folder() / name, ignore_errors=True)
