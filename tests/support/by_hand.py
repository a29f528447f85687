"""Margins and step responses of sampled loops, computed with NumPy and SciPy alone: nothing of the package is used.

A controller is a function ``law(k, x, memory, wanted, wire)``. It gets the number of the tick, the plant's states, a
dictionary of its own states, which it changes, and the set-point, and it returns the plant's input. It passes every
signal whose loop is of interest through ``wire(name, value)``. It has to be linear where its margins are asked for.
"""

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

STEPS = 4
"""Runge-Kutta steps of a nonlinear plant in one tick."""


def discretize(A, B, T):
    """Return the matrices of a plant over a tick of length T, its input held: a matrix exponential."""
    A = np.asarray(A, float)
    n, B = len(A), np.asarray(B, float).reshape(len(A), -1)
    both = np.block([[A, B], [np.zeros((B.shape[1], n + B.shape[1]))]])
    over = expm(both * T)
    return over[:n, :n], over[:n, n:]


class SampledLoop:
    """A controller of one input around a linear plant, over a period of some ticks of length T.

    Parameters
    ----------
    A, B : arrays
        The plant in continuous time.
    law : callable
        The controller.
    memory : iterable of str
        Names of the controller's states.
    T : float
        Length of a tick in s.
    ticks : int
        Ticks in the period of all rates.
    """

    def __init__(self, A, B, law, memory, T, ticks=1):
        self.Ad, self.Bd = discretize(A, B, T)
        self.law, self.memory, self.T, self.ticks = law, tuple(memory), T, ticks

    def _period(self, wire, columns):
        n = len(self.Ad)
        start = np.eye(n + len(self.memory), columns, dtype=complex)
        x, memory = start[:n], {name: start[n + i] for i, name in enumerate(self.memory)}
        for k in range(self.ticks):
            u = self.law(k, x, memory, 0.0, wire)
            x = self.Ad @ x + self.Bd @ np.atleast_2d(u)
        return np.vstack([x, *(memory[name] for name in self.memory)])

    def radius(self, name="", factor=1.0):
        """Return the spectral radius over a period, with a factor on a wire."""
        size = len(self.Ad) + len(self.memory)
        period = self._period(lambda at, value: factor * value if at == name else value, size)
        return np.abs(np.linalg.eigvals(period)).max()

    def periodic_margins(self, name):
        """Return the limits of one factor on a wire that is renewed in every tick of its rate."""
        beyond = 1.0 + 1e-9

        def limit(factor_of, places):
            values = [self.radius(name, factor_of(place)) - beyond for place in places]
            for i in range(len(places) - 1):
                if values[i] < 0 <= values[i + 1]:
                    return brentq(lambda p: self.radius(name, factor_of(p)) - beyond, places[i], places[i + 1])
            return np.inf

        return {
            "phase_margin_deg": limit(lambda degrees: np.exp(1j * np.radians(degrees)), np.linspace(0.0, 180.0, 91)),
            "gain_margin_high": np.exp(limit(np.exp, np.linspace(0.0, np.log(1e3), 120))),
            "gain_margin_low": np.exp(-limit(lambda p: np.exp(-p), np.linspace(0.0, np.log(1e3), 120))),
        }

    def response(self, name):
        """Return L at a wire that is renewed once in the period, as a function of rad/s."""
        size = len(self.Ad) + len(self.memory)
        sent = []

        def wire(at, value):
            if at != name:
                return value
            sent.append(value)
            return np.eye(1, size + 1, size, dtype=complex)[0]

        period = self._period(wire, size + 1)
        (out,) = sent
        A, B, C, D = period[:, :-1], period[:, -1:], out[:-1], out[-1]

        def L(omega):
            z = np.exp(1j * np.atleast_1d(omega) * self.T * self.ticks)
            inner = np.linalg.solve(z[:, None, None] * np.eye(size) - A, np.broadcast_to(B, (len(z), size, 1)))
            return -(np.einsum("i,kij->k", C, inner) + D)

        return L

    def margins(self, name):
        """Return the numbers of the loop at a wire that is renewed once in the period."""
        top = np.pi / (self.T * self.ticks)
        return loop_numbers(self.response(name), 1e-4 * top, top)


def loop_numbers(L, low, top, points=4001):
    """Return margins, peaks and bandwidth of a loop from its response between two frequencies in rad/s.

    The phase margin is the smallest angle between −1 and L where |L| = 1; the gain margins are those of the nearest
    crossings of the negative real axis. That is right of loops that are stable when they are closed.
    """
    omega = np.geomspace(low, top, points)
    values = L(omega)

    def zeros(of):
        found = of(values)
        places = np.flatnonzero(found[:-1] * found[1:] < 0)
        return [brentq(lambda w: of(L(w))[0], omega[i], omega[i + 1], xtol=1e-12 * omega[i]) for i in places]

    crossovers = [(w, np.degrees(np.angle(-L(w)[0]))) for w in zeros(lambda v: np.log(np.abs(v)))]
    on_axis = [L(w)[0].real for w in zeros(lambda v: v.imag)]
    if abs(values[-1].imag) < 1e-9 * abs(values[-1]):
        on_axis.append(values[-1].real)  # at half the sampling rate L is real
    factors = [-1.0 / v for v in on_axis if v < 0]
    T = np.abs(values / (1.0 + values))
    below = np.flatnonzero(T[0] / np.sqrt(2.0) > T)
    return {
        "phase_margin_deg": min((abs(angle) for _, angle in crossovers), default=np.inf),
        "delay_margin_s": min((np.radians(angle % 360.0) / w for w, angle in crossovers), default=np.inf),
        "gain_margin_high": min((k for k in factors if k > 1), default=np.inf),
        "gain_margin_low": max((k for k in factors if k < 1), default=0.0),
        "ms": np.abs(1.0 / (1.0 + values)).max(),
        "mt": T.max(),
        "disk_margin": 2.0 / np.abs((1.0 - values) / (1.0 + values)).max(),
        "bandwidth": omega[below[0]] if len(below) else np.inf,
    }


def run(rates, law, x, memory, T, duration, wanted=0.0, steps=STEPS):
    """Return times and states of a plant x' = rates(x, u) behind a sampled controller, by Runge-Kutta steps of order 4."""
    x, memory, h = np.array(x, float), dict(memory), T / steps
    times, states = [0.0], [x]
    for k in range(round(duration / T)):
        u = law(k, x, memory, wanted, lambda name, value: value)
        for _ in range(steps):
            k1 = rates(x, u)
            k2 = rates(x + h / 2 * k1, u)
            k3 = rates(x + h / 2 * k2, u)
            k4 = rates(x + h * k3, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        times.append((k + 1) * T)
        states.append(x)
    return np.array(times), np.array(states)


def step_numbers(t, y, change):
    """Return overshoot, settling (2 %), rise (10 % to 90 %) and peak of an answer that ends ``change`` from its start."""
    moved = y - y[0]
    part = moved / change
    outside = np.flatnonzero(np.abs(part - 1.0) > 0.02)
    return {
        "overshoot": max(part.max() - 1.0, 0.0),
        "settling": t[min(outside[-1] + 1, len(t) - 1)] if len(outside) else 0.0,
        "rise": t[np.argmax(part > 0.9)] - t[np.argmax(part > 0.1)],
        "peak": np.abs(moved).max(),
    }
