"""A plant of any kind that follows the ellipse of the experiments, by a feedback linearization of its own model."""

import numpy as np

from loopwright.blocks import ErrorDynamics, FeedbackLinearization, PathProjection, SmoothStep, TransverseTransform
from loopwright.diagrams import Diagram, experiments, subsystem

PATH = experiments.ELLIPSE


def follow(plant, model, motor, coordinate, rate):
    """Wire the notebook's path follower around any plant, and run experiment A."""

    @subsystem(sample_time=1e-3)
    def path_follower(position, velocity, coordinate, rate, eta_p, xi_p):
        theta = PathProjection(PATH)(position).named("theta")
        eta, xi = TransverseTransform(PATH)(theta, position, velocity).named("eta", "xi")
        v_par = ErrorDynamics.from_poles([-20] * 3, name="pid_par")(eta, eta_p.named("eta_p"))
        v_perp = ErrorDynamics.from_poles([-40] * 3, name="pid_perp")(xi, xi_p.named("xi_p"))
        return FeedbackLinearization(PATH, model)(theta, coordinate, rate, np.zeros(2), v_par, v_perp)

    eta_p = SmoothStep(levels=(0.12, 0.75, 1.60), start_times=(1.0, 5.5), durations=(2.0, 2.0), name="eta_d")
    xi_p = SmoothStep(
        levels=(0.0, -0.03, 0.03, 0.0), start_times=(4.0, 8.5, 9.5), durations=(0.5, 0.5, 0.5), name="xi_d"
    )
    command = path_follower(plant.position, plant.velocity, coordinate, rate, eta_p, xi_p).named("command")
    return Diagram("d", plant(**{motor: command}, external_force=np.zeros(2))).simulate(11.0, progress=False)
