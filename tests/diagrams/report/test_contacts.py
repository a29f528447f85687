"""Contacts in a report: their numbers against Routh's criterion, their sections, and what is refused."""

import json
import math
import re

import numpy as np
import pytest

from loopwright.blocks import OptionError
from loopwright.diagrams import analyse
from support.carts import DRAG, SHARE, TAU, M, cart_diagram

PORTS = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt", "direction": [1.0]}


@pytest.mark.slow
def test_a_users_contact_gets_its_limits_their_trial_and_figures(tmp_path):
    made = cart_diagram()
    report = made.report(
        tmp_path / "cart.html", json=True, only=("poles",), contacts={"hand": made.contact("cart.push", **PORTS)}
    )
    numbers = report.numbers()
    k = DRAG / (TAU * SHARE)
    assert numbers["contact.hand.ke_limit.be_0"].value == pytest.approx(k, rel=1e-9)
    w = math.sqrt((k * TAU + DRAG) / (M * TAU))
    assert numbers["contact.hand.ke_limit_frequency.be_0"].value == pytest.approx(w, rel=1e-8)
    assert numbers["contact.hand.first_non_passive"].value == pytest.approx(w, rel=1e-8)
    b = 10.0  # (M + b τ)(b + k τ + DRAG + SHARE b) = M τ k (1 + SHARE)
    k10 = (M + b * TAU) * (b * (1 + SHARE) + DRAG) / (M * TAU * (1 + SHARE) - (M + b * TAU) * TAU)
    assert numbers["contact.hand.ke_limit.be_10"].value == pytest.approx(k10, rel=1e-9)
    assert numbers["contact.hand.me_limit.ke_10"].value == math.inf
    for where, factor in (("below", 0.97), ("above", 1.03)):
        tried = numbers[f"contact.hand.tried.ke_limit.be_10.{where}.growth_rate"]
        kx = factor * k10
        roots = np.roots([M * TAU, M + b * TAU, kx * TAU + DRAG + b * (1 + SHARE), kx * (1 + SHARE)])
        assert tried.value == pytest.approx(roots.real.max(), abs=tried.tolerance)
        assert "next to the plant, in the solver" in tried.confirmed_by
    (section,) = (s for s in report.sections if s.key == "contact")
    assert [plot.key for plot in section.sections[0].plots] == ["contact_admittance_hand", "contact_map_hand"]
    page = (tmp_path / "cart.html").read_text(encoding="utf-8")
    data = json.loads((tmp_path / "cart.json").read_text(encoding="utf-8"))
    assert data["contact"]["hand"]["ke_limit"]["be_0"]["value"] == pytest.approx(k, rel=1e-9)
    for term in {path.split(".")[2] for path in numbers if path.startswith("contact.hand.")} - {"tried"}:
        assert re.search(rf'id="[^"]*{term}[^"]*"', page), term  # it has a definition to link to


@pytest.mark.parametrize(
    ("contacts", "words"),
    [
        ({"hand": 3}, "found 3 for 'hand'; expected a contact. Give diagram.contact"),
        ({"the hand": "own"}, "found the name 'the hand'; expected letters, digits and underscores"),
        ({"hand": "other"}, "found a contact of another diagram under 'hand'; expected one of 'cart'"),
    ],
)
def test_what_is_no_contact_of_the_diagram_is_refused(contacts, words):
    made = cart_diagram()
    given = {"own": made, "other": cart_diagram(share=3.0)}
    contacts = {
        name: given[value].contact("cart.push", **PORTS) if value in given else value
        for name, value in contacts.items()
    }
    with pytest.raises(OptionError, match=re.escape(words)):
        analyse(made, only=(), contacts=contacts)
