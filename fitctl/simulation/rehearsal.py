"""What a command would do: given on the virtual clock, to a simulation put where the instrument is now.

The simulation begins with the stages, the mode and the target that telemetry has. A star or beam that is not
measured now is assumed on its target. Faults of real devices are not in it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.config import ConfigError, Rig
from fitctl.logging.records import AnyRecord, Event, MetrologyTick, Tick
from fitctl.messages.command_table import WORDS
from fitctl.messages.commands import (
    Acquire,
    AnyCommand,
    RecentEvents,
    SetBiasOffset,
    SetTarget,
    Shutdown,
    Standby,
    Status,
    Stop,
    TakeOver,
)
from fitctl.messages.modes import HOLDING, POINTING, Mode
from fitctl.messages.telemetry import LoopState, Telemetry
from fitctl.model.optics import scales
from fitctl.simulation.simulation import Simulation

SETTLE_S = 3.0
AFTER_S = 20.0  # how long the stages are followed after a command, at least
LONGEST_S = 120.0  # and while it is under way
STEP_S = 0.1
# They are for a supervisor's process and its clients, of which a simulation has none.
NOT_REHEARSED = (Shutdown, Status, RecentEvents, TakeOver)

Pair = tuple[float, float]


class RehearsalError(Exception):
    """A rehearsal cannot be made, and why."""


def require_rehearsable(command: AnyCommand) -> None:
    """Refuse a command that a simulation cannot follow.

    Raises
    ------
    ConfigError
        If it is such a command; the text names those that can be rehearsed.
    """
    if isinstance(command, NOT_REHEARSED):
        word = next(word for word, row in WORDS.items() if row.make is type(command))
        can_be = ", ".join(
            word for word, row in WORDS.items() if not issubclass(row.make, NOT_REHEARSED)
        )
        msg = (
            f"rehearse: {word} is for the supervisor's process, which is not simulated. "
            f"Available: {can_be}"
        )
        raise ConfigError(msg)


class Present(NamedTuple):
    """One loop as telemetry has it."""

    state: LoopState
    tick: Tick | None
    beam: MetrologyTick | None

    @property
    def motor_rad(self) -> Pair | None:
        """Motor angles of the siderostat, as last read; None if they are not known."""
        tick = self.tick or self.beam
        if tick is None or not math.isfinite(tick.siderostat_az_rad + tick.siderostat_el_rad):
            return None
        return tick.siderostat_az_rad, tick.siderostat_el_rad


class End(msgspec.Struct, frozen=True, kw_only=True):
    """Where one loop is before the command, and where it would end. Angles of stages are from the tick."""

    loop: str
    mode: tuple[str, str]
    siderostat_sky_arcsec: tuple[Pair, Pair]
    mirror_urad: tuple[Pair, Pair] | None
    mirror_range_fraction: tuple[float, float] | None


class Trip(msgspec.Struct, frozen=True, kw_only=True):
    """An interlock that would trip, how long after the command."""

    loop: str
    name: str
    after_s: float
    action: str
    reason: str


class Rehearsal(msgspec.Struct, frozen=True, kw_only=True):
    """What a command would do.

    ``refused`` is why it would be refused, empty if it would not. ``in_force`` are interlocks that are tripped
    on the instrument now. ``unlike`` says which loops could not be brought to their present mode.
    """

    accepted: bool
    refused: str
    duration_s: float
    ends: list[End]
    trips: list[Trip]
    events: list[str]
    in_force: list[str]
    unlike: list[str]


class Stage:
    """A simulation at the present state of an instrument.

    Parameters
    ----------
    rig : Rig
        Must have its ``plant`` section.
    loops : dict of Present
        By name.
    deadline_s : float
        By `time.monotonic`; a rehearsal that is not done then is given up.
    """

    def __init__(self, rig: Rig, loops: dict[str, Present], deadline_s: float) -> None:
        self.records: list[AnyRecord] = []
        self.simulation = Simulation(rig, 0, record=self.records.append, history_s=1.0)
        self._loops = loops
        self._deadline_s = deadline_s
        place(self.simulation, loops)
        self._ticks: dict[str, Tick | MetrologyTick] = {}

    def run(self, duration_s: float) -> None:
        """Go on by some virtual time.

        Raises
        ------
        RehearsalError
            After the deadline.
        """
        end_s = self.simulation.clock.now_s() + duration_s
        while self.simulation.clock.now_s() < end_s - 1e-9:
            if time.monotonic() > self._deadline_s:
                msg = "the rehearsal took too long and was given up; the instrument was not touched"
                raise RehearsalError(msg)
            self.simulation.run(min(STEP_S, end_s - self.simulation.clock.now_s()))
            self.simulation.ticks.clear()

    def bring_to_present(self) -> list[str]:
        """Power up, acquire, and set targets as the instrument has them; in which loops that differs."""
        supervisor = self.simulation.supervisor
        wanted = {
            name: now.state.mode for name, now in self._loops.items() if name in supervisor.loops
        }
        pointing = {mode.name for mode in POINTING}
        for name, mode in wanted.items():
            if mode != "OFF":
                self.simulation.command(Standby(loop=name))
        for name, mode in wanted.items():
            if mode in pointing:
                self.simulation.command(Acquire(loop=name))
        held = {mode.name for mode in HOLDING}
        waited_s = 0.0
        while waited_s < LONGEST_S and any(
            mode in held and supervisor.loops[name].mode.name not in held
            for name, mode in wanted.items()
        ):
            self.run(1.0)
            waited_s += 1.0
        for name, mode in wanted.items():
            self._set_up(name, self._loops[name], mode)
        self.run(SETTLE_S)
        return [
            f"{name} is in {mode}, in the rehearsal in {supervisor.loops[name].mode.name}"
            for name, mode in wanted.items()
            if supervisor.loops[name].mode.name != mode
        ]

    def _set_up(self, name: str, present: Present, mode: str) -> None:
        tick = present.tick
        if mode == "SAFE":
            self.simulation.command(Stop(loop=name))
        elif mode in {"COARSE", "VERNIER"} and tick is not None:
            here = self.simulation.supervisor.stellar_loops[name].target_px
            if math.dist(here, (tick.target_az_px, tick.target_el_px)) > 1e-6:
                target = SetTarget(az_px=tick.target_az_px, el_px=tick.target_el_px, loop=name)
                self.simulation.command(target)
        elif mode == "STANDBY" and any(present.state.bias_offset_urad):
            az_urad, el_urad = present.state.bias_offset_urad
            self.simulation.command(SetBiasOffset(az_urad=az_urad, el_urad=el_urad, loop=name))

    def newest_ticks(self) -> dict[str, Tick | MetrologyTick]:
        """Of each loop, since this was asked last or before; the records until now are dropped."""
        for record in self.records:
            if isinstance(record, Tick | MetrologyTick):
                self._ticks[record.loop] = record
        self.records.clear()
        return dict(self._ticks)


def present_of(messages: Sequence[Telemetry]) -> dict[str, Present]:
    """The loops of some messages in a row, each with its newest tick."""
    ticks = {tick.loop: tick for message in messages for tick in message.ticks}
    beams = {tick.loop: tick for message in messages for tick in message.metrology_ticks}
    return {
        loop.name: Present(loop, ticks.get(loop.name), beams.get(loop.name))
        for loop in messages[-1].loops
    }


def place(simulation: Simulation, loops: dict[str, Present]) -> None:
    """Put motors, stars and beams of a simulation that has not begun where an instrument has them."""
    plant = simulation.plant
    for name, present in loops.items():
        part = plant.loops.get(name)
        if part is not None and present.motor_rad is not None:
            part.state.motor_rad[0] = part.state.beam_motor_rad[0] = present.motor_rad
    plant.advance(plant.step_s)
    now_s = plant.step_s
    for name, beam_part in plant.metrology_loops.items():
        offset_m = beam_part.offset_m(now_s)[0] - _beam_m(loops.get(name))
        beam_part.misaligned_rad[0] -= offset_m / beam_part.sensor.link_length_m
    plant.advance(2 * plant.step_s)  # over a link, the beam moves the star
    for name, part in plant.stellar_loops.items():
        star_px = _star_px(simulation.rig, name, loops.get(name))
        part.constants.spot_origin_px[0] += star_px - part.spots_px(2 * now_s)[0, 0]


def _beam_m(present: Present | None) -> NDArray[np.float64]:
    """Where the beam is on its photodiodes; centred, where they do not measure it."""
    beam = None if present is None else present.beam
    beam_m = np.zeros(2) if beam is None else np.array([beam.beam_az_m, beam.beam_el_m])
    return np.nan_to_num(beam_m)


def _star_px(rig: Rig, name: str, present: Present | None) -> NDArray[np.float64]:
    """Where the star would be with the mirror at its bias; on its target, where it is not measured."""
    loop = rig.stellar_loops[name]
    tick = None if present is None else present.tick
    if tick is None or not tick.star_visible:
        return np.array([loop.target_px.az, loop.target_px.el])
    mirror_rad = np.array([tick.fsm_az_rad, tick.fsm_el_rad])
    return np.array([tick.star_az_px, tick.star_el_px]) - scales(rig, loop).mirror_px(mirror_rad)


def rehearse(rig: Rig, loops: dict[str, Present], command: AnyCommand, limit_s: float) -> Rehearsal:
    """Give a command to a simulation at the present state, and follow it until the stages rest.

    Parameters
    ----------
    rig : Rig
    loops : dict of Present
    command : AnyCommand
    limit_s : float
        Of real time.

    Raises
    ------
    RehearsalError
        If it takes longer.
    """
    stage = Stage(rig, loops, time.monotonic() + limit_s)
    unlike = stage.bring_to_present()
    supervisor, clock = stage.simulation.supervisor, stage.simulation.clock
    modes = {name: loop.mode for name, loop in supervisor.loops.items()}
    before = stage.newest_ticks()
    tripped = _tripped(stage)
    began_s = clock.now_s()
    reply = stage.simulation.command(command)
    trips: dict[tuple[str, str], Trip] = {}
    events: list[str] = []
    after: dict[str, Tick | MetrologyTick] = before
    while reply.accepted:
        stage.run(STEP_S)
        passed_s = clock.now_s() - began_s
        for key, trip in _tripped(stage).items():
            if key not in tripped:
                trips.setdefault(key, msgspec.structs.replace(trip, after_s=passed_s))
        events += [
            f"{record.source}: {record.message}"
            for record in stage.records
            if isinstance(record, Event) and record.severity != "info"
        ]
        after = stage.newest_ticks()
        if passed_s >= LONGEST_S or (passed_s >= AFTER_S and not _under_way(stage)):
            break
    return Rehearsal(
        accepted=reply.accepted,
        refused="" if reply.accepted else reply.text,
        duration_s=clock.now_s() - began_s,
        ends=[
            _end(name, modes[name], loop.mode, before[name], after[name])
            for name, loop in supervisor.loops.items()
            if name in before
        ],
        trips=list(trips.values()),
        events=events,
        in_force=[
            f"{name}: {trip.name}" for name, now in loops.items() for trip in now.state.interlocks
        ],
        unlike=unlike,
    )


def _tripped(stage: Stage) -> dict[tuple[str, str], Trip]:
    return {
        (name, trip.name): Trip(
            loop=name, name=trip.name, after_s=0.0, action=trip.action, reason=trip.reason
        )
        for name, loop in stage.simulation.supervisor.loops.items()
        for trip in loop.interlocks.tripped
    }


def _under_way(stage: Stage) -> bool:
    supervisor, now_s = stage.simulation.supervisor, stage.simulation.clock.now_s()
    return any(
        outcome.state == "under way"
        for loop in supervisor.loops.values()
        for outcome in supervisor.outcomes.add_to(loop.state(now_s)).outcomes
    )


def _end(
    name: str,
    from_mode: Mode,
    to_mode: Mode,
    before: Tick | MetrologyTick,
    after: Tick | MetrologyTick,
) -> End:
    both = (before, after)
    sky = [(tick.siderostat_az_sky_arcsec, tick.siderostat_el_sky_arcsec) for tick in both]
    mirror = [
        (1e6 * tick.fsm_az_rad, 1e6 * tick.fsm_el_rad) for tick in both if isinstance(tick, Tick)
    ]
    used = [tick.fsm_range_fraction for tick in both if isinstance(tick, Tick)]
    return End(
        loop=name,
        mode=(from_mode.name, to_mode.name),
        siderostat_sky_arcsec=(sky[0], sky[1]),
        mirror_urad=(mirror[0], mirror[1]) if len(mirror) == 2 else None,
        mirror_range_fraction=(used[0], used[1]) if len(used) == 2 else None,
    )
