"""Rigs that are wired wrongly: what is wrong, what must be made of it, and how far anything may move."""

from typing import Any, NamedTuple

SIDEROSTAT = "loops.right.siderostat"
WIRING = f"{SIDEROSTAT}.wiring"
MOCKS = "mocks.loops.right"
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


def wired(axes=(0, 1), velocity=(1, 1), encoder=(1, 1)):
    """A siderostat's wiring as a setting."""
    lists = {"axes": axes, "velocity_signs": velocity, "encoder_signs": encoder}
    inside = ", ".join(f"{key} = {list(value)}" for key, value in lists.items())
    return (f"{WIRING}={{ {inside} }}",)


def _amplifiers(rig, back_end):
    def entry(name, wrong, **expected):
        return Entry(f"{name} ({back_end})", "amplifiers", wrong, "amplifiers", rig=rig, **expected)

    def signs(az, el):
        return {f"{WIRING}.velocity_signs": [az, el]}

    yield entry("nothing", ())
    if rig == BAL:
        key = f"{SIDEROSTAT}.device.velocity_rad_s_per_v"
        yield entry("azimuth motor reversed", wired(velocity=(-1, 1)), found={f"{key}.az": -6.0})
    elif rig == ENSEMBLE:
        # The controller closes a loop of its own about the encoder: it runs away inside, up to its error limit.
        yield entry(
            "azimuth motor reversed",
            wired(velocity=(-1, 1)),
            named="counts against it",
            most_rad=5.0,
        )
    else:
        yield entry("azimuth motor reversed", wired(velocity=(-1, 1)), found=signs(-1, 1))
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


AMPLIFIERS = [
    *_amplifiers(CIA402, "CiA 402"),
]


def _cia402(name, wrong, **expected):
    return Entry(f"{name} (CiA 402)", "amplifiers", wrong, "amplifiers", **expected)


def _signs(az, el):
    return {f"{WIRING}.velocity_signs": [az, el]}


AMPLIFIERS += [
    _cia402("elevation motor reversed", wired(velocity=(1, -1)), found=_signs(1, -1)),
    _cia402("both motors reversed", wired(velocity=(-1, -1)), found=_signs(-1, -1)),
    _cia402("azimuth encoder reversed", wired(encoder=(-1, 1)), found=_signs(-1, 1)),
    _cia402("both encoders reversed", wired(encoder=(-1, -1)), found=_signs(-1, -1)),
    _cia402(
        "encoders of 1000 counts for 4000",
        (f"{SIDEROSTAT}.encoder_counts_per_rev=1000",),
        named="encoder_counts_per_rev",
    ),
    _cia402(
        "encoders of 16000 counts for 4000",
        (f"{SIDEROSTAT}.encoder_counts_per_rev=16000",),
        named="encoder_counts_per_rev",
    ),
    _cia402(
        "velocity scale 10 times",
        (f"{MOCKS}.velocity_gains=[10.0, 10.0]",),
        named="times as fast as commanded",
        most_rad=0.1,  # until the first reading beyond the bound, and one period more
    ),
    _cia402(
        "velocity scale a tenth",
        (f"{MOCKS}.velocity_gains=[0.1, 0.1]",),
        named="no encoder counted its pulse",
    ),
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
]


def _optics(name, *wrong, step="siderostat", **expected):
    return Entry(
        name, "optics", (NEAR, *wrong), step, **({"most_rad": 7.0, "most_v": 2.6} | expected)
    )


OPTICS = [
    _optics("nothing", step="mirror"),
    _optics(
        "siderostat axes exchanged",
        *wired(axes=(1, 0)),
        found={f"{WIRING}.axes": [1, 0]},
    ),
    _optics(
        "azimuth motor and its encoder reversed",
        *wired(velocity=(-1, 1), encoder=(-1, 1)),
        found={f"{WIRING}.velocity_signs": [-1, 1], f"{WIRING}.encoder_signs": [-1, 1]},
    ),
    _optics(
        "elevation motor and its encoder reversed",
        *wired(velocity=(1, -1), encoder=(1, -1)),
        found={f"{WIRING}.velocity_signs": [1, -1], f"{WIRING}.encoder_signs": [1, -1]},
    ),
    _optics(
        "elevation encoder alone reversed",
        *wired(encoder=(1, -1)),
        found={f"{WIRING}.velocity_signs": [1, 1], f"{WIRING}.encoder_signs": [1, -1]},
    ),
    _optics(
        "both motors and encoders reversed",
        *wired(velocity=(-1, -1), encoder=(-1, -1)),
        found={SIDEROSTAT_DEG: 180.0},
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
CATALOGUE = [
    entry._replace(name=f"{entry.name} ({entry.group})" if entry.name == "nothing" else entry.name)
    for entry in (*AMPLIFIERS, *STACKS, *CAMERA, *OPTICS)
]
