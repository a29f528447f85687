"""Two masses on springs, each one an FMU, coupled by blocks: their motion in closed form."""

import numpy as np
from scipy.linalg import expm

from loopwright.blocks import Gain, Integrator
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, mass_spring_damper

K, D, M = 100.0, 1.0, 1.0  # of the library's oscillator
PULL = 60.0


def mass(name, position=0.0, fmi=3, **start):
    file = mass_spring_damper.build(fmi=fmi)
    return Fmu(file, name=name, start={"position": position, "velocity": 0.0, **start})


def two_masses(fmi=3, **options):
    """Masses of 1 kg and 2 kg, pulled together by a spring, which is a gain in continuous time."""
    a, b = mass("a", 0.1, fmi), mass("b", fmi=fmi, mass=2.0)
    pull = Gain(gain=PULL, name="spring")(b.position - a.position)
    return Diagram("two", a(force=pull), b(force=-1.0 * pull), **options)


def two_masses_exactly(times):
    """Return the positions of `two_masses`, shape (times, 2)."""
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = [-(K + PULL) / M, -D / M, PULL / M, 0.0]
    A[3] = [PULL / 2, 0.0, -(K + PULL) / 2, -D / 2]
    return np.array([(expm(A * t) @ [0.1, 0.0, 0.0, 0.0])[[0, 2]] for t in times])


def coupled_by_inertia(share):
    """Two masses, each driven by the other's acceleration: F = −share · acceleration, a loop of direct feedthrough."""
    a, b = mass("a", 0.1), mass("b")
    link = Gain(gain=-share, name="link")(b.acceleration)
    return Diagram("inertia", a(force=link), b(force=Gain(gain=-share, name="back")(a.acceleration)))


def coupled_by_inertia_exactly(share, times):
    """Return positions and accelerations of `coupled_by_inertia`, shape (times, 4)."""
    inverse = np.linalg.inv([[M, share], [share, M]])
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:, :2], A[2:, 2:] = -K * inverse, -D * inverse
    states = np.array([expm(A * t) @ [0.1, 0.0, 0.0, 0.0] for t in times])
    return np.hstack([states[:, :2], states @ A[2:].T])


def mass_and_filter():
    """One mass, pulled back by a force that a filter in continuous time makes of its position."""
    a = mass("a", 0.1)
    state = Integrator(name="filter")
    diagram = a(force=-PULL * state.y)
    return Diagram("filtered", diagram, state(20.0 * (a.position - state.y)))


def mass_and_filter_exactly(times):
    """Return position and filter state of `mass_and_filter`, shape (times, 2)."""
    A = np.array([[0.0, 1.0, 0.0], [-K / M, -D / M, -PULL / M], [20.0, 0.0, -20.0]])
    return np.array([(expm(A * t) @ [0.1, 0.0, 0.0])[[0, 2]] for t in times])
