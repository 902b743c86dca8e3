"""What finds and holds a star or a beam: search, hand-over, integrators and designs, by the camera's time."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fitctl.config.conflict import Conflict, Part, at_least, at_most
from fitctl.config.loops import Loop
from fitctl.config.metrology import MetrologyLoop
from fitctl.config.rig import Rig

_UNSTABLE_RAD = (
    math.pi / 2
)  # phase lag at which an integrator with a delay begins to swing by itself


def pointing_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of each loop's acquisition and control."""
    for name, loop in rig.loops.items():
        yield from _confirmation(rig, f"loops.{name}.acquisition", loop)
    for name, loop in rig.stellar_loops.items():
        yield from _light(f"loops.{name}", loop)
        yield from _star_rate(f"loops.{name}", loop)
        yield from _coarse(rig, f"loops.{name}", loop)
        yield from _designs(rig, f"loops.{name}.vernier", loop)
    for name, metrology in rig.metrology_loops.items():
        yield from _beam(rig, f"loops.{name}", metrology)


def _confirmation(rig: Rig, key: str, loop: Loop | MetrologyLoop) -> Iterator[Conflict]:
    acquisition, camera = loop.acquisition, rig.camera
    needed_s = acquisition.found_frames * camera.period_s + camera.frame_delay_s
    if acquisition.confirm_timeout_s < needed_s:
        frames_s = acquisition.confirm_timeout_s - camera.frame_delay_s
        frames = math.floor(frames_s / camera.period_s)
        delay_s = acquisition.confirm_timeout_s - acquisition.found_frames * camera.period_s
        yield Conflict(
            f"found_frames frames and the camera's delay take {needed_s:.4g} s",
            (
                at_least(f"{key}.confirm_timeout_s", acquisition.confirm_timeout_s, needed_s),
                Part(
                    f"{key}.found_frames",
                    acquisition.found_frames,
                    f"at most {frames}" if frames > 0 else "",
                ),
                Part(
                    "camera.frame_delay_s",
                    camera.frame_delay_s,
                    at_most("", 0.0, delay_s).must_be if delay_s > 0 else "",
                ),
                Part(
                    "camera.frame_rate_hz",
                    camera.frame_rate_hz,
                    at_least("", 0.0, acquisition.found_frames / frames_s).must_be
                    if frames_s > 0
                    else "",
                ),
            ),
        )


def _light(key: str, loop: Loop) -> Iterator[Conflict]:
    low, high = loop.flux_range.low, loop.flux_range.high
    why = "flux_range is in parts of star_flux_dn and must include 1, the star itself"
    if low >= 1:
        yield Conflict(why, (Part(f"{key}.flux_range.low", low, "below 1"),))
    if high <= 1:
        yield Conflict(why, (Part(f"{key}.flux_range.high", high, "above 1"),))


def _star_rate(key: str, loop: Loop) -> Iterator[Conflict]:
    """A star that moves by itself needs motors as quick as it is."""
    rate, siderostat = loop.star_rate_sky_arcsec_s, loop.siderostat
    if rate is None:
        return
    which = "az" if abs(rate.az) >= abs(rate.el) else "el"
    arcsec_s = getattr(rate, which)
    needed_rad_s = abs(arcsec_s) / siderostat.sky_arcsec_per_motor_rad
    limit_rad_s = siderostat.velocity_limit_rad_s
    if needed_rad_s > limit_rad_s:
        whole = math.floor(limit_rad_s * siderostat.sky_arcsec_per_motor_rad)
        must_be = f"at most {whole}" if arcsec_s > 0 else f"at least {-whole}"
        yield Conflict(
            f"the siderostat cannot follow so fast a star: its motors reach {whole} arcsec/s",
            (
                Part(f"{key}.star_rate_sky_arcsec_s.{which}", arcsec_s, must_be),
                at_least(f"{key}.siderostat.velocity_limit_rad_s", limit_rad_s, needed_rad_s),
            ),
        )


def _coarse(rig: Rig, key: str, loop: Loop) -> Iterator[Conflict]:
    """The siderostat's integrator acts on an error that is a delay and, on average, half a frame old."""
    camera, optics, siderostat = rig.camera, rig.optics, loop.siderostat
    focal_m_by_motor = (
        siderostat.sky_rad_per_motor_rad * optics.compressor_ratio * optics.focal_length_m
    )
    gain = loop.coarse.gain_rad_per_m
    crossover_rad_s = gain * focal_m_by_motor
    lag_s = camera.frame_delay_s + camera.period_s / 2
    fits = _UNSTABLE_RAD / (crossover_rad_s * lag_s)
    if fits < 1:
        keyed = f"{key}.siderostat"
        screw, gears = siderostat.ball_screw_m_per_rad, siderostat.spur_gear_ratio
        delay_s = _UNSTABLE_RAD / crossover_rad_s - camera.period_s / 2
        yield Conflict(
            f"the coarse loop would swing by itself: it removes {crossover_rad_s:.4g} of an error each second, "
            f"{lag_s:.4g} s late",
            (
                at_most(f"{key}.coarse.gain_rad_per_m", gain, gain * fits),
                at_most("camera.frame_delay_s", camera.frame_delay_s, delay_s),
                at_most(f"{keyed}.ball_screw_m_per_rad", screw, screw * fits),
                at_least(f"{keyed}.spur_gear_ratio", gears, gears / fits),
                at_least(f"{keyed}.lever_arm_m", siderostat.lever_arm_m, siderostat.lever_arm_m / fits),
                at_most("optics.focal_length_m", optics.focal_length_m, optics.focal_length_m * fits),
                at_most(
                    "optics.compressor_ratio", optics.compressor_ratio, optics.compressor_ratio * fits
                ),
            ),
        )  # fmt: skip


def _designs(rig: Rig, key: str, loop: Loop) -> Iterator[Conflict]:
    """No design works beyond half the frame rate."""
    rate_hz = rig.camera.frame_rate_hz
    vernier = loop.vernier
    for name, value, by_hz in (
        ("fslq.crossover_hz", vernier.fslq.crossover_hz, 1.0),
        ("lqg_ltr.omega_n_rad_s", vernier.lqg_ltr.omega_n_rad_s, 2 * math.pi),
        ("lqg_ltr.omega_notch_rad_s", vernier.lqg_ltr.omega_notch_rad_s, 2 * math.pi),
        ("minimum_variance.offload_per_s", vernier.minimum_variance.offload_per_s, 2 * math.pi),
    ):
        if value / by_hz > rate_hz / 2:
            yield Conflict(
                "nothing can be controlled above half the frame rate",
                (
                    at_most(f"{key}.{name}", value, by_hz * rate_hz / 2),
                    at_least("camera.frame_rate_hz", rate_hz, 2 * value / by_hz),
                ),
            )


def _beam(rig: Rig, key: str, loop: MetrologyLoop) -> Iterator[Conflict]:
    sensor = loop.sensor
    if sensor.saturated_v > sensor.device.range_v:
        yield Conflict(
            "the inputs end at range_v, so a saturated photodiode would go unnoticed",
            (
                at_most(f"{key}.sensor.saturated_v", sensor.saturated_v, sensor.device.range_v),
                at_least(f"{key}.sensor.device.range_v", sensor.device.range_v, sensor.saturated_v),
            ),
        )
    hertz = loop.hold.crossover_hz
    lag_s = sensor.link_delay_s + rig.camera.period_s / 2
    most_hz = _UNSTABLE_RAD / (2 * math.pi * lag_s)
    if hertz > most_hz:
        yield Conflict(
            f"the hold would swing by itself: it acts {lag_s:.4g} s late",
            (
                at_most(f"{key}.hold.crossover_hz", hertz, most_hz),
                at_most(
                    f"{key}.sensor.link_delay_s",
                    sensor.link_delay_s,
                    _UNSTABLE_RAD / (2 * math.pi * hertz) - rig.camera.period_s / 2,
                ),
            ),
        )
