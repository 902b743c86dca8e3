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
    most_v: float = 0.0
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
CATALOGUE = [*AMPLIFIERS]
