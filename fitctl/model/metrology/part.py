"""One metrology loop's hardware: a siderostat's motors -> backlash -> laser beam -> place on the photodiodes.

``p = L (beta + air) - x``: the beam's angle and the air of the path over the length of the link, less the
displacement of the array.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD, AirPath, LinkAir, MetrologyPlant, Rig
from fitctl.model.compiled import compilable, compiled, numba_installed
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.metrology.photodiodes import diode_volts
from fitctl.model.optics import rotation, turned
from fitctl.model.plant_constants import AirConstants, air_constants
from fitctl.model.plant_step import step_motor
from fitctl.model.randomness import disc_place, run_randomness
from fitctl.model.timeline import Air, Part, Timeline

Floats = NDArray[np.float64]
_ROW = np.dtype(
    [
        ("motor_rad", "f8", (2,)),
        ("motor_rad_s", "f8", (2,)),
        ("beam_motor_rad", "f8", (2,)),
        ("velocity_rad_s", "f8", (2,)),
    ]
)

BEAM_CONSTANTS = np.dtype(
    [
        ("step_s", "f8"),
        ("amplifier_decay", "f8"),
        ("amplifier_lag_s", "f8"),
        ("backlash_half_rad", "f8"),
        ("sky_rad_per_motor_rad", "f8"),
        ("turn", "f8", (2, 2)),
    ]
)
"""What of :class:`BeamConstants` compiled code needs."""


class BeamConstants(NamedTuple):
    """Numbers of one step."""

    step_s: float
    amplifier_decay: float
    amplifier_lag_s: float
    backlash_half_rad: float
    sky_rad_per_motor_rad: float
    turn: Floats
    air: AirConstants

    @property
    def packed(self) -> NDArray[np.void]:
        """All of it but the air, for compiled code; shape (1,)."""
        made = np.zeros(1, BEAM_CONSTANTS)
        for name in BEAM_CONSTANTS.names or ():
            made[name] = getattr(self, name)
        return made


def beam_constants(rig: Rig, loop_name: str) -> BeamConstants:
    """Numbers of one step of a rig's metrology loop."""
    truth, _ = rig.mock_parts()
    plant = truth.metrology_loops[loop_name]
    siderostat = rig.metrology_loops[loop_name].siderostat
    lag_s = 1 / (2 * np.pi * plant.amplifier_bandwidth_hz)
    motor_sky = siderostat.sky_rad_per_motor_rad
    return BeamConstants(
        step_s=truth.step_s,
        amplifier_decay=float(np.exp(-truth.step_s / lag_s)),
        amplifier_lag_s=lag_s,
        backlash_half_rad=plant.backlash_sky_arcsec / ARCSEC_PER_RAD / motor_sky / 2,
        sky_rad_per_motor_rad=motor_sky,
        turn=rotation(siderostat.rotation_deg),
        air=air_constants(_filter(plant.air_path), truth.step_s),
    )


def misalignment_rad(plant: MetrologyPlant, random: np.random.Generator) -> Floats:
    """Where the beam goes with the motors at zero, uniform over the disc of the rig's largest, shape (2,)."""
    return disc_place(plant.beam_offset_sky_arcsec_max / ARCSEC_PER_RAD, random)


class BeamState:
    """What the siderostat remembers, and the inputs; the run axis is first.

    Attributes
    ----------
    motor_rad, motor_rad_s : shape (runs, 2)
        Motor angles and rates.
    beam_motor_rad : shape (runs, 2)
        Motor angles as the siderostat's mirror shows them, behind the backlash.
    velocity_rad_s : shape (runs, 2)
        An input: motor velocities.
    laser : shape (runs,)
        An input: power of the laser over its nominal power.
    rows : structured array, shape (runs,)
        All of it but the laser.
    """

    def __init__(self, runs: int) -> None:
        self.rows = np.zeros(runs, _ROW)
        self.motor_rad = self.rows["motor_rad"]
        self.motor_rad_s = self.rows["motor_rad_s"]
        self.beam_motor_rad = self.rows["beam_motor_rad"]
        self.velocity_rad_s = self.rows["velocity_rad_s"]
        self.laser = np.ones(runs)


@compilable(fused=True)
def turn_beam(constants: Any, state: Any, misaligned_rad: Floats, beam_rad: Floats) -> None:
    """Advance the siderostats of all runs, a step for each row of `beam_rad`, shape (rows, runs, 2).

    `misaligned_rad`, shape (runs, 2), is where the beam goes with the motors at zero.
    """
    c = constants[0]
    decay, half = c.amplifier_decay, c.backlash_half_rad
    catch_up_s = c.amplifier_lag_s * (1 - decay)
    for run in range(beam_rad.shape[1]):
        s = state[run]
        for axis in range(2):
            command = s.velocity_rad_s[axis]
            moved = command * c.step_s
            motor, lead = s.motor_rad[axis], s.motor_rad_s[axis] - command
            beam = s.beam_motor_rad[axis]
            for row in range(beam_rad.shape[0]):
                motor, lead, beam = step_motor(motor, lead, beam, moved, catch_up_s, decay, half)
                beam_rad[row, run, axis] = c.sky_rad_per_motor_rad * beam
            s.motor_rad[axis], s.motor_rad_s[axis] = motor, command + lead
            s.beam_motor_rad[axis] = beam
        for row in range(beam_rad.shape[0]):
            az, el = turned(c.turn, beam_rad[row, run, 0], beam_rad[row, run, 1])
            beam_rad[row, run, 0] = az + misaligned_rad[run, 0]
            beam_rad[row, run, 1] = el + misaligned_rad[run, 1]


class MetrologyPart(Part):
    """The hardware of one metrology loop for a batch of runs.

    Parameters
    ----------
    timeline : Timeline
    rig : Rig
        Must have its ``plant`` section.
    loop_name : str
    seeds : sequence of int
        One for each run; everything random in a run follows from its seed.
    collector : CollectorPart, optional
        Carries the photodiodes; without, they stand still.

    Attributes
    ----------
    beam_rad : array, shape (block_steps, runs, 2)
        Angle of the beam on the sky after each step, over and over again.
    misaligned_rad : array, shape (runs, 2)
        Where the beam goes with the motors at zero.
    noise_keys : list of int
        Of the photodiodes' noise, by :mod:`fitctl.model.image.pixel_noise`, one for each run.
    """

    def __init__(
        self,
        timeline: Timeline,
        rig: Rig,
        loop_name: str,
        seeds: Sequence[int],
        *,
        collector: CollectorPart | None = None,
    ) -> None:
        super().__init__(timeline)
        truth, _ = rig.mock_parts()
        plant = truth.metrology_loops[loop_name]
        runs, streams = len(seeds), [run_randomness(seed, 1) for seed in seeds]
        self.seeds = tuple(seeds)
        self.sensor = plant.sensor
        self.noise_keys = [stream.pixels for stream in streams]
        self.misaligned_rad = np.array([misalignment_rad(plant, s.place) for s in streams])
        self.constants = beam_constants(rig, loop_name)
        self.state = BeamState(runs)
        self._air_rad = np.empty((timeline.block_steps, runs, 1, 2))
        self._air = Air(
            [(0, self.constants.air)], [stream.air for stream in streams], self._air_rad
        )
        self._collector = collector
        self.beam_rad = np.empty((timeline.block_steps, runs, 2))
        self._offsets_m = np.empty((timeline.kept, runs, 2))
        self._turn_beam = compiled(turn_beam)
        self._rows: Any = self.state.rows
        self._constant_rows: Any = self.constants.packed
        if not numba_installed():
            names = _ROW.names or ()
            self._rows = [SimpleNamespace(**{n: row[n] for n in names}) for row in self.state.rows]
            self._constant_rows = [self.constants]

    @property
    def inputs(self) -> BeamState:
        """Where the devices act: its `velocity_rad_s` and `laser`, written in place."""
        return self.state

    def begin_block(self) -> None:
        """Draw the air path."""
        self._air.draw()

    def step(self, first: int, steps: int) -> None:
        """Go on by some steps."""
        row = first % len(self.beam_rad)
        rows = slice(row, row + steps)
        beam_rad = self.beam_rad[rows]
        self._turn_beam(self._constant_rows, self._rows, self.misaligned_rad, beam_rad)
        kept = first % len(self._offsets_m)
        offset_m = self.sensor.link_length_m * (beam_rad + self._air_rad[rows, :, 0])
        if self._collector is not None:
            offset_m -= self._collector.array_m[rows, None, :]
        self._offsets_m[kept : kept + steps] = offset_m

    def offset_m(self, time_s: float) -> Floats:
        """Centre of the beam from the centre of the array at the grid time nearest, shape (runs, 2).

        Raises
        ------
        ValueError
            If that is before what the history still holds.
        """
        return self._offsets_m[self._timeline.row(time_s)]

    def history_offset_m(self, start_s: float, end_s: float) -> Floats:
        """All of them from `start_s` to `end_s` on the grid, shape (steps, runs, 2)."""
        return self._offsets_m[self._timeline.rows(start_s, end_s)]

    def diode_volts(self, time_s: float) -> Floats:
        """Volts of the photodiodes then, without noise, with the laser as it is now, shape (runs, 4)."""
        return diode_volts(self.sensor, self.offset_m(time_s), self.state.laser)


def _filter(air: LinkAir) -> AirPath:
    """Eq. 8 with radians in the place of pixels: its motion has the variance gain^2 / (2 b2)."""
    gain_rad = air.rms_sky_arcsec / ARCSEC_PER_RAD * float(np.sqrt(2 * air.b2_s))
    return AirPath(gain_px=gain_rad, b1_s2=air.b1_s2, b2_s=air.b2_s, relative_rms_px=0.0)
