"""Three loops of a user, whose design reports are reviewed: a drive cascade, a crane with an observer, a tank.

And the numbers of a report, reviewed again.
"""

import control
import numpy as np

from loopwright.blocks import PID, Constant, DiscreteStateSpace, Function, Gain, Integrator, Saturation, StateSpace
from loopwright.diagrams import Diagram, Requirements, subsystem
from loopwright.diagrams.report.case import Case
from loopwright.diagrams.report.case_verdicts import review

# --- a drive: speed control around current control ----------------------------------------------------------------------

R, L, K, J, B = 0.5, 2e-3, 0.1, 1e-3, 1e-4
DRIVE_T = 2e-4
CURRENT, SPEED = (2.0, 500.0), (0.4, 8.0)
"""Proportional and integral gains of both loops."""


def drive(*, gain=1.0, delay=0, inertia=1.0):
    """A motor with a PI current loop at the wire "voltage" in a PI speed loop at the wire "current_wanted"."""
    j = J * inertia
    motor = StateSpace(A=[[-R / L, -K / L], [K / j, -B / j]], B=[1 / L, 0.0], C=np.eye(2), name="motor")

    @subsystem(sample_time=DRIVE_T, delay=delay)
    def controller(y):
        wanted = PID(kp=gain * SPEED[0], ki=gain * SPEED[1], name="speed")(Constant(value=0.0, name="r"), y[1])
        return PID(kp=CURRENT[0], ki=CURRENT[1], name="current")(wanted.named("current_wanted"), y[0]).named("voltage")

    return Diagram("drive", motor(controller(motor.y)))


# --- a crane: state feedback on an observer's estimate -------------------------------------------------------------------

CRANE_T = 0.02
CART, LOAD, ROPE, G = 500.0, 300.0, 6.0, 9.81


def crane_model(rope=1.0):
    """Cart position and speed, rope angle and its rate; the cart's force in kN pushes."""
    length = ROPE * rope
    A = np.array(
        [[0, 1, 0, 0], [0, 0, LOAD * G / CART, 0], [0, 0, 0, 1], [0, 0, -(CART + LOAD) * G / (CART * length), 0]]
    )
    B = 1e3 * np.array([[0], [1 / CART], [0], [-1 / (CART * length)]])
    return A, B, np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])


def crane(*, gain=1.0, delay=0, rope=1.0):
    """A crane with an observer of its nominal model, cut at the wire "force"."""
    A, B, C = crane_model()
    nominal = control.c2d(control.ss(A, B, C, 0), CRANE_T)
    K, _, _ = control.dlqr(nominal.A, nominal.B, np.diag([1.0, 1, 20, 5]), [[0.3]])
    estimate, _, _ = control.dlqr(nominal.A.T, nominal.C.T, np.diag([1e-2, 1.0, 1e-2, 1.0]), 1e-3 * np.eye(2))
    M, plant = estimate.T, crane_model(rope)
    law = DiscreteStateSpace(
        A=nominal.A - nominal.B @ K - M @ nominal.C,
        B=M,
        C=-K[0] * gain,
        dt=CRANE_T,
        name="observer",
    )
    body = StateSpace(A=plant[0], B=plant[1][:, 0], C=plant[2], name="crane")

    @subsystem(sample_time=CRANE_T, delay=delay)
    def controller(y):
        return law(y).named("force")

    return Diagram("crane", body(controller(body.y)))


# --- a tank: PI control of its level with anti-windup --------------------------------------------------------------------

TANK_T = 1.0
AREA, OUTLET, LEVEL, MOST = 2.0, 0.5, 1.0, 1.2
TANK = (1.0, 0.05)
"""Gains of the PI controller."""


def tank(*, gain=1.0, delay=0, area=1.0, most=MOST):
    """A tank at rest at its level: A h' = q − c √h, the inflow q between 0 and a limit; cut at the wire "q"."""
    rest = OUTLET * np.sqrt(LEVEL)
    level = Integrator(initial_value=LEVEL, name="level")
    out = Function(lambda h: OUTLET * np.sqrt(h), name="outlet")

    @subsystem(sample_time=TANK_T, delay=delay)
    def controller(h):
        pid = PID(kp=gain * TANK[0], ki=gain * TANK[1], lower=-rest, upper=most - rest, name="pid")
        return (pid(Constant(value=LEVEL, name="wanted"), h) + rest).named("q")

    inflow = Saturation(lower=0.0, upper=most, name="valve")(controller(level.y))
    return Diagram("tank", level(Gain(gain=1 / (AREA * area), name="area")(inflow - out(level.y))))


# --- verdicts on the numbers of a report -----------------------------------------------------------------------------------


def judge_again(diagram, report, **limits):
    """Return the review of a report's numbers by other limits: to analyse the diagram for each takes seconds."""
    case, asked = Case(diagram.wired), Requirements(**limits)
    case.requirements = asked
    return review(case, asked, report.numbers(), absent=report.absent())
