"""Parts of a report: each applies or doesn't, parts of one key are one section, and a diagram may bring its own."""

import ast
import pickle
from pathlib import Path

import pytest

import loopwright.diagrams.report
from loopwright.blocks import Integrator, OptionError
from loopwright.diagrams import Diagram, Fig3Diagram, Section, analyse, experiments
from loopwright.diagrams.paper.fig3_report import FIG3
from loopwright.diagrams.report.analysis import ANY_DIAGRAM, SUBJECT
from loopwright.diagrams.report.case import Case
from loopwright.diagrams.report.report_parts import ReportKind, ReportPart

ROOM = Path(loopwright.diagrams.report.__file__).parent


def loop(kind=Diagram):
    plant = Integrator(name="plant")
    return kind("loop", plant((-2.0 * plant.y).named("u")))


def part(key, text, applies=True, made=None):
    def make(case):
        if made is not None:
            made.append((key, text))
        return Section(key, key.title(), (text,)) if text else None

    return ReportPart(key, make, lambda case: applies)


class OwnCase(Case):
    """Another way to look at a diagram: at one wire, whatever has names."""

    def loop_wires(self):
        return {"mine": "u"}


class OwnDiagram(Diagram):
    """A diagram that brings a report of its own."""

    @property
    def report_kind(self):
        return ReportKind(OwnCase, (*ANY_DIAGRAM.parts, part("more", "More.")), {"more": "mine"})


def test_parts_that_apply_make_sections_and_those_of_one_key_make_one():
    made, told = [], []
    kind = ReportKind(
        Case,
        (
            part("a", "1", made=made),
            part("b", "2", made=made),
            part("a", "3", made=made),
            part("b", "left out", applies=False, made=made),
            part("c", "left out", applies=False, made=made),
            part("d", "", made=made),
        ),
    )
    case, sections = kind.sections(loop().wired, None, None, None, None, told.append)
    assert [(s.key, s.title, s.text) for s in sections] == [("a", "A", ("1", "3")), ("b", "B", ("2",))]
    assert told == ["variants", "a", "b", "d"]
    assert made == [("a", "1"), ("a", "3"), ("b", "2"), ("d", "")]
    assert case.keys == ("a", "b", "c", "d")
    case, sections = kind.sections(loop().wired, None, None, None, ("b",), told.append)
    assert [s.key for s in sections] == ["b"]
    assert case.keys == ("b",)
    with pytest.raises(OptionError, match="no section 'e'; expected some of a, b, c, d"):
        kind.check_keys(["e"])
    with pytest.raises(OptionError, match=r"found 'b'; expected a list of sections\. Write only=\['b'\]"):
        kind.check_keys("b")


def test_a_diagram_brings_a_report_of_its_own():
    found = analyse(loop(OwnDiagram), only=("inner", "more"))
    assert [s.key for s in found.sections] == ["inner", "more"]
    assert found.meta["definitions"] == {"more": "mine"}
    assert found.numbers()["inner.mine.continuous.phase_margin_deg"].value == pytest.approx(90.0, abs=1e-9)
    with pytest.raises(OptionError, match="no section 'more'"):
        analyse(loop(), only=("more",))


def test_the_first_section_is_of_any_diagram():
    (section,) = analyse(loop(), only=(SUBJECT.key,)).sections
    assert section.title == "What was analysed"


# --- Fig. 3 brings its own ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "variant",
    [
        lambda d: d,
        lambda d: d.replace({"controller.pid_par.a0": 1.0}),
        lambda d: d.continuous(),
        lambda d: d.sampled(1e-3),
        lambda d: pickle.loads(pickle.dumps(d)),
    ],
    ids=["itself", "replaced", "continuous", "sampled", "pickled"],
)
def test_every_variant_of_fig_3_keeps_its_report(variant):
    assert variant(experiments.compliance().diagram).report_kind is FIG3


def test_fig_3_without_its_parts_gets_the_report_of_any_diagram():
    small = loop(Fig3Diagram)
    assert small.report_kind is ANY_DIAGRAM
    assert [s.key for s in analyse(small, only=("inner",)).sections] == ["inner"]


@pytest.mark.slow
def test_fig_3_that_is_wired_by_hand_brings_the_papers_parts_as_a_diagram_of_fig_3():
    made = experiments.compliance().diagram
    by_hand = Diagram._of("by hand", made.structure)
    with pytest.raises(OptionError, match="no section 'admittance'"):
        analyse(by_hand, only=("admittance",))
    said = Fig3Diagram._of("by hand", made.structure)
    assert analyse(said, only=("operating_points",)).numbers() == analyse(made, only=("operating_points",)).numbers()


def test_no_general_file_knows_a_block_of_fig_3():
    names = ("controller", "eta_d", "xi_d", "pid_par", "coulomb", "friction", "plant.", "motor_force")
    for file in sorted(ROOM.glob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        documentation = {
            id(node.body[0].value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and isinstance(node.body[0], ast.Expr)
        }
        texts = [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
        for text in texts:
            if id(text) not in documentation:
                assert not any(name in text.value for name in names), f"{file.name}: {text.value!r}"
    for file in sorted(ROOM.glob("templates/*.txt.j2")):
        assert "Fig. 3" not in file.read_text(encoding="utf-8"), file
