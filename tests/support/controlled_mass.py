"""A PI controller at 1 kHz around the FMU of a mass on a spring, and its motion by the exponential of a matrix."""

import numpy as np
from scipy.linalg import expm

from loopwright.blocks import UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import mass_spring_damper

T = 1e-3
_M = mass_spring_damper.nominal
A = np.array([[0.0, 1.0], [-_M.stiffness / _M.mass, -_M.damping / _M.mass]])
B = np.array([[0.0], [1.0 / _M.mass]])
START = 0.1


def pi_loop(plant):
    """A PI controller at 1 kHz around an FMU."""

    @subsystem(sample_time=T, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 20.0 * error + 50.0 * memory(memory.y + T * error)

    return Diagram("loop", plant(force=controller(plant.position)))


def held(duration):
    """The matrix that takes position, velocity and a held force to position and velocity a duration in s later."""
    return expm(duration * np.block([[A, B], [np.zeros((1, 3))]]))[:2]


def exact_loop(n):
    """Positions in that loop at n ticks, by the exponential of a matrix."""
    step = held(T)
    x, integral, found = np.array([START, 0.0]), 0.0, []
    for _ in range(n):
        found.append(x[0])
        error = 1.0 - x[0]
        force, integral = 20.0 * error + 50.0 * integral, integral + T * error
        x = step @ [*x, force]
    return np.array(found)
