"""A loop transfer function: a state space of python-control that plots itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from control import StateSpace, feedback
from numpy.typing import ArrayLike

from ...blocks.core import OptionError, accepts, brief, count_of, explain_calls, kinds
from . import loop_plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Model(Protocol):
    """The linear model that a loop was made from."""

    def sensitivity(self, *wires: str) -> StateSpace:
        """Return S at wires."""

    def complementary(self, *wires: str) -> StateSpace:
        """Return T = 1 − S at wires."""


@explain_calls
class LoopTransfer(StateSpace):  # type: ignore[misc]
    """The loop transfer function L at a wire, a `control.StateSpace`; `Linearization.loop` returns it.

    All that python-control does with a state space, it does with this; a result of its arithmetic is a plain state
    space again. The plots take further loops, which are overlaid: of other diagrams, of python-control, and
    frequency-response data (`FrequencyResponse.L`), which appears as points. They return a matplotlib figure, drawn
    without pyplot.

    Attributes
    ----------
    linearization : Linearization or None
        The model that it was made from.
    wires : tuple of str
        The wires that are cut.
    inexactness : float
        Estimated error of its matrices, relative to their largest entry: that of the linear models of FMUs; NaN
        if it is not known.
    findings, notes : tuple
        Effects that limit it; see `Linearization.loop`.
    """

    linearization: Model | None = None
    wires: tuple[str, ...] = ()
    inexactness: float = 0.0

    # python-control keeps two functions in a state space that refer to it. Such a circle of references, and with it the
    # linear model and the processes of its FMUs, would stay until garbage is collected.
    @property
    def updfcn(self) -> Any:
        """Function ``(t, x, u, params)`` of python-control that returns dx/dt, or x at the next tick."""
        return lambda t, x, u, params: self.A @ np.atleast_1d(x) + self.B @ np.atleast_1d(u)

    @updfcn.setter
    def updfcn(self, function: Any) -> None:
        """Do nothing: the matrices are the function."""

    @property
    def outfcn(self) -> Any:
        """Function ``(t, x, u, params)`` of python-control that returns y."""
        return lambda t, x, u, params: self.C @ np.atleast_1d(x) + self.D @ np.atleast_1d(u)

    @outfcn.setter
    def outfcn(self, function: Any) -> None:
        """Do nothing: the matrices are the function."""

    def __repr__(self) -> str:
        sampling = f"T = {self.dt:g} s" if self.dt else "continuous"
        facts = count_of(self.nstates, "state"), sampling, count_of(len(self.findings), "finding") * bool(self.findings)
        then = "margins(loop), loop.bode(), loop.nyquist(), print(…) shows its matrices"
        return brief(f"loop at {', '.join(self.wires)}" if self.wires else "loop", *facts, then=then)

    def _repr_html_(self) -> None:
        """Return None: a notebook shows the short text; python-control's matrices grow with the states."""

    @accepts(labels=kinds.names, db=kinds.flag, hz=kinds.flag)
    def bode(
        self,
        *others: Any,
        omega: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        db: bool = True,
        hz: bool = False,
    ) -> Figure:
        """Return the gain and the phase over frequency.

        Parameters
        ----------
        *others : control.StateSpace, control.TransferFunction or control.FrequencyResponseData
            Further loops.
        omega : array_like, optional
            Frequencies in rad/s, in any order; without them those around the crossovers. A sampled loop ends at π/T,
            and the figure says so where higher ones were asked for.
        labels : sequence of str, optional
            A label for each loop, in place of their names.
        db : bool
            Whether the gain is in decibels.
        hz : bool
            Whether the frequency axis is in Hz.

        Raises
        ------
        OptionError
            If a loop has several inputs or outputs, or the labels or frequencies don't fit.
        """
        return loop_plots.bode((self, *others), omega, labels, db=db, hz=hz)

    @accepts(labels=kinds.names)
    def nyquist(self, *others: Any, omega: ArrayLike | None = None, labels: Sequence[str] | None = None) -> Figure:
        """Return the locus of L around −1, with all its crossings of the real axis up to 8 from the origin in view.

        The arrow points to rising frequencies, the thin line is that of negative ones, and the circle is |L| = 1. See
        `bode` for the parameters.
        """
        return loop_plots.nyquist((self, *others), omega, labels)

    @accepts(labels=kinds.names)
    def nichols(self, *others: Any, omega: ArrayLike | None = None, labels: Sequence[str] | None = None) -> Figure:
        """Return gain over phase, with contours of |T| in dB. See `bode` for the parameters."""
        return loop_plots.nichols((self, *others), omega, labels)

    @accepts(t=kinds.numbers, labels=kinds.names)
    def step(self, *others: Any, t: float | None = None, labels: Sequence[str] | None = None) -> Figure:
        """Return the step response of the closed loop T = L/(1 + L), which is to follow the step.

        Parameters
        ----------
        *others : control.StateSpace or control.TransferFunction
            Further loops.
        t : float, optional
            End in s; without it 30 divided by the lowest gain crossover.
        labels : sequence of str, optional
            A label for each loop.

        Raises
        ------
        OptionError
            If a loop has several inputs or outputs or is measured data, or the closed loop is not stable.
        """
        loops = (self, *others)
        loop_plots.check_single(loops)
        names = loop_plots.labels_of(loops, labels)
        closed = [closed_loop(loop) for loop in loops]
        return loop_plots.step(closed, names, t, max(map(_horizon, loops)))

    @accepts(measured=kinds.text, labels=kinds.names)
    def gang_of_four(
        self, measured: str, *others: LoopTransfer, omega: ArrayLike | None = None, labels: Sequence[str] | None = None
    ) -> Figure:
        """Return the gains of S, PS, CS and T over frequency.

        The loop's wire is the plant's input, u. PS is the response of the measured signal to a disturbance at u, CS
        that of u to noise on the measured signal, and T = 1 − S.

        Parameters
        ----------
        measured : str
            Wire of the plant's measured output, which the controller reads.
        *others : LoopTransfer
            Further loops, whose diagrams have a wire of this name as well.
        omega, labels
            See `bode`.

        Raises
        ------
        OptionError
            If one of them was not made by `Linearization.loop` at one wire with one entry.
        """
        loops = (self, *others)
        loop_plots.check_single(loops)
        names = loop_plots.labels_of(loops, labels)
        return loop_plots.four([four_of(loop, measured) for loop in loops], names, omega)


def four_of(loop: Any, measured: str) -> dict[str, StateSpace]:
    """Return L, S, PS, CS and T at the wire of a loop and a measured one, as `control.StateSpace`.

    Raises
    ------
    OptionError
        If the loop was not made by `Linearization.loop`, or the measured wire has several entries.
    """
    model = getattr(loop, "linearization", None)
    if model is None or len(loop.wires) != 1:
        raise OptionError(
            f"found {type(loop).__name__}; expected a loop of linearize().loop(…), which knows its diagram. For plain "
            "systems there is gang_of_four(P, C).",
            block=str(getattr(loop, "name", None) or "loop"),
        )
    both = model.sensitivity(loop.wires[0], measured)
    if both.noutputs != 2:
        raise OptionError(
            f"found that {measured!r} has {both.noutputs - 1} entries; expected one. Name the entry, as "
            f"'{measured}[1]'.",
            port="measured",
        )
    return {"L": loop, "S": both[0, 0], "PS": both[1, 0], "CS": -both[0, 1], "T": 1 - both[0, 0]}


def closed_loop(loop: Any) -> StateSpace:
    """Return T = L/(1 + L): the model's own, where a loop knows its model.

    Raises
    ------
    OptionError
        If it is measured data, or is not stable.
    """
    name = str(getattr(loop, "name", None) or "loop")
    if loop_plots.is_measured(loop):
        raise OptionError(
            "found frequency-response data; expected a linear system: data has no step response. Leave it out.",
            block=name,
        )
    model = getattr(loop, "linearization", None)
    closed = feedback(loop, 1) if model is None else model.complementary(*loop.wires)
    poles = feedback(loop, 1).poles()
    growth = np.abs(poles) - 1.0 if loop.dt else np.real(poles)
    if np.max(growth, initial=-np.inf) > 1e-9:
        worst = poles[int(np.argmax(growth))]
        raise OptionError(
            f"found a closed loop with a pole at {worst:.4g}, which is not stable; expected one that settles. Look at "
            "L.nyquist() and margins(L).",
            block=name,
        )
    return closed


def _horizon(loop: Any) -> float:
    """Return the time in s over which a step response is shown: 30 divided by the lowest gain crossover."""
    w = loop_plots.frequencies(loop)
    size = np.abs(loop_plots.response(loop, w))
    crossed = w[1:][(size[1:] > 1.0) != (size[:-1] > 1.0)]
    return 30.0 / float(crossed[0] if crossed.size else np.sqrt(w[0] * w[-1]))
