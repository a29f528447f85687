"""Models to export, and their solutions in closed form."""

from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.linalg import expm

from loopwright.fmus import ModelSpec, Variable
from loopwright.fmus.export.model_spec import EventSpec

M, D, K = 2.0, 0.5, 10.0


def mass_spring_damper(**changes):
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 3)
    acceleration = (u - p[1] * x[1] - p[2] * x[0]) / p[0]
    given = {
        "name": "mass_spring_damper",
        "description": "A mass on a spring & a damper, x < 1",
        "inputs": (Variable("force", "input", unit="N", description='Force "from outside"'),),
        "outputs": (Variable("acceleration", "output", unit="m/s2"),),
        "parameters": (
            Variable("mass", "parameter", "fixed", unit="kg", start=M, minimum=1e-6),
            Variable("damping", "parameter", "tunable", unit="N.s/m", start=D),
            Variable("stiffness", "parameter", "fixed", unit="N/m", start=K),
        ),
        "states": (
            Variable("position", "output", unit="m", start=0.1, state=True),
            Variable("velocity", "local", unit="m/s", start=0.0, state=True),
        ),
        "derivative": ca.Function("f", [t, x, u, p], [ca.vertcat(x[1], acceleration)]),
        "output": ca.Function("g", [t, x, u, p], [acceleration]),
    }
    return ModelSpec(**(given | changes))


def pendulums():
    """Array states, an MX model with a structural zero, time in it; two pendulums, one frozen clock."""
    t, x, u, p = ca.MX.sym("t"), ca.MX.sym("x", 5), ca.MX.sym("u", 2), ca.MX.sym("p", 4)
    angle, rate = x[:2], x[2:4]
    torque = ca.reshape(p, 2, 2).T @ u  # p is a 2 x 2 matrix, row by row
    acceleration = torque - 9.81 * ca.sin(angle) - 0.1 * rate + 0.5 * ca.sin(3 * t)
    derivative = ca.Function("f", [t, x, u, p], [ca.vertcat(rate, acceleration, ca.MX(1, 1))])
    output = ca.Function("g", [t, x, u, p], [ca.vertcat(ca.sin(angle), ca.if_else(u[0] > 0, 1.0, 0.0))])
    return ModelSpec(
        name="pendulums",
        description="",
        inputs=(Variable("torque", "input", shape=(2,)),),
        outputs=(Variable("deflection", "output", shape=(2,)), Variable("positive", "output")),
        parameters=(Variable("gain", "parameter", "tunable", (2, 2), start=[[1.0, 2.0], [3.0, 4.0]]),),
        states=(
            Variable("angle", "output", shape=(2,), start=[0.3, -0.2], state=True),
            Variable("rate", shape=(2,), start=0.0, state=True),
            Variable("clock", start=7.0, state=True),
        ),
        derivative=derivative,
        output=output,
        internal_step=1e-2,
    )


def explosive():
    """x' = x^2 has no solution after t = 1 / x(0); the output is no number at x = 2 or after t = 0.8."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("u", 0), ca.SX.sym("p", 0)
    f = ca.Function("f", [t, x, u, p], [ca.vertcat(1.0, x[1] ** 2)])
    g = ca.Function("g", [t, x, u, p], [1 / (2 - x[1]) + ca.sqrt(0.8 - x[0])])
    states = (Variable("calm", start=0.0, state=True), Variable("x", start=1.0, state=True))
    return ModelSpec("explosive", "", (), (Variable("y", "output"),), (), states, f, g, internal_step=1e-3)


def make_model(name, states, parameters, inputs, f, g=None, outputs=(), *, z=None, jump=None, **more):
    """A model from functions of (t, x, u, p) and (t, x, u, p, fired) on SX columns."""
    sizes = [sum(v.size for v in group) for group in (states, inputs, parameters)]
    t, *rest = ca.SX.sym("t"), *(ca.SX.sym(c, n) for c, n in zip("xup", sizes, strict=True))
    args = (t, *rest)
    made = {"derivative": ca.Function("f", args, [ca.vertcat(*f(*args))])}
    made["output"] = ca.Function("g", args, [ca.vertcat(*(g(*args) if g else ()))])
    if z is not None:
        fired = ca.SX.sym("fired", len(more["events"]))
        made["indicators"] = ca.Function("z", args, [ca.vertcat(*z(*args))])
        made["jump"] = ca.Function("j", (*args, fired), [ca.vertcat(*jump(*args, fired))])
    return ModelSpec(name, "", inputs, outputs, parameters, states, **(made | more))


def bouncing_ball(**changes):
    """A ball under gravity g that leaves the floor with the fraction e of its speed."""
    given = {
        "z": lambda t, x, u, p: [x[0]],
        "jump": lambda t, x, u, p, fired: [x[0], ca.if_else(fired[0], -p[1] * x[1], x[1])],
        "events": (EventSpec("bounce", "falling", "Height above the floor"),),
        "f": lambda t, x, u, p: [x[1], -p[0]],
    }
    return make_model(
        "bouncing_ball",
        (
            Variable("height", "output", unit="m", start=1.0, state=True),
            Variable("velocity", "output", unit="m/s", start=0.0, state=True),
        ),
        (
            Variable("g", "parameter", "tunable", unit="m/s2", start=9.81),
            Variable("e", "parameter", "tunable", unit="1", start=0.7),
        ),
        (),
        **(given | changes),
    )


def thermostat(**changes):
    """T' = -a (T - ambient) + heating * on, switched off above 21 and on below 19 degrees: a hysteresis."""

    def jump(t, x, u, p, fired):
        return [x[0], ca.if_else(fired[0], 0.0, ca.if_else(fired[1], 1.0, x[1]))]

    given = {"events": (EventSpec("too_warm", "rising"), EventSpec("too_cold", "falling", nominal=0.5))}
    return make_model(
        "thermostat",
        (
            Variable("temperature", "output", start=20.0, state=True, nominal=20.0),
            Variable("on", "output", "discrete", start=1.0, state=True),
        ),
        (Variable("a", "parameter", "fixed", start=0.1), Variable("heating", "parameter", "tunable", start=3.0)),
        (Variable("ambient", "input", start=5.0), Variable("set_point", "input", "discrete", start=20.0)),
        lambda t, x, u, p: [-p[0] * (x[0] - u[0]) + p[1] * x[1]],
        lambda t, x, u, p: [p[1] * x[1] + u[0]],
        (Variable("power", "output"),),
        z=lambda t, x, u, p: [x[0] - u[1] - 1.0, x[0] - u[1] + 1.0],
        jump=jump,
        **(given | changes),
    )


def van_der_pol(**changes):
    """x'' = mu (1 - x^2) x' - x: stiff for a large mu."""
    return make_model(
        "van_der_pol",
        (Variable("x", "output", start=2.0, state=True), Variable("v", "output", start=0.0, state=True)),
        (Variable("mu", "parameter", "tunable", start=1000.0),),
        (),
        lambda t, x, u, p: [x[1], p[0] * (1 - x[0] ** 2) * x[1] - x[0]],
        **({"integrator": "rodas"} | changes),
    )


def driven(**changes):
    """Nonlinear, with time and an input in it: x' = -x y + sin(3 t) + u, y' = x - y^3 - y cos(t) / 2."""
    return make_model(
        "driven",
        (Variable("x", "output", start=1.0, state=True), Variable("y", "output", start=0.5, state=True)),
        (),
        (Variable("u", "input"),),
        lambda t, x, u, p: [-x[0] * x[1] + ca.sin(3 * t) + u, x[0] - x[1] ** 3 - 0.5 * x[1] * ca.cos(t)],
        **changes,
    )


def exact(t, x0, force=0.0):
    """State of the mass-spring-damper under a constant force: matrix exponential."""
    A = np.array([[0, 1, 0], [-K / M, -D / M, force / M], [0, 0, 0]])
    return (expm(A * t) @ np.array([*x0, 1.0]))[:2]


def relay(**changes):
    """x' = 1 or -1, switched when x leaves [-width, width]; with width = 0 it chatters."""
    return make_model(
        "relay",
        (
            Variable("x", "output", start=0.5, state=True),
            Variable("sign", "output", "discrete", start=-1.0, state=True),
        ),
        (Variable("width", "parameter", "tunable", start=0.1),),
        (),
        lambda t, x, u, p: [x[1]],
        z=lambda t, x, u, p: [x[0] - p[0], x[0] + p[0]],
        jump=lambda t, x, u, p, fired: [x[0], ca.if_else(fired[0], -1.0, ca.if_else(fired[1], 1.0, x[1]))],
        **({"events": (EventSpec("above", "rising"), EventSpec("below", "falling"))} | changes),
    )


def counter(jump, z=None, **changes):
    """x' = 0, n counts: an event at x + u = 1."""
    return make_model(
        "counter",
        (Variable("x", "output", start=0.0, state=True), Variable("n", "output", "discrete", start=0.0, state=True)),
        (),
        (Variable("u", "input"), Variable("v", "input", "discrete")),
        lambda t, x, u, p: [0.0],
        lambda t, x, u, p: [x[0] + u[0]],
        (Variable("y", "output"),),
        z=z or (lambda t, x, u, p: [x[0] + u[0] - 1.0]),
        jump=jump,
        **({"events": (EventSpec("reached"),)} | changes),
    )


G, E = 9.81, 0.7


def bounces(n, e=E):
    """Times of the first bounces from 1 m, and the speeds after them."""
    t, v, found = np.sqrt(2.0 / G), np.sqrt(2.0 * G), []
    for _ in range(n):
        v *= e
        found.append((t, v))
        t += 2.0 * v / G
    return found


def ball(t, e=E):
    """Height and velocity of the ball."""
    past = [(tk, v) for tk, v in bounces(30, e) if tk <= t]
    if not past:
        return 1.0 - G * t**2 / 2.0, -G * t
    tk, v = past[-1]
    return v * (t - tk) - G * (t - tk) ** 2 / 2.0, v - G * (t - tk)


def heating(t):
    """Temperature and switch of the thermostat at t, from 20 degrees."""
    warm, cold = np.log(15 / 14) / 0.1, np.log(16 / 14) / 0.1  # 20 to 21 on, 21 to 19 off
    again = np.log(16 / 14) / 0.1  # 19 to 21 on: 35 - 19 to 35 - 21
    if t < warm:
        return 35.0 - 15.0 * np.exp(-0.1 * t), 1.0
    s = (t - warm) % (cold + again)
    return (5.0 + 16.0 * np.exp(-0.1 * s), 0.0) if s < cold else (35.0 - 16.0 * np.exp(-0.1 * (s - cold)), 1.0)


def unbound(spec):
    """The same model, with nominal values so large that no tolerance cuts a step: a communication step is one step."""
    return replace(spec, states=tuple(replace(v, nominal=1e9) for v in spec.states), tolerance=0.1)


def echoing_ball():
    """A ball that bounces on the floor and counts it; ``flash`` fires at the same instant, and ``echo`` of the count."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 4), ca.SX.sym("u", 0), ca.SX.sym("p", 2)
    fired = ca.SX.sym("fired", 2)
    velocity = ca.if_else(fired[0], -p[1] * x[1], x[1])
    return ModelSpec(
        name="echoing_ball",
        description="A bouncing ball",
        inputs=(),
        outputs=(Variable("energy", "output", unit="J/kg"),),
        parameters=(
            Variable("gravity", "parameter", "fixed", unit="m/s2", start=G),
            Variable("restitution", "parameter", "tunable", unit="1", start=E, minimum=0.0, maximum=1.0),
        ),
        states=(
            Variable("height", "output", unit="m", start=1.0, state=True),
            Variable("velocity", "local", unit="m/s", start=0.0, state=True, nominal=4.0),
            Variable("bounces", "output", "discrete", unit="1", start=0.0, state=True),
            Variable("echoes", "local", "discrete", unit="1", start=0.0, state=True),
        ),
        derivative=ca.Function("f", [t, x, u, p], [ca.vertcat(x[1], -p[0])]),
        output=ca.Function("g", [t, x, u, p], [p[0] * x[0] + x[1] ** 2 / 2]),
        events=(
            EventSpec("bounce", "falling", "The floor"),
            EventSpec("echo", "rising", "After a bounce, at the same instant"),
        ),
        indicators=ca.Function("z", [t, x, u, p], [ca.vertcat(x[0], x[2] - x[3] - 0.5)]),
        jump=ca.Function("j", [t, x, u, p, fired], [ca.vertcat(x[0], velocity, x[2] + fired[0], x[3] + fired[1])]),
        internal_step=1e-2,
    )


def flight(t, e=E):
    """Height, velocity and bounces of the echoing ball until t: parabolas, each with the fraction e of the speed."""
    begin, up, n = -np.sqrt(2 / G), np.sqrt(2 * G), 0
    while t > begin + 2 * up / G:
        begin, up, n = begin + 2 * up / G, e * up, n + 1
    return up * (t - begin) - G * (t - begin) ** 2 / 2, up - G * (t - begin), n


def stiff():
    """x' = -rate (x - cos t) - sin t, whose solution from x(0) = 1 is cos t."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u", 0), ca.SX.sym("p")
    f = ca.Function("f", [t, x, u, p], [-p * (x - ca.cos(t)) - ca.sin(t)])
    g = ca.Function("g", [t, x, u, p], [x - ca.cos(t)])
    rate = (Variable("rate", "parameter", start=1e6, variability="fixed"),)
    state = (Variable("x", start=1.0, state=True),)
    return ModelSpec("stiff", "", (), (Variable("error", "output"),), rate, state, f, g, integrator="rodas")
