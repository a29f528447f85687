"""Models in users' files: ``FILE.py:Name``, a Block class or an instance, a diagram or a subsystem."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from ...blocks.core import Block, DefinitionError, LoopwrightError, OptionError, explain_disk_errors, near
from ..diagram import Diagram
from ..wiring import Subsystem

_MODULE = "loopwright_user_model"


@dataclass(frozen=True)
class UserModel:
    """A block, a diagram or a subsystem in a user's file."""

    block: Block | Diagram | Subsystem
    imported: tuple[Path, ...]  # modules next to the file that it has imported: files, or folders of packages


@contextlib.contextmanager
def load_user_model(text: str) -> Iterator[UserModel]:
    """Load a model from ``FILE.py:Name``; its module, and those next to it that it imports, are forgotten then."""
    path, name = _split_name(text)
    with _load(path) as module:
        block = _find_block(module, path, name)
        tops = {key.partition(".")[0] for key, value in sys.modules.items() if _is_in(value, key, path.parent)}
        places = [place for top in sorted(tops) for place in (path.parent / f"{top}.py", path.parent / top)]
        yield UserModel(block, tuple(place for place in places if place.exists() and place != path))


@contextlib.contextmanager
def load_user_file(text: str, *, port: str) -> Iterator[tuple[ModuleType, Path, str]]:
    """Load a file from ``FILE.py:NAME``, or ``FILE.py``; yield its module, its path, and the name or ""."""
    path, name = _split_name(text, port, "loop.py:diagram")
    with _load(path) as module:
        yield module, path, name


def _split_name(text: str, port: str = "MODEL", example: str = "model.py:Motor") -> tuple[Path, str]:
    head, colon, name = text.rpartition(":")
    if not colon or not head.endswith(".py"):  # the colon of a Windows drive, or none
        head, name = text, ""
    path = Path(head).expanduser()
    if path.suffix != ".py":
        raise OptionError(f"found {text!r}; expected FILE.py:Name, such as {example}.", port=port)
    step = "Copy it to a folder that you can read."
    with explain_disk_errors(f"{str(path)!r} can't be read", path, step, OptionError, port=port):
        if not path.is_file():
            raise OptionError(f"there is no file {str(path)!r}. Check the path.", port=port)
        return path.resolve(), name


@contextlib.contextmanager
def _load(path: Path) -> Iterator[ModuleType]:
    """Import a file under a name that we choose; files next to it can be imported as from a script."""
    folder = str(path.parent)
    before = set(sys.modules)
    sys.path.insert(0, folder)
    writes, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        spec = importlib.util.spec_from_file_location(_MODULE, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[_MODULE] = module  # inspect finds the source by this name
        try:
            with contextlib.redirect_stdout(sys.stderr):  # its prints are no result of the command
                spec.loader.exec_module(module)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # sys.exit() too: a script without a guard
            step = f"Correct it; python {path.name} shows the whole traceback."
            if isinstance(error, SystemExit):
                step = 'Put its script behind if __name__ == "__main__".'
            raise DefinitionError(
                f"importing it fails{line_text(error, path)}: {type(error).__name__}: {_message(error)}. {step}",
                block=str(path),
            ) from error
        yield module
    finally:
        sys.dont_write_bytecode = writes
        if folder in sys.path:
            sys.path.remove(folder)
        for name in set(sys.modules) - before:
            if name == _MODULE or _is_in(sys.modules[name], name, path.parent):
                del sys.modules[name]


def _is_in(module: ModuleType, name: str, folder: Path) -> bool:
    """Return whether a module was found in a folder itself, and not in an environment below it."""
    top = folder / name.partition(".")[0]
    own = getattr(module, "__dict__", {})  # not through the module's own __getattr__, which may warn
    places = [own.get("__file__"), *(own.get("__path__") or ())]
    found = [Path(place) for place in places if place]
    return any(p == top.with_suffix(".py") or p == top or top in p.parents for p in found)


def _find_block(module: ModuleType, path: Path, name: str) -> Block | Diagram | Subsystem:
    source = str(path)
    blocks = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, Block | Diagram | Subsystem)
        or (isinstance(value, type) and issubclass(value, Block) and value.__module__ == _MODULE)
    }
    if not name:
        example = f" Write {path.name}:{next(iter(blocks))}." if blocks else ""
        raise OptionError(f"expected FILE.py:Name. Its models: {', '.join(blocks) or 'none'}.{example}", block=source)
    found = vars(module).get(name)
    if found is None:
        hint = near(name, blocks) if blocks else "There is no Block in it."
        raise OptionError(f"there is no {name!r} in it. {hint}", block=source)
    if isinstance(found, Block | Diagram | Subsystem):
        return found
    if not (isinstance(found, type) and issubclass(found, Block)):
        raise OptionError(
            f"found {type(found).__name__} for {name!r}; expected a Block: a class, or an instance with its "
            f"parameters; a diagram, or a subsystem. Its models: {', '.join(blocks) or 'none'}.",
            block=source,
        )
    needed = [key for key, spec in found.parameter_specs.items() if spec.required]
    if needed:
        instance = name.lower() if name.lower() != name else f"my_{name}"
        raise OptionError(
            f"{name} needs {' and '.join(needed)}. Make an instance in the file, {instance} = "
            f"{name}({', '.join(f'{key}=…' for key in needed)}), and give {path.name}:{instance}.",
            block=source,
        )
    try:
        return found()
    except LoopwrightError as error:
        raise OptionError(f"{name}() can't be made: {error}", block=source) from error
    except Exception as error:
        raise DefinitionError(
            f"{name}() can't be made{line_text(error, path)}: {type(error).__name__}: {_message(error)}. Correct it.",
            block=source,
        ) from error


def line_text(error: BaseException, path: Path) -> str:
    """Return the last line of a file that an error came through, as words."""
    if isinstance(error, SyntaxError) and error.filename is not None:
        return f" in line {error.lineno} of {error.filename}"
    line, step = "", error.__traceback__
    while step is not None:
        if step.tb_frame.f_code.co_filename == str(path):
            line = f" in line {step.tb_lineno}"
        step = step.tb_next
    return line


def _message(error: BaseException) -> str:
    return (error.msg if isinstance(error, SyntaxError) else str(error)).rstrip(".")
