"""A loop transfer function: a state space of python-control that plots itself, alone or with further loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from control import StateSpace, feedback
from numpy.typing import ArrayLike

from ...blocks.core import (
    Grid,
    OptionError,
    Sheet,
    accepts,
    brief,
    count_of,
    explain_calls,
    kinds,
    missing_member,
    with_unit,
)
from ..plotting import GREY, AxisUnits, legend_above, mark_zeros, shown_figure
from .delayed_realization import DelayedRealization, realize
from .delayed_system import DelayedSystem
from .drawn_loops import (
    BELOW,
    POINTS,
    DrawnLoop,
    confirmed_margins,
    drawn_loops,
    find_spans,
    frequencies_of,
    is_measured,
    limit_of,
    name_loops,
    read_omega,
    response_of,
    style_of,
)
from .loop_drawing import describe_margins, draw_bode_axes, draw_nichols_axes, draw_nyquist_axes
from .pole_maps import plot_poles, plot_root_locus, refuse_delays
from .poles_and_zeros import finite_zeros

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FAR = 8.0
"""Largest part of the plane that a Nyquist plot shows: the real and imaginary part up to this."""


WAYS = {
    **dict.fromkeys(
        ("margins", "margin", "stability_margins", "gain_margin", "phase_margin", "gain_margin_high"),
        "margins(loop): from loopwright import margins",
    ),
    **dict.fromkeys(("rlocus", "root_locus_plot"), "loop.root_locus()"),
    **dict.fromkeys(("bode_plot", "freqresp", "magnitude"), "loop.bode()"),
    **dict.fromkeys(("nyquist_plot", "nichols_plot"), "loop.nyquist() or loop.nichols()"),
    **dict.fromkeys(("step_response", "impulse_response"), "loop.step(), which closes the loop"),
    **dict.fromkeys(("step_info", "stepinfo"), 'diagram.simulate(2.0).step_info("wire")'),
}
"""What to write for names that users of other tools look for in a loop."""


class LoopPlots:
    """Plots of a loop, alone or with further loops, and what it was made from."""

    linearization: Any = None
    wires: tuple[str, ...] = ()
    place: str = ""
    """The place of the cut in words, where it is ahead of some consumers of a wire."""
    inexactness: float = 0.0
    findings: tuple[Any, ...] = ()
    dt: Any
    nstates: int

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            raise missing_member(self, name, "a loop", WAYS)

    def __repr__(self) -> str:
        sampling = f"T = {self.dt:g} s" if self.dt else "continuous"
        delays = count_of(len(getattr(self, "delays", ())), "delay") * hasattr(self, "delays")
        found = count_of(len(self.findings), "finding") * bool(self.findings)
        facts = count_of(self.nstates, "state"), delays, sampling, found, "constant 0" * self._is_zero()
        then = "margins(loop), loop.bode(), loop.nyquist()" + ", print(…) shows its matrices" * (not delays)
        return brief(self._head(), *facts, then=then)

    def _head(self) -> str:
        return f"loop at {self.place or ', '.join(self.wires)}" if self.wires else "loop"

    def _repr_html_(self) -> str | None:
        """Return a short table for a notebook; python-control's matrices grow with the states."""
        facts = (
            ("states", self.nstates),
            ("dead times", len(getattr(self, "delays", ())) or None),
            ("sampling", f"T = {self.dt:g} s" if self.dt else "continuous"),
            ("value", "0 at all frequencies: nothing comes back to this wire" * self._is_zero()),
        )
        findings = Grid("Left out of the model", ("finding",), tuple((str(one),) for one in self.findings))
        return Sheet(self._head(), facts, (findings,), ("margins(loop), loop.bode(), loop.nyquist()",)).as_html()

    def _is_zero(self) -> bool:
        """Whether no way leads from the cut wire back to it, as at the output of a source."""
        if hasattr(self, "delays"):  # it has no matrices; a way may lead through a delay alone
            return False
        B, C, D = (getattr(self, name, 1.0) for name in "BCD")
        return not np.any(D) and not (np.any(B) and np.any(C))

    def _draw_with(
        self, others: Sequence[Any], labels: Sequence[str] | None, omega: ArrayLike | None, *, marked: bool
    ) -> tuple[tuple[Any, ...], list[DrawnLoop]]:
        """Return this loop and the others, and all of them as they are drawn."""
        loops = (self, *others)
        return loops, drawn_loops(loops, name_loops(loops, labels), omega, marked=marked)

    @accepts(omega=kinds.frequencies, labels=kinds.names, db=kinds.flag, hz=kinds.flag, margins=kinds.flag)
    def bode(
        self,
        *others: Any,
        omega: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        db: bool = True,
        hz: bool = False,
        margins: bool = True,
    ) -> Figure:
        """Return the gain and the phase over frequency.

        Parameters
        ----------
        *others : control.StateSpace, control.TransferFunction or control.FrequencyResponseData
            Further loops.
        omega : array_like, optional
            Frequencies in rad/s, in any order; without them those around the crossovers, of a sampled loop up to π/T.
            A sampled loop ends at π/T, and the figure says so where higher ones were asked for.
        labels : sequence of str, optional
            A label for each loop, in place of their names.
        db : bool
            Whether the gain is in decibels.
        hz : bool
            Whether the frequency axis is in Hz.
        margins : bool
            Whether the margins of each loop are marked: the phase margin at each |L| = 1 (○), the gain margin at each
            crossing of −180° (□). The phase is drawn on the branch on which the phase margin can be read from −180°.

        Raises
        ------
        OptionError
            If a loop has several inputs or outputs, or the labels or frequencies don't fit.
        """
        return _plot_bode(
            *self._draw_with(others, labels, omega, marked=margins), omega, AxisUnits(decibels=db, hertz=hz)
        )

    @accepts(omega=kinds.frequencies, labels=kinds.names, margins=kinds.flag)
    def nyquist(
        self,
        *others: Any,
        omega: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        margins: bool = True,
    ) -> Figure:
        """Return the locus of L around −1, with all its crossings of the real axis up to 8 from the origin in view.

        Arrows point to rising frequencies, the thin line is that of negative ones, and the circle is |L| = 1. The marks
        are the points with |L| = 1 (○), the crossings of the negative real axis (□), and the largest circle around −1
        that L keeps out of (dotted). See `bode` for the parameters.
        """
        return _plot_nyquist(*self._draw_with(others, labels, omega, marked=margins), omega)

    @accepts(omega=kinds.frequencies, labels=kinds.names, margins=kinds.flag)
    def nichols(
        self,
        *others: Any,
        omega: ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        margins: bool = True,
    ) -> Figure:
        """Return gain over phase, with contours of |T| in dB. See `bode` for the parameters."""
        return _plot_nichols(*self._draw_with(others, labels, omega, marked=margins), omega)

    @accepts(gains=kinds.numbers, margins=kinds.flag)
    def root_locus(self, gains: ArrayLike | None = None, *, margins: bool = True) -> Figure:
        """Return the closed-loop poles over a gain k: those of the loop k L, in the s plane, or in the z plane.

        Poles (×) and zeros (○) are those of L, squares are the closed-loop poles of the loop as it is, k = 1. Diamonds
        are poles on the limit of stability, with their gains. Thin lines have equal damping ratios and natural
        frequencies; in the z plane the dark circle is the limit of stability.

        Parameters
        ----------
        gains : array_like, optional
            Gains; without them 0 and 0.001 to 1000, dense where the poles move fast.
        margins : bool
            Whether the limits of stability are marked.

        Raises
        ------
        OptionError
            If the loop has several inputs or outputs, or delays.
        """
        (name,) = name_loops((self,), None)
        refuse_delays(self, name)
        chosen = None if gains is None else np.unique(np.asarray(gains, dtype=float))
        return plot_root_locus(self, name, chosen, confirmed_margins(self) if margins else None)

    @accepts()
    def pzmap(self) -> Figure:
        """Return the poles and zeros of L in the s plane, or in the z plane with the unit circle.

        Raises
        ------
        OptionError
            If the loop has several inputs or outputs, or delays.
        """
        (name,) = name_loops((self,), None)
        refuse_delays(self, name)
        loop: Any = self
        return plot_poles(np.ravel(loop.poles()), finite_zeros(loop), float(self.dt or 0.0), f"poles of {name}")

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
        names = name_loops(loops, labels)
        closed = [_close_loop(loop) for loop in loops]
        return _plot_step(closed, names, t, max(map(_horizon, loops)))

    @accepts(measured=kinds.text, omega=kinds.frequencies, labels=kinds.names)
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
        names = name_loops(loops, labels)
        return _plot_gang_of_four([_find_gang_of_four(loop, measured) for loop in loops], names, omega)


@explain_calls
class LoopTransfer(LoopPlots, StateSpace):  # type: ignore[misc]
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


@explain_calls
class DelayedLoop(LoopPlots, DelayedSystem):
    """The loop transfer function L at a wire of a continuous diagram with delays; `Linearization.loop` returns it.

    It is exact in e^(−sτ), as a `DelayedSystem` is, and plots itself as a `LoopTransfer` does.

    Attributes
    ----------
    linearization : Linearization or None
        The model that it was made from.
    wires : tuple of str
        The wires that are cut.
    findings, notes : tuple
        Effects that limit it; see `Linearization.loop`.
    """

    __str__ = LoopPlots.__repr__


def _find_gang_of_four(loop: Any, measured: str) -> dict[str, StateSpace]:
    """Return L, S, PS, CS and T at the wire of a loop and a measured one, as `control.StateSpace`."""
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


def _close_loop(loop: Any) -> StateSpace:
    """Return T = L/(1 + L), which must be stable: the model's own, where a loop knows its model."""
    name = str(getattr(loop, "name", None) or "loop")
    if is_measured(loop):
        raise OptionError(
            "found frequency-response data; expected a linear system: data has no step response. Leave it out.",
            block=name,
        )
    model = getattr(loop, "linearization", None)
    closed = feedback(loop, 1) if model is None else model.complementary(*loop.wires)
    if isinstance(loop, DelayedSystem) and not DelayedRealization.of(loop).is_stable():
        raise OptionError(
            "found a closed loop that is not stable; expected one that settles. Look at L.nyquist() and margins(L).",
            block=name,
        )
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
    w = frequencies_of(loop)
    size = np.abs(response_of(loop, w))
    crossed = w[1:][(size[1:] > 1.0) != (size[:-1] > 1.0)]
    return 30.0 / float(crossed[0] if crossed.size else np.sqrt(w[0] * w[-1]))


def _write_ends(axes: Axes, loops: Sequence[Any], names: Sequence[str], omega: ArrayLike | None) -> None:
    """Say in a figure which loops end at π/T although higher frequencies were asked for."""
    if omega is None:
        return
    highest = read_omega(omega)[-1]
    cut = [
        f"{name} at π/T = {limit_of(loop):.4g} rad/s"
        for name, loop in zip(names, loops, strict=True)
        if highest >= limit_of(loop)
    ]
    if cut:
        axes.set_title("Ends: " + ", ".join(cut), loc="left", fontsize="small")


def _legend(figure: Figure, axes: Axes) -> None:
    legend_above(figure, axes)
    figure.align_ylabels()


def _write_title(axes: Axes, drawn: Sequence[DrawnLoop], loops: Sequence[Any], omega: ArrayLike | None) -> None:
    """Write the margins of a single loop above the axes, and where sampled loops end."""
    if len(drawn) == 1 and (text := describe_margins(drawn[0].margins)):
        axes.set_title(text, loc="right", fontsize="small")
    _write_ends(axes, loops, [one.title for one in drawn], omega)


def _plot_bode(loops: Sequence[Any], drawn: Sequence[DrawnLoop], omega: ArrayLike | None, units: AxisUnits) -> Figure:
    """Return the gain and the phase over frequency; see `LoopTransfer.bode`."""
    with shown_figure(4.4) as figure:
        gain, phase = figure.subplots(2, 1, sharex=True)
        draw_bode_axes(gain, phase, drawn, units)
        _write_title(gain, drawn, loops, omega)
        _legend(figure, gain)
    return figure


def _plot_nyquist(loops: Sequence[Any], drawn: Sequence[DrawnLoop], omega: ArrayLike | None) -> Figure:
    """Return the loci of the loops around −1; see `LoopTransfer.nyquist`."""
    reach = 1.6
    for one in drawn:
        crossed = np.flatnonzero((one.values.imag[1:] > 0) != (one.values.imag[:-1] > 0))
        left = -one.values.real[crossed]
        reach = max(reach, 1.2 * float(np.max(left[left < FAR], initial=0.0)))
    with shown_figure(5.0) as figure:
        axes = figure.subplots()
        draw_nyquist_axes(axes, drawn)
        axes.annotate("−1", (-1.0, 0.0), (-6, 5), textcoords="offset points", ha="right", fontsize=7)
        axes.axhline(0.0, color=GREY, linewidth=0.6, zorder=0)
        axes.axvline(0.0, color=GREY, linewidth=0.6, zorder=0)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
        _write_title(axes, drawn, loops, omega)
        _legend(figure, axes)
    return figure


def _plot_nichols(loops: Sequence[Any], drawn: Sequence[DrawnLoop], omega: ArrayLike | None) -> Figure:
    """Return gain over phase, with contours of |T|; see `LoopTransfer.nichols`."""
    with shown_figure(4.6) as figure:
        axes = figure.subplots()
        draw_nichols_axes(axes, drawn)
        _write_title(axes, drawn, loops, omega)
        _legend(figure, axes)
    return figure


def _plot_step(closed: Sequence[Any], names: Sequence[str], times: ArrayLike | None, horizon: float) -> Figure:
    """Return the step responses of closed loops; see `LoopTransfer.step`."""
    import control

    with shown_figure(3.4) as figure:
        axes = figure.subplots()
        end = horizon if times is None else float(np.max(np.asarray(times, dtype=float)))
        if not 0.0 < end < np.inf:
            raise OptionError(f"found {times!r}; expected times in s above 0. Give some.", port="t")
        for i, system in enumerate(closed):
            dt = float(system.dt or 0.0)
            grid = dt * np.arange(int(end / dt * (1 + 1e-9)) + 1) if dt else np.linspace(0.0, end, POINTS)
            answer = system.step_response(grid)[:, 0] if isinstance(system, DelayedSystem) else None
            if answer is None:
                answer = np.ravel(control.step_response(system, T=grid).y)
            look = style_of(i, system)
            axes.plot(grid, answer, label=names[i], drawstyle="steps-post" if dt else "default", **look)
        axes.axhline(1.0, color=GREY, linewidth=0.8, zorder=0)
        axes.set(xlim=(0.0, end), xlabel=with_unit("t", "s"), ylabel="response to a unit step")
        _legend(figure, axes)
    return figure


def _plot_gang_of_four(systems: Sequence[Mapping[str, Any]], names: Sequence[str], omega: ArrayLike | None) -> Figure:
    """Return the gains of S, T, PS and CS; see `LoopTransfer.gang_of_four`."""
    with shown_figure(4.8) as figure:
        panels = figure.subplots(2, 2, sharex=True)
        for axes, key in zip(np.ravel(panels), ("S", "PS", "CS", "T"), strict=True):
            own = [found[key] for found in systems]
            spans = find_spans([found["L"] for found in systems], (), omega)
            for i, (system, w) in enumerate(zip(own, spans, strict=True)):
                if omega is None:  # closed loops have other resonances, up to π/T
                    top = limit_of(system) * BELOW if system.dt else float(w[-1])
                    w = realize(system).grid(float(w[0]), top, POINTS)
                axes.plot(w, np.abs(response_of(system, w)), label=names[i], **style_of(i, system))
            mark_zeros(axes)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_ylabel(f"|{key}|")
            if key in ("S", "T"):
                axes.axhline(1.0, color=GREY, linewidth=0.8, zorder=0)
        for axes in panels[1]:
            axes.set_xlabel(with_unit("ω", "rad/s"))
        _write_ends(panels[0, 0], [found["L"] for found in systems], names, omega)
        _legend(figure, panels[0, 0])
    return figure
