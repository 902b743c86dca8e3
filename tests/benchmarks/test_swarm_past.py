"""Defects of the past, put back one at a time: each is found from a plan of a few happenings."""

import pytest

from benchmarks.swarm.happenings import Cloud, Kill, Sequence, Stall, Strike
from benchmarks.swarm.past import put_back
from benchmarks.swarm.rigs import slow_servos
from benchmarks.swarm.run import run_plan
from fitctl.messages.commands import (
    Acquire,
    Experiment,
    Jog,
    Off,
    Recover,
    Release,
    SetBiasOffset,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.model.drives import Drive, standstill
from tests.benchmarks.plans import gives, plan


def _expected(loop, az, el):
    return Acquire(loop=loop, expected_az_sky_arcsec=az, expected_el_sky_arcsec=el)


FAR = Acquire(expected_az_sky_arcsec=600.0, expected_el_sky_arcsec=0.0)
BACK = Acquire(expected_az_sky_arcsec=-200.0, expected_el_sky_arcsec=0.0)
SIDEROSTAT_RESTS = Drive(
    channel="siderostat_az", shape="sine", amplitude=0.0, frequency_hz=1.0, duration_s=1.0
)
KILLED_S = (40.0, 52.0, 64.0, 76.0)  # late in a search for a star behind a cloud
FOUND = {
    "watchdog-step": (
        plan(
            gives(0.1, Standby()),
            gives(1.5, SetBiasOffset(az_urad=100.0, el_urad=0.0)),
            Stall(at_s=3.0, lasts_s=1.6),
            gives(6.0, Standby()),
        ),
        "the mirror rests no faster than its slew",
    ),
    "bias-at-once": (
        plan(
            gives(0.1, Standby()),
            gives(2.0, Acquire()),
            gives(15.0, SetTarget(loop="right", az_px=26.0, el_px=22.0)),
            gives(16.0, Experiment(loop="right", name="rest", drives=[SIDEROSTAT_RESTS])),
            duration_s=20.0,
        ),
        "the mirror rests no faster than its slew",
    ),
    "repeated-off": (
        plan(
            gives(0.1, Standby()),
            gives(1.5, SetBiasOffset(az_urad=100.0, el_urad=0.0)),
            *[gives(3.0 + 0.001 * number, Off()) for number in range(4)],
        ),
        "the mirror rests no faster than its slew",
    ),
    "stall-is-stuck": (
        plan(gives(0.1, Standby()), gives(2.0, FAR), Stall(at_s=2.2, lasts_s=0.15)),
        "an axis that is not stuck is not called so",
    ),
    "late-is-stuck": (
        plan(
            gives(0.1, Standby()),
            gives(2.0, FAR),
            Strike(at_s=2.2, device="right siderostat", fault="slow", size=80.0, lasts_s=0.18),
            Stall(at_s=2.2, lasts_s=0.06),
        ),
        "an axis that is not stuck is not called so",
    ),
    "slews-while-held": (
        plan(
            gives(0.1, Standby()),
            gives(2.0, FAR),
            Strike(at_s=1.5, device="camera", fault="slow", size=25.0, lasts_s=5.0),
            settings=['interlocks.frame_age.modes=["ACQUISITION"]'],
        ),
        "a siderostat whose loop is held stays where it is",
    ),
    "star-forgotten": (
        plan(
            gives(0.1, Standby()),
            gives(2.0, FAR),
            Strike(at_s=2.2, device="right siderostat", fault="unplugged", lasts_s=0.3),
            gives(4.0, Recover()),
            gives(6.0, Recover()),
        ),
        "encoders that count on keep the star's place",
    ),
    "unanswered-turn": (
        plan(
            gives(0.1, Standby()),
            gives(2.0, FAR),
            gives(30.0, Release()),
            Strike(at_s=31.985, device="right siderostat", fault="mute", lasts_s=0.5),
            gives(32.0, Acquire()),
            gives(34.0, Recover()),
            duration_s=36.0,
            settings=slow_servos("fit-mock.toml", 1),
        ),
        "encoders that count on keep the star's place",
    ),
    "slow-turn": (
        plan(
            gives(0.1, Standby()),
            gives(0.5, FAR),
            Strike(at_s=2.25, device="right siderostat", fault="slow", size=45.0, lasts_s=0.7),
            gives(4.2, Recover()),
            rig="ensemble.toml",
        ),
        "encoders that count on keep the star's place",
    ),
    "turn-is-stuck": (
        plan(gives(0.1, Standby()), gives(2.0, FAR), gives(2.2, BACK)),
        "an axis that is not stuck is not called so",
    ),
    "killed-in-a-search": (
        plan(
            gives(0.1, None),
            gives(2.0, None),
            Cloud(at_s=12.0, lasts_s=70.0, part=0.0),
            *[Kill(at_s=at_s, back_after_s=0.1) for at_s in KILLED_S],
            *[gives(at_s + later_s, None) for at_s in KILLED_S for later_s in (0.5, 2.0, 3.0)],
            duration_s=84.0,
        ),
        "healed, every star is held within 60 s",
    ),
    "link-counts-late": (
        plan(
            *[gives(2.0 * number, None) for number in range(6)],
            Cloud(at_s=14.0, lasts_s=50.0, part=0.0),
            gives(15.0, Stop(loop="metrology")),  # else its search begins with small rounds
            *[gives(at_s, None) for at_s in (16.0, 17.0, 18.0)],
            Kill(at_s=28.0, back_after_s=0.1),
            duration_s=29.0,
            rig="fit-testbed.toml",
        ),
        "healed, every star is held within 60 s",
    ),
    "others-star": (
        plan(
            *[gives(at_s, None) for at_s in (4.053, 4.444, 5.972, 6.208, 32.157)],
            gives(5.633, Release(loop="right")),
            gives(5.733, _expected("right", -134.98, 466.70)),
            # The link comes back, and takes the star of the left loop to where the right one expects its own.
            Strike(
                at_s=33.061, device="metrology photodiodes", fault="loose", size=1.0, lasts_s=1.242
            ),
            gives(34.738, Release(loop="left")),
            gives(34.838, _expected("left", -430.13, 224.04)),
            duration_s=66.0,
            rig="fit-testbed.toml",
        ),
        "healed, every star is held within 60 s",
    ),
    "experiment-waits": (
        plan(
            *[gives(2.0 * number, None) for number in range(6)],
            Strike(at_s=24.0, device="metrology photodiodes", fault="mute", lasts_s=4.0),
            gives(26.0, Experiment(loop="left", name="rest", drives=standstill(0.5))),
            duration_s=30.0,
            rig="fit-testbed.toml",
        ),
        "an experiment ends",
    ),
    "travel-cuts-off": (
        plan(
            *[gives(2.0 * number, None) for number in range(6)],
            Strike(at_s=24.0, device="metrology photodiodes", fault="loose", size=1.0, lasts_s=1.5),
            duration_s=36.0,
            rig="fit-testbed.toml",
        ),
        "a loop that waited goes on at its star",
    ),
    "obeyed-late": (
        plan(Stall(at_s=0.05, lasts_s=3.0, alone=True), gives(0.1, Standby())),
        "a command whose sender has given up is not carried out",
    ),
    "sequence-in-safe": (
        plan(
            Sequence(at_s=0.5, who="ada", steps=["standby", "beam_standby", "wait"], loop="right"),
            gives(8.0, Stop(loop="metrology")),
            duration_s=30.0,
            rig="fit-testbed.toml",
        ),
        "a sequence ends if a loop that has had a step is SAFE",
    ),
    "jog-in-off": (
        plan(
            gives(0.1, Standby()),
            Strike(at_s=1.0, device="right piezo", fault="mute", lasts_s=6.0),
            gives(
                3.0, Jog(az_sky_arcsec=60.0, el_sky_arcsec=0.0)
            ),  # the device thread waits for it
            gives(3.005, Off()),
        ),
        "no stage moves in OFF or SAFE",
    ),
    "powered-unread": (
        plan(gives(0.1, Standby())),
        "encoders are read before motors have power",
    ),
    "oldest-frame": (
        plan(gives(0.1, Standby()), Stall(at_s=3.0, lasts_s=0.3)),
        "a tick acts on the newest frame",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("defect", FOUND)
def test_a_defect_of_the_past_is_found_from_a_plan(defect):
    found_from, invariant = FOUND[defect]
    with put_back(defect):
        violated = {one.invariant for one in run_plan(found_from).violations}

    assert invariant in violated
    assert run_plan(found_from).violations == []
