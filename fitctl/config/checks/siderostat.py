"""Siderostats: the position servo, the travel, and what amplifiers and buses can do."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

from fitctl.config.conflict import Conflict, Part, at_least, at_most
from fitctl.config.devices import AnySiderostat, BalAnalogDevice, Cia402Device
from fitctl.config.rig import Rig

_LARGEST_SERVO_STEP = 0.4  # part of an error that one servo period may take back, with its latency
_INT32 = 2**31 - 1  # object 6064
_HALF_COUNTER = 32_767  # of the station's 16 bits
_BEATS_MISSED = 3  # within master_heartbeat_timeout_s; each waits for a servo period
_MASTER_NODE = 127  # fitctl's own heartbeat has this node id
_SYNC_BITS, _PDO_BITS = 47, 111  # of a frame with no and with eight bytes, without stuffed bits
REGISTERS = 3  # of a station's outputs, and of its inputs
_NEARLY = 1 + 1e-9  # limits that are meant to be equal, after a multiplication


def siderostat_conflicts(rig: Rig) -> Iterator[Conflict]:
    """Of each loop's siderostat, and of drives that share a bus."""
    for name, loop in rig.loops.items():
        key = f"loops.{name}.siderostat"
        siderostat = loop.siderostat
        found = [*_servo(siderostat), *_travel(siderostat), *_amplifiers(siderostat)]
        for conflict in found:
            yield conflict.under(key)
        radius = loop.acquisition.search_radius_sky_arcsec
        travel = siderostat.travel_sky_arcsec
        if radius > travel * _NEARLY:
            yield Conflict(
                "the siderostat stops at its travel, so the search would never see the rest",
                (
                    at_most(f"loops.{name}.acquisition.search_radius_sky_arcsec", radius, travel),
                    at_least(f"{key}.travel_sky_arcsec", travel, radius),
                ),
            )
    yield from _can_buses(rig)


def _servo(siderostat: AnySiderostat) -> Iterator[Conflict]:
    servo = siderostat.servo
    gain, rate_hz = servo.gain_per_s, servo.rate_hz
    if gain / rate_hz > _LARGEST_SERVO_STEP:
        yield Conflict(
            "the servo would swing",
            (
                at_most("servo.gain_per_s", gain, _LARGEST_SERVO_STEP * rate_hz),
                at_least("servo.rate_hz", rate_hz, gain / _LARGEST_SERVO_STEP),
            ),
        )
    limit_rad, velocity = servo.following_error_limit_rad, siderostat.velocity_limit_rad_s
    if velocity / gain > limit_rad:
        yield Conflict(
            f"at full speed the motors stay {velocity / gain:.4g} rad behind, which would be a fault",
            (
                at_least("servo.following_error_limit_rad", limit_rad, velocity / gain),
                at_most("velocity_limit_rad_s", velocity, limit_rad * gain),
                at_least("servo.gain_per_s", gain, velocity / limit_rad),
            ),
        )
    if servo.reading_timeout_s < 2 / rate_hz:
        yield Conflict(
            "an encoder is read once a servo period, so every reading would be a fault",
            (
                at_least("servo.reading_timeout_s", servo.reading_timeout_s, 2 / rate_hz),
                at_least("servo.rate_hz", rate_hz, 2 / servo.reading_timeout_s),
            ),
        )


def _travel(siderostat: AnySiderostat) -> Iterator[Conflict]:
    backlash, travel = siderostat.backlash_sky_arcsec, siderostat.travel_sky_arcsec
    if backlash is not None and backlash >= travel:
        yield Conflict(
            "the play is a small part of the travel",
            (
                Part("backlash_sky_arcsec", backlash, f"below {travel:g}"),
                Part("travel_sky_arcsec", travel, f"above {backlash:g}"),
            ),
        )
    device, travel_rad = siderostat.device, siderostat.travel_rad
    if isinstance(device, Cia402Device) and 0 < device.position_limit_rad < travel_rad:
        limit_rad = device.position_limit_rad
        yield Conflict(
            f"the travel is {travel_rad:.4g} rad of the motors, beyond the drive's own limit",
            (
                at_most("travel_sky_arcsec", travel, travel * limit_rad / travel_rad),
                at_least("device.position_limit_rad", limit_rad, travel_rad),
                *_geometry(siderostat, limit_rad / travel_rad),
            ),
        )
    if isinstance(device, Cia402Device):
        limit_rad = device.position_limit_rad
        counts = limit_rad / siderostat.encoder_count_rad
        if counts > _INT32:
            per_rev = siderostat.encoder_counts_per_rev
            yield Conflict(
                f"the drive's own limit would be {counts:.0f} counts, and it counts to {_INT32}",
                (
                    at_most("device.position_limit_rad", limit_rad, limit_rad * _INT32 / counts),
                    at_most(
                        "encoder_counts_per_rev", per_rev, math.floor(per_rev * _INT32 / counts)
                    ),
                ),
            )
    counts = travel_rad / siderostat.encoder_count_rad
    of_driver: dict[type, float] = {Cia402Device: _INT32, BalAnalogDevice: _HALF_COUNTER}
    most = of_driver.get(type(device), math.inf)
    if counts > most:
        fits = most / counts
        yield Conflict(
            f"the travel is {counts:.0f} counts, and the encoder's counter has {most} either way",
            (
                at_most("travel_sky_arcsec", travel, travel * fits),
                at_most(
                    "encoder_counts_per_rev",
                    siderostat.encoder_counts_per_rev,
                    math.floor(siderostat.encoder_counts_per_rev * fits),
                ),
                *_geometry(siderostat, fits),
            ),
        )


def _geometry(siderostat: AnySiderostat, fits: float) -> tuple[Part, ...]:
    """The keys of the gear train, where the motors' travel may be `fits` of what it is."""
    screw = siderostat.ball_screw_m_per_rad
    return (
        at_most("spur_gear_ratio", siderostat.spur_gear_ratio, siderostat.spur_gear_ratio * fits),
        at_most("lever_arm_m", siderostat.lever_arm_m, siderostat.lever_arm_m * fits),
        at_least("ball_screw_m_per_rad", screw, screw / fits),
    )


def _amplifiers(siderostat: AnySiderostat) -> Iterator[Conflict]:
    device, velocity = siderostat.device, siderostat.velocity_limit_rad_s
    rate_hz = siderostat.servo.rate_hz
    if isinstance(device, Cia402Device):
        timeout_s = device.master_heartbeat_timeout_s
        if timeout_s < _BEATS_MISSED / rate_hz:
            yield Conflict(
                "fitctl sends its heartbeat at the servo's rate, so the drive would stop",
                (
                    at_least(
                        "device.master_heartbeat_timeout_s", timeout_s, _BEATS_MISSED / rate_hz
                    ),
                    at_least("servo.rate_hz", rate_hz, _BEATS_MISSED / timeout_s),
                ),
            )
    if isinstance(device, BalAnalogDevice):
        yield from _analogue(device, velocity)


def _analogue(device: BalAnalogDevice, velocity: float) -> Iterator[Conflict]:
    for axis in ("az", "el"):
        by_volt = getattr(device.velocity_rad_s_per_v, axis)
        most = device.full_scale_v * abs(by_volt)
        if velocity > most * _NEARLY:
            needed = velocity / device.full_scale_v
            yield Conflict(
                f"the output of {device.full_scale_v:g} V commands {most:.4g} rad/s",
                (
                    at_most("velocity_limit_rad_s", velocity, most),
                    _velocity_by_volt(axis, by_volt, needed),
                    at_least("device.full_scale_v", device.full_scale_v, velocity / abs(by_volt)),
                ),
            )
    apart = abs(device.first_output_register - device.first_input_register)
    if apart < REGISTERS:
        first = device.first_output_register
        yield Conflict(
            f"three registers of outputs and three of inputs would overlap from {first}",
            (
                Part(
                    "device.first_input_register", device.first_input_register, _apart_from(first)
                ),
                Part(
                    "device.first_output_register", first, _apart_from(device.first_input_register)
                ),
            ),
        )


def _apart_from(first: int) -> str:
    return f"at least {REGISTERS} from {first}"


def _velocity_by_volt(axis: str, by_volt: float, needed: float) -> Part:
    key = f"device.velocity_rad_s_per_v.{axis}"
    if by_volt > 0:
        return at_least(key, by_volt, needed)
    return Part(key, by_volt, at_least(key, -by_volt, needed).must_be.replace("least ", "most -"))


def _can_buses(rig: Rig) -> Iterator[Conflict]:
    """Drives on one bus: each has a node id of its own, and all have one bit rate and one servo rate."""
    for drives in rig.can_buses:
        keys = {name: f"loops.{name}.siderostat" for name in drives}
        first, *others = drives
        nodes: dict[int, str] = {}
        for name, drive in drives.items():
            node = drive.node_id
            other = nodes.setdefault(node, name)
            if other != name:
                yield Conflict(
                    "each drive on a CAN bus has a node id of its own",
                    tuple(
                        Part(f"{keys[one]}.device.node_id", node, "another node id")
                        for one in (name, other)
                    ),
                )
            if node == _MASTER_NODE and others:
                part = Part(f"{keys[name]}.device.node_id", node, f"below {_MASTER_NODE}")
                yield Conflict(
                    "on a bus with several drives, that is fitctl's own node id", (part,)
                )
        rates = {name: rig.loops[name].siderostat.servo.rate_hz for name in drives}
        bitrates = {name: drive.bitrate for name, drive in drives.items()}
        same: tuple[tuple[str, Mapping[str, float]], ...] = (
            ("device.bitrate", bitrates),
            ("servo.rate_hz", rates),
        )
        for (key, values), name in itertools.product(same, others):
            if values[name] != values[first]:
                yield Conflict(
                    "one bit rate and one SYNC are for all drives on a CAN bus",
                    tuple(
                        Part(f"{keys[one]}.{key}", values[one], f"{values[another]:.10g}")
                        for one, another in ((name, first), (first, name))
                    ),
                )
        yield from _can_load(keys[first], len(drives), bitrates[first], rates[first])


def _can_load(key: str, drives: int, bitrate: int, rate_hz: float) -> Iterator[Conflict]:
    """A SYNC, and two frames of each drive, must pass in a servo period."""
    bits = _SYNC_BITS + 2 * _PDO_BITS * drives
    if bits * rate_hz > bitrate:
        yield Conflict(
            f"the bus carries at least {bits} bits a servo period, a SYNC and two frames of each drive",
            (
                Part(f"{key}.device.bitrate", bitrate, _bitrates(bits * rate_hz)),
                at_most(f"{key}.servo.rate_hz", rate_hz, bitrate / bits),
            ),
        )


def _bitrates(needed: float) -> str:
    allowed: tuple[Any, ...] = Cia402Device.model_fields["bitrate"].annotation.__args__  # pyrefly: ignore[missing-attribute]
    return " or ".join(str(one) for one in allowed if one >= needed)
