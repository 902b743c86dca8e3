"""A held star that is made to move: what the instrument, and the plant truly, did about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.identify.record import axis_pair, tick_columns
from fitctl.identify.run import hold_on_simulation
from fitctl.messages.commands import SetTarget
from fitctl.model.optics import mirror_from_stacks, scales
from fitctl.simulation.simulation import Simulation

Floats = NDArray[np.float64]
_NEAR_PX = np.array(
    [2.0, 1.0]
)  # the star's place at the start: the search is not what is looked at
SETTLE_S = 20.0  # in VERNIER, before the clock of a motion starts


class Motion(NamedTuple):
    """Frame by frame, from shortly before the motion; times count from the motion's clock.

    Attributes
    ----------
    time_s : array, shape (frames,)
        Of mid-exposure.
    star_px, measured_px, target_px : arrays, shape (frames, 2)
        The star truly, by its centroid (NaN unseen), and where it was to be held then (prefiltered).
    mirror_px, mirror_command_px : arrays, shape (frames, 2)
        By how much the mirror moves the star: truly, and as commanded.
    motor_px, motor_command_px : arrays, shape (frames, 2)
        By how much the siderostat does, from where it was first: truly, behind its backlash, and by
        its set-point.
    saturated : array of bool, shape (frames,)
    mode : array of str, shape (frames,)
    """

    time_s: Floats
    star_px: Floats
    measured_px: Floats
    target_px: Floats
    mirror_px: Floats
    mirror_command_px: Floats
    motor_px: Floats
    motor_command_px: Floats
    saturated: NDArray[np.bool_]
    mode: NDArray[np.str_]


class Held:
    """A simulated instrument that holds its star.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    seed : int
    history_s : float
        How long true positions are kept.

    Raises
    ------
    IdentifyError
        If it does not come to hold the star.
    """

    def __init__(self, rig: Rig, loop_name: str, seed: int, history_s: float) -> None:
        self.rig = rig
        self.simulation = Simulation(rig, seed, star_offset_px=_NEAR_PX, history_s=history_s)
        self._loop_name = loop_name
        self._plant = self.simulation.plants[loop_name]
        hold_on_simulation(self.simulation, loop_name, SETTLE_S)
        self._first_tick = len(self.simulation.ticks)
        self._start_s = self.simulation.clock.now_s()
        self._stages: list[tuple[float, Floats, Floats]] = []

    def run(self, duration_s: float) -> None:
        """Go on, and look at the plant's stages once a frame."""
        state, simulation = self._plant.state, self.simulation
        end_s = simulation.clock.now_s() + duration_s
        while simulation.clock.now_s() < end_s - 1e-9:
            simulation.supervisor.step()
            now_s = simulation.clock.now_s()
            self._plant.advance(now_s)
            self._stages.append(
                (now_s, state.displacement_m[0].copy(), state.beam_motor_rad[0].copy())
            )

    def star_jumps(self, px: Sequence[float]) -> None:
        """The star is elsewhere at once, shape (2,)."""
        self._plant.constants.spot_origin_px[:] += np.asarray(px)

    def target_jumps(self, px: Sequence[float]) -> None:
        """The star shall be held elsewhere: through the prefilter.

        Raises
        ------
        RuntimeError
            If the supervisor refuses.
        """
        settings = self.rig.stellar_loops[self._loop_name].target_px
        reply = self.simulation.command(
            SetTarget(loop=self._loop_name, az_px=settings.az + px[0], el_px=settings.el + px[1])
        )
        if not reply.accepted:
            raise RuntimeError(reply.text)

    def motion(self) -> Motion:
        """All since the motion's clock started."""
        loop = self.rig.stellar_loops[self._loop_name]
        scale = scales(self.rig, loop)
        frames = [
            tick
            for tick in self.simulation.ticks[self._first_tick :]
            if tick.loop == self._loop_name and tick.number >= 0
        ]
        tick = tick_columns(frames)
        exposed_s = tick["mid_exposure_s"]
        sampled_s = np.array([time_s for time_s, _, _ in self._stages])
        row = np.clip(np.searchsorted(sampled_s, exposed_s + 1e-6), 0, len(sampled_s) - 1)
        displacement_m = np.array([moved for _, moved, _ in self._stages])[row]
        beam_rad = np.array([beam for _, _, beam in self._stages])[row]
        mirror_rad = mirror_from_stacks(displacement_m, loop.fsm.stack_radius_m)
        setpoint_rad = axis_pair(tick, "siderostat_setpoint_{}_rad")
        return Motion(
            time_s=exposed_s - self._start_s,
            star_px=np.array([self._plant.spots_px(time_s)[0, 0] for time_s in exposed_s]),
            measured_px=axis_pair(tick, "star_{}_px"),
            target_px=axis_pair(tick, "target_{}_px"),
            mirror_px=scale.mirror_px(mirror_rad),
            mirror_command_px=scale.mirror_px(axis_pair(tick, "fsm_{}_rad")),
            motor_px=scale.motor_px(beam_rad - beam_rad[0]),
            motor_command_px=scale.motor_px(setpoint_rad - setpoint_rad[0]),
            saturated=tick["fsm_saturated"],
            mode=tick["mode"],
        )
