"""The rigs of the swarm: their loops and devices, and the settings by which runs differ."""

from __future__ import annotations

from random import Random

RIGS: dict[str, tuple[str, ...]] = {
    "fit-mock.toml": ("right",),
    "fit-testbed.toml": ("right", "metrology", "left"),
    "two-stars.toml": ("right", "left"),
    "ensemble.toml": ("right",),
    "fit-bal-analog.toml": ("right",),
}
"""Files in ``rigs/``, each with its loops."""
SETTINGS = (
    "service.lease_s=10.0",
    "logging.queue_records=200",
    "supervisor.telemetry_hz=20.0",
    "loops.right.acquisition.search_again_s=10.0",
    'interlocks.flux_low.action="freeze"',
    'interlocks.flux_low.action="flatten"',
)
"""Settings that some runs change."""
_SETTING = 0.15  # fraction of runs that change each of them
_HELD_SEARCH = 'interlocks.frame_age.modes=["ACQUISITION", "COARSE", "VERNIER"]'
_HELD_SEARCHES = 0.5  # fraction of runs in which late frames hold a search too
_SLOW_SERVO = {
    "servo.rate_hz": (100.0, 50.0),
    "servo.gain_per_s": (40.0, 15.0),
    "servo.following_error_limit_rad": (4.0, 10.0),
}
"""Settings of a siderostat whose servo runs at 100 or at 50 Hz instead of 500."""
SLOW = {"fit-mock.toml": 0.15, "two-stars.toml": 0.5, "fit-testbed.toml": 0.6}
"""Fraction of runs with slow servos. These runs also take less time."""
_FAST_FRAMES = (
    "camera.frame_rate_hz=500.0",
    "camera.exposure_s=0.001",
    "camera.frame_delay_s=0.0035",
)
FAST = {"fit-mock.toml": 0.1}
"""Fraction of runs with ten times as many frames; they last a third as long."""
_SEVERAL_WRITES = 0.15  # fraction of runs whose mirrors are written between frames
# Fraction of runs with each change of the sky, and of those that the rig file knows.
_SKY, _TOLD = 0.15, 0.5
_GUST_S = 6.0  # before a gust there is calm for so long, and it is shorter
PHOTON_NOISE = "camera.electrons_per_dn=1.0"


def slow_servos(rig: str, which: int) -> list[str]:
    """Settings that slow the servos of a rig's siderostats to 100 or 50 Hz."""
    return [
        f"loops.{loop}.siderostat.{key}={values[which]}"
        for loop in RIGS[rig]
        for key, values in _SLOW_SERVO.items()
    ] + [f"interlocks.following_error.high={(3.0, 8.0)[which]}"]


def stars_of(rig: str) -> list[str]:
    """The loops of a rig that point a star."""
    return [loop for loop in RIGS[rig] if loop != "metrology"]


def several_writes(rig: str) -> list[str]:
    """Settings with which a rig's mirrors are written several times a frame."""
    return [
        f"loops.{loop}.{key}"
        for loop in stars_of(rig)
        for key in ("fsm.dac.writes_per_frame=5", "vernier.controller=minimum-variance")
    ]


def learning(rig: str) -> list[str]:
    """Settings with which a rig's loops use learnt designs by themselves."""
    return [f'loops.{loop}.learn="on"' for loop in stars_of(rig)]


def vibration(frequency_hz: float, rms_px: float, direction_deg: float) -> str:
    """A vibration in the motion of a star, as the rig file has it."""
    return (
        f"{{frequency_hz={frequency_hz:.2f}, rms_px={rms_px:.3f}, direction_deg={direction_deg:.1f}, "
        "damping=0.01, drift_hz_per_min=0.0}"
    )


def drawn_vibration(random: Random, hz: tuple[float, float], rms_px: tuple[float, float]) -> str:
    """A vibration in any direction."""
    return vibration(random.uniform(*hz), random.uniform(*rms_px), random.uniform(0.0, 180.0))


def vibrating(rig: str, lines: str) -> list[str]:
    """Settings with a vibration in the motion of a rig's stars."""
    return [f"plant.loops.{loop}.lines=[{lines}]" for loop in stars_of(rig)]


def gusty(rig: str, gusts: list[tuple[float, float, str]], lines: str) -> list[str]:
    """Settings with gusts: from when to when the stars have which vibration instead of `lines`."""
    times = [
        change for begin_s, end_s, gust in gusts for change in ((begin_s, gust), (end_s, lines))
    ]
    changes = []
    for at_s, which in times:
        loops = ", ".join(f"{loop}={{lines=[{which}]}}" for loop in stars_of(rig))
        changes.append(f"{{at_s={at_s:.2f}, loops={{{loops}}}}}")
    return [f"plant.timeline=[{', '.join(changes)}]"]


def moving(rig: str, az_arcsec_s: float, el_arcsec_s: float, *, told: bool) -> list[str]:
    """Settings with stars that move by themselves, as the rig file knows if it is `told`.

    They begin nearer to the start, so that a search about the start finds them however long the run is.
    """
    rate = f"star_rate_sky_arcsec_s={{az={az_arcsec_s:.3f}, el={el_arcsec_s:.3f}}}"
    return [
        setting
        for loop in stars_of(rig)
        for setting in (
            f"plant.loops.{loop}.{rate}",
            f"plant.loops.{loop}.star_offset_sky_arcsec_max=150.0",
            *([f"loops.{loop}.{rate}"] if told else []),
        )
    ]


def with_another_spot(rig: str, *, told: bool) -> list[str]:
    """Settings with one more spot in the field of the only star of a rig, too dim for a star.

    On a rig with two stars it would interfere with the spots of the other one.
    """
    if len(stars_of(rig)) > 1:
        return []
    loop, fringe = stars_of(rig)[0], 'name="fringe", offset_px={az=-12.0, el=0.0}, flux_dn=11000.0'
    other = 'name="other", offset_px={az=10.0, el=9.0}, flux_dn=6000.0'
    star = 'name="pointing", offset_px={az=0.0, el=0.0}, flux_dn=28000.0'
    true = ", ".join(f"{{{spot}, diameter_px=3.0}}" for spot in (star, fringe, other))
    known = f"loops.{loop}.other_spots=[{{{fringe}}}, {{{other}}}]"
    return [f"plant.loops.{loop}.spots=[{true}]", *([known] if told else [])]


def drawn_sky(random: Random, rig: str, duration_s: float) -> list[str]:
    """Settings of the light and of the stars, most often none."""
    settings = [PHOTON_NOISE] if random.random() < _SKY else []
    lines = ""
    if random.random() < _SKY:
        lines = drawn_vibration(random, (1.0, 20.0), (0.02, 0.3))
        settings += vibrating(rig, lines)
    if random.random() < _SKY:
        settings += gusty(rig, drawn_gusts(random, duration_s), lines)
    if random.random() < _SKY:
        told = random.random() < _TOLD
        # Without being told, Eq. 20 has the mirror at its limit from 0.3 arcsec/s on.
        most_arcsec_s = 0.3 if told else 0.15
        az_arcsec_s, el_arcsec_s = (random.uniform(-most_arcsec_s, most_arcsec_s) for _ in range(2))
        settings += moving(rig, az_arcsec_s, el_arcsec_s, told=told)
    if random.random() < _SKY:
        settings += with_another_spot(rig, told=random.random() < _TOLD)
    return settings


def drawn_gusts(random: Random, duration_s: float) -> list[tuple[float, float, str]]:
    """From when to when each lasts, and its vibration, which brings mirrors to the limit of their range."""
    gusts, at_s = [], 0.0
    while (at_s := at_s + random.uniform(_GUST_S, duration_s / 2)) < duration_s - _GUST_S:
        gust = drawn_vibration(random, (0.5, 5.0), (1.0, 10.0))
        gusts.append((at_s, at_s + random.uniform(0.2, 0.9 * _GUST_S), gust))
    return gusts


def devices_of(rig: str) -> list[str]:
    """The devices of a rig."""
    devices = ["camera"]
    for loop in RIGS[rig]:
        sensors = ("photodiodes",) if loop == "metrology" else ("D/A", "piezo")
        devices += [f"{loop} {what}" for what in ("siderostat", *sensors)]
    return [*devices, "hexapod"] if "metrology" in RIGS[rig] else devices


def drawn_settings(random: Random, rig: str, duration_s: float, *, fast: bool) -> list[str]:
    """What a run of this duration changes of its rig; with `fast` frames or without."""
    # At the rig's own rate, telemetry takes a tenth of the run's time.
    settings = ["supervisor.telemetry_hz=5.0"]
    settings += [text for text in SETTINGS if random.random() < _SETTING]
    settings += [_HELD_SEARCH] * (random.random() < _HELD_SEARCHES)
    if fast:
        settings += _FAST_FRAMES
    elif random.random() < SLOW.get(rig, 0.0):
        settings += slow_servos(rig, random.randrange(2))
    if not fast and random.random() < _SEVERAL_WRITES:
        settings += several_writes(rig)
    return settings + drawn_sky(random, rig, duration_s)
