"""Requirements on contacts: verdicts against Routh's criterion, on page one, in the JSON, from TOML, and by exit status."""

import json

import pytest

from loopwright.blocks import OptionError
from loopwright.blocks.core.errors import UnknownNameError
from loopwright.diagrams import Requirements, analyse
from loopwright.diagrams.cli import main
from loopwright.diagrams.contact import confirmed_limits
from loopwright.diagrams.requirements import ContactLimits, Reason, Verdict
from loopwright.diagrams.studies import ContactTask
from support.carts import DRAG, SHARE, TAU, M, cart_diagram

pytestmark = pytest.mark.usefixtures("without_drawings")

PORTS = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt", "direction": [1.0]}
SOFT = DRAG / (TAU * SHARE)
B = 10.0
DAMPED = (M + B * TAU) * (B * (1 + SHARE) + DRAG) / (M * TAU * (1 + SHARE) - (M + B * TAU) * TAU)
"""Limits of stiffness by Routh's criterion, without and with a damper of 10 N s/m, in N/m."""

TABLE = """
[contact.hand]
port = "cart.push"
position = "cart.position"
velocity = "cart.velocity"
force = "felt"
direction = [1.0]
"""


@pytest.fixture
def untried(monkeypatch):
    """Runs beside limits are left out: they have tests of their own."""
    from loopwright.diagrams.report.sections import contacts

    def refuse(contact, limit):
        raise OptionError("it is left out here")

    monkeypatch.setattr(contacts, "try_limit", refuse)


def review(contact, contacts=None, **asked):
    made = cart_diagram()
    contacts = {"hand": made.contact("cart.push", **PORTS)} if contacts is None else contacts
    return analyse(made, only=(), contacts=contacts, requirements=Requirements(contact=contact, **asked))


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    ("limit", "verdict", "distance"),
    [
        ({"stiffness": 0.9 * SOFT}, "passed", 0.1 * SOFT),
        ({"stiffness": 1.1 * SOFT}, "failed", -0.1 * SOFT),
        ({"hand": {"stiffness": 1.1 * SOFT}}, "failed", -0.1 * SOFT),
        ({"stiffness": 0.9 * DAMPED, "with": {"damping": B}}, "passed", 0.1 * DAMPED),
        ({"stiffness": 2 * SOFT, "hand": {"stiffness": 0.5 * SOFT}}, "passed", 0.5 * SOFT),
        ({"stiffness": (0.2 * SOFT, 0.5 * SOFT)}, "failed", -0.5 * SOFT),
        ({"mass": 20.0}, "passed", float("inf")),
    ],
)
def test_a_limit_of_a_contact_passes_or_fails_by_its_distance(untried, limit, verdict, distance):
    report = review(limit)
    (result,) = (r for r in report.review.results if r.quantity.startswith("contact."))
    assert (result.verdict.value, result.reason) == (verdict, Reason.COMPARED)
    assert result.distance == pytest.approx(distance, rel=1e-6)
    assert report.numbers()[result.path] == result.number
    shown = report.sections[0].tables[0].rows
    assert sum(str(row[0]).startswith(verdict) and "environment" in str(row[1]) for row in shown) == 1
    (table,) = (t for t in report.sections[0].tables if t.title.startswith("Contacts"))
    assert (table.rows[0][0], table.rows[0][1].value) == ("hand", pytest.approx(SOFT, rel=1e-9))


def test_limits_without_contacts_are_not_decided_and_those_of_others_refused():
    report = review({"stiffness": 1.0}, contacts={})
    (result,) = (r for r in report.review.results if r.quantity == "contact.stiffness")
    assert (result.verdict, result.reason) == (Verdict.UNDECIDED, Reason.NO_NUMBER)
    assert report.review.verdict is Verdict.UNDECIDED
    with pytest.raises(UnknownNameError, match=r"requirements on a contact 'hnd'; .*Did you mean 'hand'"):
        review({"hnd": {"stiffness": 1.0}})


@pytest.mark.slow
def test_a_limit_that_a_run_contradicts_is_not_decided(monkeypatch):
    monkeypatch.setattr(confirmed_limits, "measure_growth", lambda *given: 3.0)
    (result,) = (r for r in review({"stiffness": 0.5 * SOFT}).review.results if r.quantity == "contact.stiffness")
    assert (result.verdict, result.reason) == (Verdict.UNDECIDED, Reason.REFUTED)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"stifness": 3.0}, "contact.stifness: a contact has no limit of 'stifness'. Did you mean 'stiffness'"),
        ({"hand": {"spring": 3.0}}, "contact.hand.spring: a contact has no limit of 'spring'"),
        (3.0, "contact: found 3.0; expected limits, such as"),
        ({"stiffness": "a"}, "contact.stiffness: found 'a'; expected a number"),
        ({"with": {"damping": 1.0}}, "contact: found no limit; expected some of stiffness, damping"),
        ({"stiffness": 1.0, "with": {"damping": -1.0}}, "contact.with.damping: found -1.0; expected a finite number"),
        ({"stiffness": 1.0, "with": {"stiffness": 1.0}}, "contact.with.stiffness: found it limited and held"),
        ({"stiffness": 1.0, "with": 3}, "contact.with: found 3; expected properties"),
        (
            {"stiffness": 1.0, "with": {"dampng": 1}},
            "contact.with: an environment has no 'dampng'. Did you mean 'damping'",
        ),
    ],
)
def test_limits_that_are_none_are_refused(given, words):
    with pytest.raises(OptionError, match=f"^{words}"):
        Requirements(contact=given)
    with pytest.raises(OptionError):
        ContactLimits({})


def write(path, *texts):
    path.write_text("\n".join(texts), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[worst_case]\nloop = 'u'", r"c.toml: found no table \[contact.NAME\]"),
        (
            TABLE.replace("velocity", "velocty"),
            r"c.toml, line 5: contact.hand.velocty: \[contact.hand\] has no 'velocty'",
        ),
        (TABLE.replace("cart.push", "cart.psh"), r"c.toml, line 3: contact.hand.port: .*'cart.psh'|has no input 'psh'"),
        (TABLE.replace("[1.0]", "[0.0]"), r"c.toml, line 7: contact.hand.direction: .*expected a vector of 1"),
        (TABLE.replace("[1.0]", "'x'"), r"c.toml, line 7: contact.hand.direction: "),
        (TABLE.replace('"felt"', "3"), r"c.toml, line \d: contact.hand"),
        (TABLE + "[contact.hand.requirements]\nstifness = 3", r"c.toml, line 9: contact.hand.requirements.stifness: "),
        (
            TABLE + "[contact.requirements]\nstiffness = 'a'",
            r"c.toml, line 9: contact.requirements.stiffness: found 'a'",
        ),
        ("contact = 3", r"c.toml, line 1: contact: found 3; expected a table"),
        ("[contact]\nhand = 3", r"c.toml, line 2: contact.hand: found 3; expected a table"),
        (TABLE.replace("contact.hand", "contact.'a b'"), r"c.toml, line 2: contact.a b: found this name"),
    ],
)
def test_a_file_that_makes_no_contact_is_refused_with_its_line(tmp_path, text, words):
    with pytest.raises(OptionError, match=words):
        ContactTask.read(write(tmp_path / "c.toml", text)).find(cart_diagram().wired)


def test_a_file_of_contacts_has_the_numbers_of_the_diagrams_own(tmp_path):
    file = write(
        tmp_path / "c.toml",
        TABLE,
        "[contact.requirements]",
        "stiffness = 3.0",
        TABLE.replace("hand", "blind").replace('"felt"', "false"),
        "[contact.blind.requirements]",
        "stiffness = 4",
        "with = {damping = 2}",
    )
    task = ContactTask.read(file)
    found = task.find(cart_diagram().wired)
    assert found["hand"].stability_limit().value == pytest.approx(SOFT, rel=1e-9)
    assert found["blind"].measured is None
    assert {name: [str(v.limits["stiffness"]) for v in limits] for name, limits in task.limits.items()} == {
        "": ["≥ 3"],
        "blind": ["≥ 4"],
    }
    assert dict(task.limits["blind"][0].environment) == {"damping": 2.0}


PROGRAM = """
from support.carts import cart_diagram

diagram = cart_diagram()
"""


@pytest.mark.parametrize(("share", "verdict"), [pytest.param(0.9, "passed", marks=pytest.mark.slow), (1.1, "failed")])
def test_page_one_and_the_json_say_the_same(untried, tmp_path, share, verdict):
    file = write(tmp_path / "c.toml", TABLE, "[contact.hand.requirements]", f"stiffness = {share * SOFT}")
    out = tmp_path / "page.html"
    report = cart_diagram().report(out, json=True, only=("poles",), contacts=file)
    assert report.review.verdict.value == verdict
    assert json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))["requirements"]["verdict"] == verdict
    assert f"Verdict: {verdict}." in out.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(("share", "verdict", "status"), [(0.9, "passed", 0), (1.1, "failed", 3)])
@pytest.mark.parametrize("way", ["--contact", "--requirements"])
def test_page_one_the_json_and_the_exit_status_say_the_same(untried, tmp_path, capsys, share, verdict, status, way):
    write(tmp_path / "loop.py", PROGRAM)
    first = "stable = false" if way == "--requirements" else ""  # the cart drifts
    file = write(tmp_path / "c.toml", first, TABLE, "[contact.hand.requirements]", f"stiffness = {share * SOFT}")
    out = tmp_path / "page.html"
    made = main(["report", f"{tmp_path / 'loop.py'}:diagram", "--out", str(out), "--json", way, str(file), "--check"])
    assert made == status
    assert f"Requirements: {verdict}." in capsys.readouterr().out
    data = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    assert data["requirements"]["verdict"] == verdict
    assert [(r["quantity"], r["verdict"]) for r in data["requirements"]["results"]] == [("contact.stiffness", verdict)]
    page = out.read_text(encoding="utf-8")
    assert f"Verdict: {verdict}." in page
    assert "Contacts: weakest limits of stiffness" in page
