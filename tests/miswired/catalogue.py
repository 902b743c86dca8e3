"""Rigs that are wired wrongly: what is wrong, what must be made of it, and how far anything may move."""

from typing import Any, NamedTuple

SIDEROSTAT = "loops.right.siderostat"
WIRING = f"{SIDEROSTAT}.wiring"
MOCKS = "mocks.loops.right"
TESTBED = "fit-testbed.toml"
ENSEMBLE, BAL = "ensemble.toml", "fit-bal-analog.toml"
CIA402 = "fit-mock.toml"


class Entry(NamedTuple):
    """A rig that is wired wrongly.

    Attributes
    ----------
    name : str
        What is wrong.
    group : str
        Under which heading the document has it.
    wrong : tuple of str
        Settings of the mocks, which the rig file does not know of.
    step : str
        The last step that is needed.
    found : dict
        What the rig file must get, by key; empty where it cannot be put right.
    named : str
        What the message must contain.
    most_rad : float
        How far a motor may turn until then.
    most_v : float
        How far a stack may go from where it was, at the D/A.
    rig : str
    only : tuple of str
        In place of everything up to `step`, these steps.
    loop : str
        Whose motions are watched.
    exchanged : tuple of str
        Two keys of the rig file that have each other's address.
    rewritten : tuple of str
        A line of the rig file, and the wrong one in its place.
    skipped : tuple of str
        Steps that other entries prove.
    most_s : float
        How long the whole entry may take.
    """

    name: str
    group: str
    wrong: tuple[str, ...]
    step: str
    found: dict[str, Any] = {}  # noqa: RUF012
    named: str = ""
    most_rad: float = 0.05
    most_v: float = 0.35
    rig: str = CIA402
    only: tuple[str, ...] = ()
    loop: str = "right"
    exchanged: tuple[str, ...] = ()
    rewritten: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    most_s: float = 300.0


def wired(axes=(0, 1), velocity=(1, 1), encoder=(1, 1)):
    """A siderostat's wiring as a setting."""
    lists = {"axes": axes, "velocity_signs": velocity, "encoder_signs": encoder}
    inside = ", ".join(f"{key} = {list(value)}" for key, value in lists.items())
    return (f"{WIRING}={{ {inside} }}",)


RUNS_AWAY = 5.0
"""Where a controller closes a loop of its own about the encoder: it runs away inside, up to its error limit."""
COMMON = {
    "azimuth motor reversed": wired(velocity=(-1, 1)),
    "elevation motor reversed": wired(velocity=(1, -1)),
    "both motors reversed": wired(velocity=(-1, -1)),
    "azimuth encoder reversed": wired(encoder=(-1, 1)),
    "both encoders reversed": wired(encoder=(-1, -1)),
}
SIGNS = {
    "azimuth motor reversed": (-1, 1),
    "elevation motor reversed": (1, -1),
    "both motors reversed": (-1, -1),
    "azimuth encoder reversed": (-1, 1),
    "both encoders reversed": (-1, -1),
}


def _amplifiers(rig, back_end):
    def entry(name, wrong, **expected):
        return Entry(f"{name} ({back_end})", "amplifiers", wrong, "amplifiers", rig=rig, **expected)

    def signs(az, el):
        if rig == BAL:
            key = f"{SIDEROSTAT}.device.velocity_rad_s_per_v"
            scales = {f"{key}.az": 6.0 * az, f"{key}.el": 6.0 * el}
            return {key: scale for key, scale in scales.items() if scale < 0}
        return {f"{WIRING}.velocity_signs": [az, el]}

    yield entry("nothing", ())
    for name, wrong in COMMON.items():
        if rig == ENSEMBLE:
            yield entry(name, wrong, named="counts against it", most_rad=RUNS_AWAY)
        else:
            yield entry(name, wrong, found=signs(*SIGNS[name]))
    yield entry(
        "elevation axis dead",
        (f"{MOCKS}.velocity_gains=[1.0, 0.0]",),
        named="elevation: no encoder",
    )
    yield entry(
        "azimuth motor stuck",
        ("mocks.faults=[{ device = 'right.drive', kind = 'stuck_axis', part = 'az' }]",),
        named="azimuth",
    )
    if rig == ENSEMBLE:  # it counts in its own units, and follows itself
        return
    for counts in (1000,) if rig == BAL else (1000, 16000):  # its counters have 16 bits
        yield entry(
            f"encoders of {counts} counts for 4000",
            (f"{SIDEROSTAT}.encoder_counts_per_rev={counts}",),
            named="encoder_counts_per_rev",
        )
    yield entry(
        "velocity scale 10 times",
        (f"{MOCKS}.velocity_gains=[10.0, 10.0]",),
        named="times as fast as commanded",
        most_rad=0.1,  # until the first reading beyond the bound, and one period more
    )
    yield entry(
        "velocity scale a tenth",
        (f"{MOCKS}.velocity_gains=[0.1, 0.1]",),
        named="no encoder counted its pulse",
    )


AMPLIFIERS = [
    *_amplifiers(CIA402, "CiA 402"),
    *_amplifiers(ENSEMBLE, "Ensemble"),
    *_amplifiers(BAL, "analogue"),
]
NEAR = "plant.loops.right.star_offset_sky_arcsec_max=25.0"
FSM = "loops.right.fsm"
MDT693, DAC = f"{MOCKS}.mdt693", f"{MOCKS}.dac"


def _stacks(name, *wrong, **expected):
    return Entry(name, "stacks", wrong, "stacks", most_rad=0.0, **({"most_v": 0.35} | expected))


STACKS = [
    _stacks("nothing"),
    *(
        _stacks(
            f"D/A channels to stacks in the order {', '.join(map(str, order))}",
            f"{FSM}.dac.channels={list(order)}",
            found={f"{FSM}.dac.channels": list(order)},
        )
        for order in ((2, 1, 3), (1, 3, 2), (3, 2, 1), (2, 3, 1), (3, 1, 2))
    ),
    _stacks(
        "stack 2 unplugged at the amplifier's input",
        f"{MDT693}.true_gains=[15.0, 0.0, 15.0]",
        named="stack 2: check the cable",
    ),
    _stacks(
        "stack 3 at half gain", f"{MDT693}.true_gains=[15.0, 15.0, 7.5]", named="stack 3: check"
    ),
    _stacks(
        "amplifier gain 7.5 for 15",
        f"{MDT693}.true_gains=[7.5, 7.5, 7.5]",
        named="piezo.gain says 15",
    ),
    _stacks(
        "D/A range 5 V for 10 V", f"{DAC}.true_full_scale_v=5.0", named="dac.full_scale_v says 10"
    ),
    _stacks("D/A words byte-swapped", f"{DAC}.bytes_swapped=true", named="low byte"),
    _stacks("limit switch at 75 V", f"{MDT693}.limit_switch_v=75", named="limit", most_v=0.0),
    _stacks("front knob of stack 1 turned up", f"{MDT693}.knobs_v=[20.0, 0.0, 0.0]", named="knob"),
    _stacks(
        "an output stays at its highest voltage",
        "mocks.faults=[{ device = 'right.mdt693', kind = 'saturated_stack', part = 'y' }]",
        named="stack 2",
    ),
]


def _camera(name, *wrong, step="camera", most_rad=0.0, **expected):
    return Entry(name, "camera", (NEAR, *wrong), step, most_rad=most_rad, **expected)


def _turned(name, quarters, *, mirrored=False, found):
    key = "mocks.camera"
    wrong = (f"{key}.quarter_turns={quarters}", f"{key}.mirrored={str(mirrored).lower()}")
    return _camera(name, *wrong, step="mirror", found=found, most_rad=7.0, most_v=2.6)


SIDEROSTAT_DEG, MIRROR_DEG = f"{SIDEROSTAT}.rotation_deg", f"{FSM}.rotation_deg"
CAMERA = [
    _camera("nothing"),
    *(
        _turned(
            f"camera turned by {90 * quarters} degrees",
            quarters,
            found={SIDEROSTAT_DEG: degrees, MIRROR_DEG: degrees},
        )
        for quarters, degrees in ((1, 90.0), (2, 180.0), (3, -90.0))
    ),
    _turned(
        "camera picture mirrored",
        0,
        mirrored=True,
        found={
            f"{WIRING}.velocity_signs": [-1, 1],
            f"{WIRING}.encoder_signs": [-1, 1],
            f"{FSM}.dac.channels": [3, 2, 1],
            MIRROR_DEG: -90.0,
        },
    ),
    _turned(
        "camera picture mirrored and turned by 90 degrees",
        1,
        mirrored=True,
        found={
            f"{WIRING}.velocity_signs": [-1, 1],
            SIDEROSTAT_DEG: 90.0,
            f"{FSM}.dac.channels": [3, 2, 1],
        },
    ),
    _camera("frame rate 49 for 50", "mocks.camera.true_frame_rate_hz=49.0", named="49.0"),
    _camera(
        "frames 20 ms later than said",
        "plant.frame_delay_s=0.055",
        found={"camera.frame_delay_s": 0.055},
    ),
    _camera(
        "dark level 1500 DN for 1000", "camera.bias_dn=1500.0", found={"camera.bias_dn": 1500.0}
    ),
    _camera(
        "noise 60 DN for 20", "camera.pixel_noise_dn=60.0", found={"camera.pixel_noise_dn": 60.0}
    ),
    _camera(
        "ten hot pixels",
        "plant.hot_pixels=["
        + ", ".join(
            f"{{ az_px = {3 * k + 4}, el_px = {33 - 2 * k}, dn = 9000.0 }}" for k in range(10)
        )
        + "]",
    ),
    _camera(
        "exposure saturates the star",
        "plant.loops.right.spots=[{ name = 'pointing', offset_px = { az = 0.0, el = 0.0 }, flux_dn = 900000.0, "
        "diameter_px = 3.0 }]",
        named="saturates",
    ),
    _camera(
        "no light",
        "plant.loops.right.spots=[{ name = 'pointing', offset_px = { az = 0.0, el = 0.0 }, "
        "flux_dn = 1.0, diameter_px = 3.0 }]",
        step="star",
        named="no star within",
        most_rad=40.0,
    ),
    _camera(
        "star at half flux",
        "mocks.faults=[{ device = 'camera', kind = 'star_dim', value = 0.5 }]",
        step="star",
        found={"loops.right.star_flux_dn": 14000.0},
        most_rad=0.05,
    ),
    _camera(
        "two stars",
        "plant.loops.right.spots=["
        "{ name = 'pointing', offset_px = { az = 0.0, el = 0.0 }, flux_dn = 28000.0, diameter_px = 3.0 }, "
        "{ name = 'second', offset_px = { az = -9.0, el = -8.0 }, flux_dn = 27000.0, diameter_px = 3.0 }]",
        step="star",
        named="two spots could be the star",
        most_rad=0.05,
    ),
    Entry(
        "star outside the field",
        "camera",
        ("plant.loops.right.star_offset_sky_arcsec_max=120.0",),
        "star",
        most_rad=20.0,
    ),
    _camera("only Mono8 where Mono16 is said", "mocks.camera.mono8_only=true", named="PixelFormat"),
    _camera("region offset by the last program", "mocks.camera.offset_at_start_px=8"),
]


def _optics(name, *wrong, step="siderostat", **expected):
    return Entry(
        name, "optics", (NEAR, *wrong), step, **({"most_rad": 7.0, "most_v": 2.6} | expected)
    )


def _siderostat(rig, back_end):
    def entry(name, *wrong, **expected):
        return _optics(f"{name}{back_end}", *wrong, rig=rig, **expected)

    yield entry("siderostat axes exchanged", *wired(axes=(1, 0)), found={f"{WIRING}.axes": [1, 0]})
    yield entry(
        "azimuth motor and its encoder reversed",
        *wired(velocity=(-1, 1), encoder=(-1, 1)),
        found={f"{WIRING}.velocity_signs": [-1, 1], f"{WIRING}.encoder_signs": [-1, 1]},
    )
    yield entry(
        "elevation motor and its encoder reversed",
        *wired(velocity=(1, -1), encoder=(1, -1)),
        found={f"{WIRING}.velocity_signs": [1, -1], f"{WIRING}.encoder_signs": [1, -1]},
    )
    yield entry(
        "both motors and encoders reversed",
        *wired(velocity=(-1, -1), encoder=(-1, -1)),
        found={SIDEROSTAT_DEG: 180.0},
    )
    yield entry(
        "azimuth stuck after 1 rad",
        f"{MOCKS}.motor_ends_rad=[1.0, 1000.0]",
        named=STOPS[rig],
    )
    yield entry(
        "an end nearer than the travel",
        f"{MOCKS}.motor_ends_rad=[1000.0, 30.0]",
        step="travel",
        named="elevation",
        most_rad=81.0,
    )


STOPS = {CIA402: "does not follow", BAL: "does not follow", ENSEMBLE: "fault"}
OPTICS = [
    _optics("nothing", step="mirror"),
    *_siderostat(CIA402, ""),
    *_siderostat(ENSEMBLE, " (Ensemble)"),
    *_siderostat(BAL, " (analogue)"),
    _optics(
        "elevation encoder alone reversed",
        *wired(encoder=(1, -1)),
        found={f"{WIRING}.velocity_signs": [1, 1], f"{WIRING}.encoder_signs": [1, -1]},
    ),
    _optics(
        "software limits nearer than the travel (Ensemble)",
        f"{MOCKS}.ensemble.software_limit_units=5.0",
        rig=ENSEMBLE,
        step="travel",
        named="31.",
        most_rad=33.0,
    ),
    _optics(
        "spur gear 20 % off",
        f"{SIDEROSTAT}.spur_gear_ratio=30.0",
        f"{SIDEROSTAT}.travel_sky_arcsec=990.0",
        found={f"{SIDEROSTAT}.spur_gear_ratio": 30.0},
    ),
    _optics(
        "siderostat turned by 30 degrees",
        f"{SIDEROSTAT}.rotation_deg=30.0",
        found={SIDEROSTAT_DEG: 30.0},
    ),
    _optics(
        "focal length 20 % off",
        "optics.focal_length_m=0.5484",
        step="mirror",
        found={"optics.focal_length_m": 0.5484},
    ),
    _optics("D/A at 0 V at the start", f"{DAC}.safe_v=0.0", step="mirror", most_v=7.6),
    _optics(
        "mirror mounted mirrored",
        # For the star, a mirror image along azimuth is stacks 1 and 3 exchanged, and a quarter turn.
        f"{FSM}.piezo.channels=[3, 2, 1]",
        f"{FSM}.dac.channels=[3, 2, 1]",
        f"{FSM}.rotation_deg=-90.0",
        step="mirror",
        found={
            f"{FSM}.dac.channels": [3, 2, 1],
            f"{FSM}.piezo.channels": [3, 2, 1],
            MIRROR_DEG: -90.0,
        },
    ),
    _optics("backlash 5 times", "plant.loops.right.backlash_sky_arcsec=5.0"),
    _optics(
        "mirror mounted at 90 degrees",
        f"{FSM}.rotation_deg=90.0",
        step="mirror",
        found={MIRROR_DEG: 90.0},
    ),
    *(
        _optics(
            f"amplifier's outputs on stacks in the order {', '.join(map(str, order))}",
            f"{FSM}.piezo.channels={list(order)}",
            f"{FSM}.dac.channels={list(order)}",
            step="mirror",
            found={f"{FSM}.piezo.channels": list(order), f"{FSM}.dac.channels": list(order)},
        )
        for order in ((2, 1, 3), (1, 3, 2), (2, 3, 1), (3, 1, 2))
    ),
]
STARS_NEAR = tuple(
    f"plant.loops.{loop}.star_offset_sky_arcsec_max=10.0" for loop in ("left", "right")
)
CHANNEL = "loops.{}.siderostat.device.channel"
INPUTS = "loops.metrology.sensor.device.inputs"
AZIMUTH = "collector.geometry.link_azimuth"
OF_RIGHT = ("devices", "camera", "stacks", "amplifiers", "star", "siderostat", "mirror")
OF_ALL = (*OF_RIGHT[:4], "photodiodes", "collector", *OF_RIGHT[4:])
OF_BEAM = ("devices", "metrology.amplifiers", "metrology.photodiodes")


def _testbed(name, *wrong, only=OF_BEAM, **expected):
    most = {"most_rad": 90.0, "loop": "metrology"} | expected
    return Entry(name, "testbed", (*STARS_NEAR, *wrong), only[-1], rig=TESTBED, only=only, **most)


def _of_right(other):
    steps = tuple(name if name in OF_RIGHT[:2] else f"right.{name}" for name in OF_RIGHT)
    beam = OF_BEAM[1:] if other == "left" else ()  # without it, left's star is not on the camera
    return _testbed(
        f"amplifiers of right and {other} exchanged",
        only=(*steps[:4], *beam, *steps[4:]),
        exchanged=(CHANNEL.format("right"), CHANNEL.format(other)),
        named={"left": "another star", "metrology": "are those of another loop"}[other],
        most_rad=7.0 if other == "left" else 40.0,  # what is no star of it is searched in vain
        most_v=2.6,
        loop=other,
    )


FEEDFORWARD = "loops.left.feedforward"
OF_FEEDFORWARD = (*OF_BEAM, "metrology.collector", "left.coupling", "left.feedforward")
OF_OTHERS = (
    "camera",
    "stacks",
    "left.amplifiers",
    "star",
    "siderostat",
    "mirror",
    "travel",
    "link",
)
OF_OTHERS += ("gentle", "loop", "airpath", "hysteresis", "backlash", "delay")


def _feedforward(name, matrix):
    return _testbed(
        name,
        only=OF_FEEDFORWARD,
        skipped=OF_OTHERS,
        rewritten=("matrix = [[1.0, 0.0], [0.0, 1.0]]", f"matrix = {matrix}"),
        found={f"{FEEDFORWARD}.gain": 1.0, f"{FEEDFORWARD}.matrix": [[1.0, 0.0], [0.0, 1.0]]},
        loop="left",
        most_rad=7.0,
        most_v=4.0,
        most_s=900.0,
    )


TESTBED_ENTRIES = [
    _testbed("nothing", only=OF_ALL, most_v=2.6),
    _of_right("left"),
    _of_right("metrology"),
    *(
        _testbed(
            f"photodiodes az+, az-, el+, el- on inputs {', '.join(map(str, inputs))}",
            f"{INPUTS}={list(inputs)}",
            found={INPUTS: list(inputs)},
        )
        for inputs in ((1, 0, 2, 3), (2, 1, 0, 3), (2, 3, 0, 1))
    ),
    _testbed(
        "photodiode el- unplugged",
        "mocks.faults=[{ device = 'metrology.labjack', kind = 'unplugged', part = 'AIN3' }]",
        named="AIN3: no light",
    ),
    _testbed(
        "hexapod turned by 90 degrees about the link",
        f"{AZIMUTH}=[0.0, 0.0, 1.0]",
        only=(*OF_BEAM, "metrology.collector"),
        found={AZIMUTH: [0.0, 0.0, 1.0]},
    ),
    _feedforward("feedforward 20 % too large", [[1.2, 0.0], [0.0, 1.2]]),
    _feedforward("feedforward of the wrong sign", [[-1.0, 0.0], [0.0, -1.0]]),
    _feedforward("feedforward with its axes exchanged", [[0.0, 1.0], [1.0, 0.0]]),
]
CATALOGUE = [
    entry._replace(name=f"{entry.name} ({entry.group})" if entry.name == "nothing" else entry.name)
    for entry in (*AMPLIFIERS, *STACKS, *CAMERA, *OPTICS, *TESTBED_ENTRIES)
]
