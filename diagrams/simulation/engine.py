"""The engine of a run: everything that advances in time, without the record.

Time itself advances in C: `fmus/runtime/loop_over_ticks.c`, and `loop_over_time.c` where states are continuous.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks.core import Block, CompilerError, SimulationError, UnknownNameError, near
from ...fmus.calls import FmuInstance
from ..compiled import DiagramCode, find_obstacle
from ..coupling import CoupledSteps, Links, Plant, PlantSteps, load_plants, refuse_model_exchange, to_coupling
from ..flat import FlatDiagram
from ..model_exchange import BlocksInModelExchange, ModelExchangeBlock
from ..results import Occurrence, OperatingPoint, Recorder, Stopped, TextSignal
from ..solvers import solver_name
from .block_start_values import choose_start_values, find_start_values
from .change_over import ChangeOver
from .continuous import Continuous, ContinuousPart
from .failed_blocks import opaque_failure
from .hybrid_ticks import HybridTicks
from .initialize import Initialization
from .plants_in_c import PlantsInC
from .run_options import RunOptions
from .sampled_ticks import SampledTicks
from .start_at_point import check_past, start_at, take_over
from .stops import StopConditions
from .ticks_in_c import find_code, functions_of
from .view import Position, SimulationView
from .workspace import Workspace

Progress = Callable[[float], Any]


class Engine:
    """The numbers of a run, its plants, its solver and its events; it goes from tick to tick."""

    def __init__(
        self,
        flat: FlatDiagram,
        name: str,
        options: RunOptions,
        *,
        every_tick: bool,  # visit every tick, not only those at which a subsystem acts
        on_event: Callable[[Occurrence], None],
    ):
        self.flat, self.name = flat, name
        self.exchanged = BlocksInModelExchange(flat)
        self.workspace = Workspace(flat, self.exchanged.evaluators)
        self.position = Position(flat.base)
        self.plants: dict[str, Plant] = {}
        plants, blocks = MappingProxyType(self.plants), MappingProxyType(self.exchanged.blocks)
        self.view = SimulationView.of(self.workspace, plants, blocks, self.position)
        self.continuous: Continuous | None = None
        self._stops = StopConditions(flat, self.workspace.log, self._find_asking)
        self._passes_on = options.start_exchange
        self._compile, self._fuse = options.compiled, options.fuse
        self._changed = False  # whether generated code has taken over within the run
        self._ticks: SampledTicks | HybridTicks | None = None
        self._in_c: PlantsInC | None = None
        self._generated = False  # whether generated code runs, and no virtual machine
        self.messages: tuple[str, ...] = ()
        self._can_stop = self._stops.exist or bool(self.exchanged)
        self.is_ahead = False
        """Whether the run has ended at a tick beyond which the solver has gone: signals are not those of the end."""
        self._report = on_event
        if flat.hybrid:
            self.continuous = Continuous(
                self.workspace,
                name,
                options.solver,
                options.rtol,
                options.atol,
                options.max_step,
                self._on_event,
                self.exchanged,
            )
        elif options.solver != "auto":
            solver_name(options.solver)  # an unknown one is an error here, too
        self.every_tick = every_tick or (self.continuous is not None and self.continuous.fixed)
        self.coupling = to_coupling(options.coupling, block=name)
        is_coupled = not self.coupling.is_plain and bool(flat.plant_ticks) and Links(flat).exist
        self.coupled: CoupledSteps | None = None
        """Steps of the plants by another scheme than the default."""
        self.steps = PlantSteps(
            flat,
            self.plants,
            self.workspace.z,
            self.workspace.here.w,
            self.position.time_of,
            every_tick=self.every_tick,
            coupled=is_coupled,
        )
        self._change_over = ChangeOver(self.position)
        self._part = ContinuousPart(self.workspace, self.continuous, self.exchanged) if is_coupled else None
        if self._part is not None:
            refuse_model_exchange(self.coupling, {path: flat.table.blocks[path] for path in flat.in_model_exchange})
            self.coupled = CoupledSteps(
                flat,
                name,
                self.plants,
                self.coupling,
                self.steps,
                self.workspace.z,
                self.workspace.here.w,
                self.workspace.bind_model_exchange(),
                self._part,
            )

    def load(self, stack: ExitStack, start_time: float) -> None:
        """Load the plants for a run from a time in s on; ``stack`` unloads them."""
        for path, plant in load_plants(self.flat, stack, start_time):
            self.plants[path] = plant
            if hasattr(plant, "on_end"):
                plant.on_end = self._look_for_ends
        self.exchanged.load(stack, start_time)

    @property
    def loaded(self) -> dict[str, Plant | ModelExchangeBlock]:
        """All that is loaded for the run, by path."""
        return {**self.plants, **self.exchanged.blocks}

    @property
    def has_plants(self) -> bool:
        """Whether anything is loaded for the run, and freed at its end."""
        return bool(self.plants or self.exchanged)

    def initialize(self) -> None:
        """Find values of everything at t = 0; the plants are then ready to be stepped."""
        self.steps.bind()
        large, sampled = self.flat.by_block, self.continuous is None
        plain = sampled and large if self._fuse else sampled or large
        if (plain and self._compile is True) or large:
            self.workspace.evaluate_in_c(self._find_tick_code)
        self._find_start(choose_start_values(self.workspace))
        if self._compile is True:
            self._generate_code()

    def _find_tick_code(self) -> DiagramCode:
        """Return the code of the ticks, for an evaluation of one."""
        functions = functions_of(self.flat, self.continuous, every=self.every_tick)
        return find_code(self.flat, *functions, machine=self._compile is not True)

    def _find_start(self, set_start: Callable[[Workspace], None]) -> None:
        delays = None if self.continuous is None else self.continuous.delays
        take_inputs = self.steps.take_inputs
        Initialization(
            self.workspace, self.plants, delays, take_inputs, self.exchanged, self._passes_on, set_start
        ).find()
        for plant in self.plants.values():
            plant.begin()
        self.exchanged.begin(self.workspace.here.x)
        self.workspace.begun = True

    def take_tier(self) -> str:
        """Return in which form the run has continued since the last call: "interpreted", "compiled" or "both"."""
        found = "both" if self._changed else "compiled" if self._generated else "interpreted"
        self._changed = False
        return found

    @property
    def is_compiled(self) -> bool:
        """Whether generated code goes from tick to tick."""
        return self._generated

    @property
    def can_begin_again(self) -> bool:
        """Whether `begin_again` leaves nothing of a run: C between ticks, no coupling, no FMU in model exchange."""
        plain = (self.continuous is None or self.is_compiled) and self.coupled is None and not self.exchanged
        return plain and all(isinstance(p, FmuInstance) and p.native is not None for p in self.plants.values())

    def begin_again(self, flat: FlatDiagram, set_start: Callable[[Workspace], None] | None = None) -> None:
        """Go back to t = 0 with other numbers of the same functions; the plants, initialized before, stay bound."""
        self.workspace.begin_again(flat)
        self.position.restore(0, None)
        if self.continuous is not None:
            self.continuous.begin_again(flat)
        for plant in self.plants.values():
            assert isinstance(plant, FmuInstance)
            plant.read(0.0)
        self._find_start(set_start or find_start_values)

    def _generate_code(self) -> None:
        """Let generated code go from tick to tick; a message says where it can't be had."""
        obstacle = find_obstacle(self.flat)
        if obstacle is None:
            try:
                self._ticks = self._make_ticks(machine=False)
                self._generated = True
                self.messages += self._ticks.messages
            except CompilerError as error:
                obstacle = str(error)
        if obstacle is not None:
            self.messages += (f"Interpreted, though compile=True asks for C: {obstacle.rstrip('.')}.",)

    def _make_ticks(self, *, machine: bool) -> SampledTicks | HybridTicks:
        """Return the ticks in C, whose functions the virtual machine evaluates, or generated code."""
        plants, stops = self._plants_in_c(), self._stops.entries
        options = {"every": self.every_tick, "machine": machine, "fuse": self._fuse}
        if self.continuous is None:
            return SampledTicks(self.workspace, plants, stops, **options)
        found = HybridTicks(self.continuous, plants, stops, **options)
        if self._part is not None:
            self._part.go_between = found.go_between
        return found

    def _plants_in_c(self) -> PlantsInC:
        if self._in_c is None:
            self._in_c = PlantsInC(self.flat, self.plants, self.steps, self.coupled)
        return self._in_c

    def _find_ticks(self) -> SampledTicks | HybridTicks:
        """Return the ticks in C; without generated code, those of the virtual machine."""
        if self._ticks is None:
            self._ticks = self._make_ticks(machine=True)
        return self._ticks

    def _hybrid_ticks(self) -> HybridTicks:
        found = self._find_ticks()
        assert isinstance(found, HybridTicks)
        return found

    def take_first_tick(self, point: OperatingPoint | None, recorder: Recorder) -> None:
        """Go through the tick with which the run begins, tick 0 or that of an operating point, and record it."""
        workspace, continuous = self.workspace, self.continuous
        first = 0 if point is None else start_at(workspace, point, self.name)
        now, acting = self.position.time_of(first), self.flat.acting(first)
        if continuous is not None:
            if point is not None and continuous.delays is not None:
                check_past(point, continuous.delays, self.name)
                continuous.delays.begin_at(point.w)
            continuous.begin(at_start=point is None)
        workspace.begin(acting)
        if continuous is not None and (continuous.domains is not None or continuous.exchanged is not None):
            self._hybrid_ticks().take_first(now, acting, recorder)
        else:
            workspace.here.t[0] = now
            workspace.tick(acting)
            recorder.row(now, workspace.log)
            if (acting or self.plants) and continuous is not None and continuous.delays is not None:
                continuous.delays.note_edge(now)  # held signals have jumped
        self.steps.begin(first)
        self._arrive(first)

    def go(self, last: int, recorder: Recorder, progress: Progress, *, ends_there: bool = True) -> None:
        """Continue to a tick, or to where a stop condition ends the run; ``progress`` takes the time now and then.

        Without ``ends_there`` the run continues to an end before the next tick: the last tick is then one at which
        something acts, and plants wait at their last communication points for `end_between_ticks`.
        """
        self.is_ahead, ticks = False, self._find_ticks()
        self.steps.ends_at_tick = ends_there
        if not (ends_there or self.every_tick):
            last = max(clock.latest(last) for clock in self.flat.visited)
            if last <= self.position.tick:
                return
        if self._compile == "auto" and not self._generated:
            progress = self._change_over.watch(last, progress, ticks.make_later, self._hand_over)
        try:
            ended = ticks.run(self.position.tick, last, recorder, arrived=self._arrive, progress=progress)
            self.messages += self._change_over.report_failure()
            if ended is not None:
                self.position.stopped = self._stops.met_at(ended)
        except SimulationError as error:
            if not self._end_within_step(error):
                culprit = self.blame(error)
                raise culprit from culprit.__cause__

    def _hand_over(self) -> None:
        """Let generated code continue where the virtual machine has come to."""
        assert self._ticks is not None
        self._ticks.hand_over(self._change_over.code)
        self._changed = self._generated = True

    def prepare(self, recorder: Recorder) -> None:
        """Make what the first tick of `go` needs, which takes time, before a clock runs."""
        self._find_ticks().prepare(recorder)

    def end_between_ticks(self, end: float, recorder: Recorder, progress: Progress) -> None:
        """Continue from a tick to the end of the run, before the next tick, and record it; see `go`."""
        position, workspace = self.position, self.workspace
        try:
            ended = None
            if self.continuous is not None:
                ended = self._hybrid_ticks().end_between_ticks(position.tick, end, recorder)
            else:
                self._plants_in_c().end_at(end, position.tick)
                workspace.here.t[0] = end
                workspace.evaluate_with_held()
                recorder.row(end, workspace.log)
            position.end = end
            if ended is not None:
                position.stopped = self._stops.met_at(ended)
            elif self._can_stop:
                self._is_over()
            progress(position.t)
        except SimulationError as error:
            if not self._end_within_step(error):
                culprit = self.blame(error)
                raise culprit from culprit.__cause__

    def take_texts(self) -> dict[str, TextSignal]:
        """Return texts and binary data of the plants by dotted path; their record begins again with the last ones."""
        found = {}
        for path, plant in self.loaded.items():
            for port, changes in getattr(plant, "texts", {}).items():
                found[f"{path}.{port}"] = TextSignal.of(changes)
                del changes[:-1]
        return found

    def _arrive(self, k: int, steps_on: bool = False) -> bool:
        """Take note of a tick that was recorded; return whether it ends the run, in whose next step plants may be."""
        self.position.tick = k
        return self._can_stop and not steps_on and self._is_over()

    def _is_over(self) -> bool:
        position = self.position
        if position.stopped is None and self._stops.is_met():
            position.stopped = self._stops.met_at(position.t)
            self._note_end(position.t, position.t)
        return position.stopped is not None

    # --- ends that FMUs ask for ---------------------------------------------------------------------------------------

    @property
    def ended_by(self) -> str:
        """Path of the FMU that has asked for the end of the run; empty if none has."""
        return "" if self.position.stopped is None else self._find_asking()

    def _find_asking(self) -> str:
        """Return the path of an FMU that asks for the end of the run; empty if none does."""
        plants = (path for path, plant in self.plants.items() if getattr(plant, "ends_run", False))
        return next(plants, "") or self.exchanged.ends_run()

    def _look_for_ends(self) -> None:
        self._can_stop = True

    def _end_within_step(self, error: SimulationError) -> bool:
        """End the run where an FMU has asked for that within a step; return whether the error is such a request."""
        # Where nothing moves between ticks, the run ends at the FMU's time with its last outputs; else at the last
        # tick.
        at, path, position = getattr(error, "ends_at", None), self._find_asking(), self.position
        plant: Any = self.plants.get(path)
        if at is None or plant is None:
            return False
        end = position.t
        self.is_ahead = self.continuous is not None
        if self.continuous is None and self.coupled is None and at > end:
            try:
                plant.read(at)
            except SimulationError:
                pass  # an FMU that has ended need not give its outputs any more
            else:
                end, flat = at, self.flat
                for name, where in flat.plant_outputs.slices.items():
                    if flat.ports[name][0] == path:
                        self.workspace.log[flat.log.slices[name]] = self.workspace.here.w[where]
        position.stopped = Stopped(end, path)
        self._note_end(at, at if error.t is None else error.t)
        return True

    def _note_end(self, t: float, since: float) -> None:
        """Describe an FMU in co-simulation: its time, its step's start; one in model exchange does so itself."""
        stopped = self.position.stopped
        plant: Any = None if stopped is None else self.plants.get(stopped.block)
        if stopped is not None and getattr(plant, "ends_run", False):
            point = f"; its last communication point is t = {since:.9g} s, and the run ends at t = {stopped.t:.9g} s"
            last = "" if stopped.t == t else point
            plant.add_note(f"it asks to end the simulation at t = {t:.9g} s (terminateSimulation){last}")

    def _on_event(self, event: Occurrence) -> None:
        self.position.note_event(event)
        self._report(event)

    def blame(self, error: SimulationError) -> SimulationError:
        """Return the error with the full path of a plant that has failed, or the error of an opaque block behind it."""
        for path, plant in self.loaded.items():
            if plant.failed:
                error.blame(path)
        self.exchanged.explain(error)
        opaque = opaque_failure(self.flat)
        return error if opaque is None else opaque.at(t=error.t)

    def set_parameters(self, path: str, block: Block) -> None:
        """Let a block continue with the parameters of a variant; see `Simulation.set_parameters`."""
        if path not in self.flat.checked.traced:
            raise UnknownNameError(
                f"no block there is evaluated in this run. {near(path, self.flat.checked.traced)}", block=path
            )
        table = self.flat.table
        if self.continuous is not None and not table.is_sampled(table.subsystem_of[path]):
            self.workspace.check_equations(path, block)
            self.continuous.plan_with(path, block)
        self.workspace.set_parameters(path, block)

    def take_over(self, x: np.ndarray, of: FlatDiagram) -> None:
        """Put the blocks to the states of another diagram; see `Simulation.take_over`."""
        take_over(self.workspace, x, of, self.flat.acting(self.position.tick))
        if self.continuous is not None:
            self.continuous.begin(at_start=False)
