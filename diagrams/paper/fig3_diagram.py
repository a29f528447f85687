"""The paper's Fig. 3 as a diagram."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from ...blocks import Path, PlanarModel
from ...blocks.core import explain_calls
from ...fmus import Fmu
from ...fmus.models import gantry
from ..diagram import Diagram
from .fig3_wires import IDEAL, Channel, Rig, wire

if TYPE_CHECKING:
    from ..report import ReportKind


class Fig3Diagram(Diagram):
    """A diagram of Fig. 3: a `Diagram` whose report has the paper's parts.

    `fig3` makes one. Fig. 3 wired by hand, with the names of its blocks, is one as well when it is made as
    ``Fig3Diagram("mine", plant(…))`` in place of ``Diagram("mine", plant(…))``.
    """

    contact_port: ClassVar[str | None] = "plant.external_force"

    @property
    def report_kind(self) -> ReportKind[Any]:
        """The report of Fig. 3, as long as the error dynamics and the feedback linearization are in the diagram."""
        from ..report import ANY_DIAGRAM  # a run has no need of the report
        from .fig3_case import has_parts
        from .fig3_report import FIG3

        return FIG3 if has_parts(self.wired) else ANY_DIAGRAM


@explain_calls
def fig3(
    plant: Fmu,
    path: Path,
    par: Channel,
    perp: Channel,
    *,
    environment: Callable[[Any], Any] | None = None,
    model: PlanarModel = gantry.nominal,
    rig: Rig = IDEAL,
    name: str = "fig3",
) -> Diagram:
    """Wire the diagram of the paper's Fig. 3.

    Parameters
    ----------
    plant : Fmu
        Plant with the ports of the gantry: in ``motor_force``, ``external_force``; out ``position``, ``velocity``,
        ``acceleration`` and, where it has one, ``contact_force``. Others get these names by ``Fmu(…, rename={…})``.
    path : Path
        The path to follow.
    par, perp : Channel
        Reference and admittance of the tangential and the transversal direction.
    environment : callable, optional
        Given the plant's position, returns the external force on the robot in N: ``HandForce(path, …)``,
        ``PathSpring(path, …)``, or any call of the user's.
    model : PlanarModel
        The model that the feedback linearization inverts.
    rig : Rig
        Sensor, actuator and sampling effects.

    Returns
    -------
    Diagram
        With the wires ``eta``, ``xi``, ``theta``, ``q``, ``position``, ``velocity``, ``force``, ``motor_force``,
        ``v_par``, ``v_perp``, ``eta_p`` and ``xi_p``.

    Raises
    ------
    UnknownNameError, ShapeError
        If the plant has other ports.
    """
    return Fig3Diagram(name, wire(plant, path, par, perp, environment=environment, model=model, rig=rig))
