"""Why a run can't continue: the error of the block, or of the method, behind the place where the loop broke off."""

from __future__ import annotations

import math

import numpy as np

from ...blocks.core import NonFiniteError, SimulationError
from ..compiled import BrokenOff, CompiledHybrid, Lost, Pile, StepFailure
from ..solvers import Method
from .continuous import Continuous
from .failed_blocks import failure, forget_trials, opaque_failure


def explain(continuous: Continuous, broken: BrokenOff) -> BaseException:
    """Return the error where the loop has broken off: the instant, or the trial, is evaluated once more."""
    workspace, flat = continuous.workspace, continuous.flat
    t = float(workspace.here.t[0])
    found = opaque_failure(flat)
    if found is not None:
        forget_trials(flat)
        return found.at(t=t)
    continuous.stand_in(broken.edge, broken.left)
    if broken.lost is Lost.AT_INSTANT:
        acting = flat.acting(round(t / flat.base)) if broken.acting is None else broken.acting
        try:
            workspace.evaluate(acting)
            workspace.check(acting)
        except SimulationError as error:
            return error.at(t=t)
        return failure(flat, workspace.here, workspace.log, acting, workspace.evaluators).at(t=t)
    if broken.lost is Lost.AT_TRIAL:
        return _explain_trial(continuous, broken.trial_t, broken.trial_x)
    continuous.beyond = broken.beyond
    return _explain_step(continuous, _step_error(continuous.method, broken))


def explain_library(continuous: Continuous, failed: StepFailure) -> BaseException:
    """Return the error behind that of a library which C has asked for a step."""
    if not isinstance(failed.error, SimulationError):
        return failed.error
    continuous.stand_in(failed.edge, failed.left)
    continuous.beyond = failed.beyond
    return _explain_step(continuous, failed.error)


def _step_error(method: Method, broken: BrokenOff) -> SimulationError:
    """Return the error of a step that could not be taken, or of steps that don't get on."""
    at = method.named(broken.method)
    with np.errstate(all="ignore"):
        try:
            if method.fixed:
                at.check_finite(broken.t_old, at.rate(broken.t_old, broken.x_old), "rate")
                at.check_finite(broken.t, broken.x, "state")
            if broken.lost is Lost.IN_SLOPE:
                at.check_finite(broken.t, at.rate(broken.t, broken.x), "rate")
                at.check_finite(broken.t, at.jacobian(broken.t, broken.x).sum(axis=1), "row in the Jacobian")
        except NonFiniteError as error:
            return error
        if broken.lost is Lost.IN_PROGRESS:
            return at.no_progress(broken.t, broken.x, broken.step)
        return at.failure(broken.t, broken.x, 10 * math.ulp(broken.t))


def _explain_trial(continuous: Continuous, t: float, x: np.ndarray) -> SimulationError:
    """Return the error of a trial: that of the block which made the first value that is not finite."""
    made = _failure_at(continuous, t, x)
    if made is not None:
        return made
    z, opened = continuous.indicators(t, x)
    wrong = np.flatnonzero(~np.isfinite(z) & (opened > 0.5))
    event = continuous.flat.events[int(wrong[0]) if wrong.size else 0]
    return NonFiniteError(
        f"its indicator {event.name!r} is not a finite number; expected one. Look at roots and quotients in it.",
        block=event.path,
        t=t,
    )


def _explain_step(continuous: Continuous, error: SimulationError) -> SimulationError:
    """Return the error behind that of a step: what an opaque block raised, or who made a trial not finite."""
    opaque = opaque_failure(continuous.flat)
    if opaque is not None:
        forget_trials(continuous.flat)
        return opaque.at(t=error.t)
    if error.block is not None or error.state is None:
        return error
    error.blame(error.state.rpartition(".")[0])
    made = None if continuous.beyond is None else _failure_at(continuous, *continuous.beyond)
    if made is None or made.block == error.block:
        return error
    return made.add(f" The solver could not continue without it: {error.message}")


def _failure_at(continuous: Continuous, t: float, x: np.ndarray) -> SimulationError | None:
    continuous.put(t, x)
    try:
        continuous.workspace.evaluate()
        continuous.workspace.check()
    except SimulationError as error:
        return error
    return None


def pile_up(continuous: Continuous, loop: CompiledHybrid, t: float) -> SimulationError:
    """Return the error of events that pile up at t in s, where C has come to; the domains have been taken back."""
    pile, event, times = loop.pile
    if pile is Pile.ENDLESS_OUTSIDE:
        assert continuous.own_events is not None
        return continuous.own_events.endless(t, event, loop.own_event(event))
    assert continuous.domains is not None
    assert loop.watch is not None
    limits = continuous.domains.limits
    if pile is Pile.IN_CONTACT:
        return limits.rests_in_contact(t, event, times)
    if pile is Pile.ZENO:
        return limits.shows_zeno(event)
    if pile is Pile.CHATTERS:
        return limits.chatters(t, event, *continuous.change_of_indicators(t))
    return limits.endless(t, loop.watch.fires, times)
