"""Kinks and stairs of a diagram, carried by the reduced loop to its numbers."""

import numpy as np
import pytest

from loopwright.blocks import AdmittanceFilter, Ellipse, Reference
from loopwright.diagrams import AdmittanceLoop, Channel, fig3, passivity, stability_limit, stability_map
from loopwright.fmus import Fmu, gantry
from loopwright.types import Kink, StepsOnly

PATH = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
SMOOTH = {"coulomb_scale": 0.0, "viscous_scale": 0.0}


def robot(**limits):
    plant = Fmu(gantry.build(), name="plant", start={"position": PATH.to_plane(0.0, 0.0), **SMOOTH})
    par = Channel(Reference(0.0, name="eta_d"), AdmittanceFilter(mass=0.5, damping_ratio=0.6, stiffness=10.0))
    perp = Channel(
        Reference(0.0, name="xi_d"), AdmittanceFilter(mass=2.0, damping_ratio=0.3, stiffness=200.0, **limits)
    )
    return fig3(plant, PATH, par, perp, model=gantry.nominal.replace(**SMOOTH))


@pytest.mark.slow
def test_a_limit_that_1_newton_reaches_is_carried_and_one_beyond_is_not():
    """1 N on 2 kg is 0.5 m/s²: the nominal range of a force of zero reaches an acceleration limit below that."""
    assert AdmittanceLoop.of(robot()).findings == ()
    assert AdmittanceLoop.of(robot(acceleration_limit=0.6)).findings == ()
    loop = AdmittanceLoop.of(robot(acceleration_limit=0.4))
    assert StepsOnly("controller.admittance_perp", "limited", "force") in loop.findings
    limit = stability_limit(loop)
    assert limit.findings == limit.number.findings == loop.findings
    assert str(limit.number).endswith(" N/m †")
    assert limit.value == stability_limit(AdmittanceLoop.of(robot())).value


def test_every_result_of_a_loop_carries_its_findings():
    kink = Kink("plant", "velocity", "motor_force", 0.0, 1.0)
    loop = AdmittanceLoop.of(robot(), "perp").replace(findings=(kink,))
    assert passivity(loop).findings == (kink,)
    assert loop.contact.findings == loop.contact.admittance(1.0).findings == (kink,)
    assert stability_limit(loop, "mass", high=1e3).number.findings == (kink,)
    (limit,) = stability_map(loop, np.geomspace(1e2, 1e5, 5), [0.0]).limits
    assert limit.findings == (kink,)
