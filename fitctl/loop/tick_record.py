"""The record of a tick: names, times and numbers as they are logged."""

from __future__ import annotations

import math
from typing import NamedTuple

from fitctl.config import Rig
from fitctl.drivers.interface import NO_READING
from fitctl.logging.records import Tick
from fitctl.loop.observation import Observation
from fitctl.loop.pointing import Pointing
from fitctl.loop.search.spiral import SpiralSearch
from fitctl.messages.modes import Mode
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.siderostat import SiderostatStage


class TickTimes(NamedTuple):
    """When the star was measured, when it was decided what to do, and when that was confirmed, in s."""

    sensed_s: float
    decided_s: float
    done_s: float


class TickRecords:
    """Makes one loop's.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        loop = rig.stellar_loops[loop_name]
        self._loop_name = loop_name
        self._due_after_s = rig.camera.frame_delay_s + rig.supervisor.late_tick_s
        self._range_rad = loop.fsm.range_rad
        self._sky_arcsec_per_rad = loop.siderostat.sky_arcsec_per_motor_rad

    def make(
        self,
        mode: Mode,
        observation: Observation,
        siderostat: SiderostatStage,
        mirror: MirrorStage,
        pointing: Pointing,
        search: SpiralSearch,
        times: TickTimes,
        *,
        held: bool,
    ) -> Tick:
        """What a tick was decided by, and what it did; `held` if it kept the stages where they are."""
        sensed_s, decided_s, done_s = times
        frame, star, servo = observation.frame, observation.star, observation.servo
        begun_s, sky_arcsec_per_rad = observation.now_s, self._sky_arcsec_per_rad
        read_s, (encoder_az_rad, encoder_el_rad), *_ = servo.reading or NO_READING
        exposed_s = math.nan if frame is None else frame.mid_exposure_s
        star_az_px, star_el_px = (math.nan, math.nan) if star is None else star[:2]
        target_az_px, target_el_px = pointing.command_px
        fsm_az_rad, fsm_el_rad = mirror.command_rad.tolist()
        stack1_v, stack2_v, stack3_v = mirror.stack_v.tolist()
        motor_az_rad, motor_el_rad = observation.motor_rad.tolist()
        mirror_az_rad, mirror_el_rad = observation.mirror_rad.tolist()
        setpoint_az_rad, setpoint_el_rad = siderostat.setpoint_rad.tolist()
        link_rad, sky_rad = observation.link_motor_rad, observation.sky_rad
        link_az_rad, link_el_rad = (math.nan, math.nan) if link_rad is None else link_rad.tolist()
        sky_az_rad, sky_el_rad = (math.nan, math.nan) if sky_rad is None else sky_rad.tolist()
        return Tick(
            time_s=done_s,
            loop=self._loop_name,
            number=-1 if frame is None else frame.number,
            mode=mode.name,
            mode_number=int(mode),
            mid_exposure_s=exposed_s,
            frame_age_s=math.nan if frame is None else frame.received_s - exposed_s,
            compute_s=done_s - begun_s,
            late=frame is not None and done_s - exposed_s > self._due_after_s,
            frames_lost=observation.frames_lost,
            star_visible=star is not None,
            star_az_px=star_az_px,
            star_el_px=star_el_px,
            star_flux_dn=math.nan if star is None else star.flux_dn,
            window_az_px=-1 if star is None else star.window_az_px,
            window_el_px=-1 if star is None else star.window_el_px,
            target_az_px=target_az_px,
            target_el_px=target_el_px,
            error_az_px=star_az_px - target_az_px,
            error_el_px=star_el_px - target_el_px,
            fsm_az_rad=fsm_az_rad,
            fsm_el_rad=fsm_el_rad,
            fsm_range_fraction=(abs(fsm_az_rad) + abs(fsm_el_rad)) / self._range_rad,
            fsm_saturated=mode is Mode.VERNIER and pointing.saturated,
            stack1_v=stack1_v,
            stack2_v=stack2_v,
            stack3_v=stack3_v,
            siderostat_az_rad=motor_az_rad,
            siderostat_el_rad=motor_el_rad,
            siderostat_setpoint_az_rad=setpoint_az_rad,
            siderostat_setpoint_el_rad=setpoint_el_rad,
            siderostat_az_sky_arcsec=motor_az_rad * sky_arcsec_per_rad,
            siderostat_el_sky_arcsec=motor_el_rad * sky_arcsec_per_rad,
            search_progress=search.progress if mode is Mode.ACQUISITION else math.nan,
            fsm_written_s=mirror.written_s,
            dac_round_trip_s=mirror.round_trip_s,
            amplifier_round_trip_s=servo.round_trip_s,
            following_error_rad=servo.following_rad,
            encoder_read_s=read_s,
            encoder_az_rad=encoder_az_rad,
            encoder_el_rad=encoder_el_rad,
            sense_s=sensed_s - begun_s,
            decide_s=decided_s - sensed_s,
            dac_sent_s=mirror.sent_s,
            frames_skipped=observation.frames_skipped,
            link_az_rad=link_az_rad,
            link_el_rad=link_el_rad,
            star_sigma_az_px=math.nan if star is None else star.sigma_az_px,
            star_sigma_el_px=math.nan if star is None else star.sigma_el_px,
            mirror_az_rad=mirror_az_rad,
            mirror_el_rad=mirror_el_rad,
            sky_az_rad=sky_az_rad,
            sky_el_rad=sky_el_rad,
            held=held,
        )
