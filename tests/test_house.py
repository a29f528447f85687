"""The house's own rules, read from the sources: nothing depends on words of English texts."""

import ast
import importlib
import re
from functools import cache

import pytest

from support.sources import ROOMS, ROOT, SOURCES, find_nodes, nodes_of

SEARCHES = {
    "count",
    "endswith",
    "find",
    "index",
    "partition",
    "removeprefix",
    "removesuffix",
    "rfind",
    "rindex",
    "rpartition",
    "rsplit",
    "split",
    "startswith",
}
PATTERNS = {"compile", "findall", "finditer", "fullmatch", "match", "search", "split"}
TEXTS = {"args", "confirmed_by", "how", "message", "note", "notes", "title"}
"""Attributes that hold texts for people."""
WORDS = re.compile(r"[A-Za-z]{2,}[^\n]* |\A[A-Z]?[a-z]{4,}[a-z ,.;:]*\Z| [^\n]*[A-Za-z]{2,}|\A_[a-z]{3,}\Z")
"""A text with a space beside a word, a word alone, or the ending of a key."""

ALLOWED = {
    "blocks/core/errors.py": {"; expected "},  # the form of every message: found, expected, next step
    "blocks/library/python_control.py": {"Discrete"},  # the beginning of a class's name
    "diagrams/compiled/generated_text.py": {"  return 0;\n", "casadi_real "},  # C code that CasADi writes
    "diagrams/report/pages/svg.py": {r'<svg[^>]*?\bwidth="([\d.]+)(pt|px)?" height="([\d.]+)'},  # Matplotlib's SVG
    "fmus/calls/step_options.py": {"Loopwright"},  # the tool that has built an FMU: its description has it as a text
    "fmus/checks/libraries.py": {r"^\s*(\S+) => not found", "linux"},  # ldd's output; sys.platform
    "fmus/checks/validation.py": {"has no start value", "is not defined"},  # FMPy's problems are texts alone
    "fmus/export/c_code.py": {"int "},  # in the C code that CasADi writes
    "fmus/export/compiler.py": {"windows"},  # the end of a platform's name
    "fmus/toolchain.py": {"windows"},  # the end of a platform's name
    "fmus/export/own_sources.py": {"#define LW_N_Z 0\n", '^#include "(.*)"$'},  # C code of our own
    "fmus/export/target_code.py": {  # C code of our own
        r"^static [^\n;=]*\b(lw_\w+)\([^\n]*\) \{(?:[^\n]*\}|\n.*?^\})\n"
    },
    "fmus/export/target_measure.py": {r"undefined symbol: (\w+)", "bkpt"},  # a linker's output; an instruction
    "fmus/export/python_slave.py": {"linux"},  # sys.platform
}
"""Literals that may be searched for, by file: the texts are not for people, or foreign code gives nothing else."""


@pytest.fixture(scope="module", autouse=True)
def trees_are_let_go():
    """Let the trees of all sources go, some 200 MB; this file is read after that on architecture, which has them made."""
    yield
    nodes_of.cache_clear()
    constants.cache_clear()


def literals(node):
    """Yield the texts within an expression that are searched for: constants, tuples of them, parts of f-strings."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.JoinedStr | ast.Tuple | ast.List | ast.Set):
        for part in getattr(node, "values", getattr(node, "elts", ())):
            yield from literals(part)
    elif isinstance(node, ast.Name) and node.id in constants():
        yield from literals(constants()[node.id])


@cache
def constants():
    found = {}
    for source in SOURCES:
        for statement in find_nodes(source, ast.Module)[0].body:
            if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
                found[statement.targets[0].id] = statement.value
    return found


def is_text(node):
    """Whether an expression is a text for people: ``str(error)``, ``error.message``, ``number.confirmed_by``."""
    for part in ast.walk(node):
        if isinstance(part, ast.Attribute) and part.attr in TEXTS:
            return True
        if isinstance(part, ast.Call) and isinstance(part.func, ast.Name) and part.func.id in ("str", "repr"):
            return bool(part.args) and isinstance(part.args[0], ast.Name) and "err" in part.args[0].id
    return False


def prose_read(nodes):
    """Yield (line, literal) wherever a text is searched for words, or compared with some."""
    for node in nodes:
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            within = isinstance(node.ops[0], ast.In | ast.NotIn)
            if within and is_text(node.comparators[0]):
                yield from ((node.lineno, text) for text in literals(node.left))
            spaced = (
                text for side in sides for text in literals(side) if " " in text.strip() or (" " in text and within)
            )
            yield from ((node.lineno, text) for text in spaced if re.search("[A-Za-z]{2,}", text))
            if not within and any(is_text(side) for side in sides):
                yield from ((node.lineno, text) for side in sides for text in literals(side))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            of_re = isinstance(node.func.value, ast.Name) and node.func.value.id == "re"
            if (of_re and node.func.attr in PATTERNS) or (not of_re and node.func.attr in SEARCHES):
                texts = [text for argument in node.args[:1] for text in literals(argument)]
                yield from ((node.lineno, text) for text in texts if re.search(" [a-z]|[a-z] ", text) if of_re)
                yield from ((node.lineno, text) for text in texts if WORDS.search(text) if not of_re)


def found_in(name):
    return list(prose_read(find_nodes(ROOT / name, ast.Compare, ast.Call)))


def test_nothing_depends_on_words_of_a_text():
    names = [path.relative_to(ROOT).as_posix() for path in SOURCES]
    found = [(name, line, text) for name in names for line, text in found_in(name) if text not in ALLOWED.get(name, ())]
    assert not found, f"facts belong into fields, enums and classes of errors, not into texts: {found}"


def test_every_exception_is_still_needed():
    for name, texts in ALLOWED.items():
        assert texts <= {text for _, text in found_in(name)}, name


@pytest.mark.parametrize(
    "line",
    [
        'if "in steps only" in note: pass',
        'if how.startswith("differences"): pass',
        "if how.startswith(WAYS_OF_A_TEST): pass",
        'if "stands for several" in str(error): pass',
        'if f" {name} " in f" {error.message} ": pass',
        'if str(error).endswith("conjugate"): pass',
        'if hint.startswith("Known"): pass',
        'if problem.message == "interrupted": pass',
        'if re.search("no start value", text): pass',
        'if "winding" in number.confirmed_by: pass',
        'if point.how == "run": pass',
        'pin.endswith(" control")',
        'key.endswith("_friction")',
    ],
)
def test_the_rule_sees_what_it_is_about(line, monkeypatch):
    monkeypatch.setitem(constants(), "WAYS_OF_A_TEST", ast.parse('("differences", "identified")', mode="eval").body)
    assert list(prose_read(ast.walk(ast.parse(line))))


@pytest.mark.parametrize(
    "line",
    [
        'if "plant" in options: pass',
        'if name.startswith("_") or path.startswith("sources/"): pass',
        'if kind == "input": pass',
        'name.partition(".")',
        '" · ".join(texts)',
        'raise Error("found a word, expected " + "none") if x in ("a", "b") else None',
    ],
)
def test_the_rule_leaves_names_alone(line):
    assert not list(prose_read(ast.walk(ast.parse(line))))


# --- names in texts ----------------------------------------------------------------------------------------------------

_NAMED = re.compile(r"\bloopwright((?:\.[A-Za-z_]\w*)+)")
_FILES = {"json", "pickle", "toml", "html", "fmu", "svg", "md", "py", "pdf", "git"}


def exists(dotted):
    """Whether a name below the package is there: a module, or a name of one and its attributes."""
    parts, found = dotted.split("."), importlib.import_module("loopwright")
    for i, part in enumerate(parts):
        if not hasattr(found, part):
            try:
                importlib.import_module(".".join(["loopwright", *parts[: i + 1]]))
            except ImportError:
                return False
        found = getattr(found, part)
    return True


def test_every_name_of_ours_in_a_text_exists():
    """Error texts, hints, docstrings and pages name functions that a reader can call."""
    named = {}
    for path in [*SOURCES, *(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]:
        text = path.read_text(encoding="utf-8")
        for found in _NAMED.finditer(text):
            name = found.group(1)[1:]
            if name.split(".")[0] not in _FILES:
                named.setdefault(name, f"{path.relative_to(ROOT)}:{text[: found.start()].count(chr(10)) + 1}")
    assert len(named) > 20
    assert {where: name for name, where in named.items() if not exists(name)} == {}


def unstable_sorts(nodes):
    """Yield the lines that ask for an order of sorting in which equal values stand as the processor leaves them."""
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "argsort":
            kinds = [k.value.value for k in node.keywords if k.arg == "kind" and isinstance(k.value, ast.Constant)]
            if kinds != ["stable"]:
                yield node.lineno


def test_no_order_of_equal_values_hangs_on_the_processor():
    found = [
        (path.relative_to(ROOT).as_posix(), line)
        for path in SOURCES
        for line in unstable_sorts(find_nodes(path, ast.Call))
    ]
    assert not found, (
        f"NumPy sorts by the processor's vectors; give argsort kind='stable', or lexsort a second key: {found}"
    )
    seen = ast.walk(ast.parse("np.argsort(x)\nx.argsort(kind='quicksort')\nnp.argsort(x, kind='stable')"))
    assert [*unstable_sorts(seen)] == [1, 2]


def test_no_file_has_the_name_of_what_its_package_hands_out_of_it():
    """Names are loaded when they are used: once somebody has imported such a file, the package would have that."""
    hidden = [
        (stub.relative_to(ROOT).as_posix(), node.module)
        for room in ROOMS
        for stub in (ROOT / room).rglob("__init__.pyi")
        for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module in {name.name for name in node.names}
    ]
    assert not hidden


def test_a_name_of_a_class_means_one_thing():
    found = {}
    for source in SOURCES:
        for node in find_nodes(source, ast.ClassDef):
            found.setdefault(node.name, []).append(str(source.relative_to(ROOT)))
    assert not {name: files for name, files in found.items() if len(files) > 1}


def test_tests_share_nothing_but_what_stands_in_support():
    """Older pytests know no package `tests`, and no neighbours of a test's file."""
    suspect = re.compile(r"\bfrom\s+(?:\.|tests\b)")  # few files are worth parsing
    wrong = [
        (path.relative_to(ROOT).as_posix(), node.lineno)
        for path in (ROOT / "tests").rglob("test_*.py")
        if suspect.search(text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").split(".")[0] == "tests")
    ]
    assert not wrong


def test_the_formatter_lays_out_every_line():
    exempt = re.compile(r"# *fmt: *(?:skip|off)")
    folders = ("benchmarks", "blocks", "diagrams", "docs", "fmus", "front", "install", "tests")
    files = (file for folder in folders for file in (ROOT / folder).rglob("*.py"))
    assert [file for file in files if exempt.search(file.read_text(encoding="utf-8"))] == []
