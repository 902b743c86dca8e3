"""What the supervisor makes of each fault of each device: where it goes, what it says, and the way back."""

import time

import pytest

from fitctl.commands.fault import kinds
from fitctl.mocks.bench import ClearFaults, SetFault, ask_faults
from fitctl.supervisor.messages import Acquire, Recover, Standby

from .conftest import Rig

pytestmark = [pytest.mark.timeout(300), pytest.mark.fault]
NEAR = ["--set", "plant.loops.right.star_offset_sky_arcsec_max=5.0"]  # found at once
STAYS_S = 3.0
SAFE_WITHIN_S = 15.0
TRIES = 3  # the machine itself may stand still while the loop comes back

# Device and kind of fault; without more the star is held all the same.
HELD = [
    "camera duplicate",
    "camera reorder",
    "camera hot_pixel",
    "right.drive delay",
    "right.drive duplicate",
    "right.drive reorder",
    "right.dac duplicate",
    "right.mdt693 delay",
]
# And here the loop must be SAFE, and say which device failed.
SAFE = {
    "camera drop": "camera at",
    "camera corrupt": "camera at",
    "camera disconnect": "camera at",
    "camera freeze": "camera at",
    "camera reboot": "camera at",
    "camera frame_drop": "camera at",
    "camera packet_loss": "camera at",
    "camera mtu": "camera at",
    "right.drive drop": "siderostat",
    "right.drive corrupt": "siderostat",
    "right.drive disconnect": "siderostat",
    "right.drive freeze": "siderostat",
    "right.drive reboot": "siderostat",
    "right.drive link_loss": "siderostat",
    "right.drive amplifier_fault": "siderostat",
    "right.drive following_error": "siderostat",
    "right.drive encoder_jump": "siderostat",
    "right.dac drop": "D/A at",
    "right.dac corrupt": "D/A at",
    "right.dac disconnect": "D/A at",
    "right.dac freeze": "D/A at",
    "right.dac reboot": "D/A at",
    "right.dac watchdog_trip": "D/A at",
    "right.mdt693 drop": "piezo amplifier at",
    "right.mdt693 disconnect": "piezo amplifier at",
    "right.mdt693 freeze": "piezo amplifier at",
    "right.mdt693 reboot": "piezo amplifier at",
    "right.mdt693 silent": "piezo amplifier at",
    "right.mdt693 limit_switch": "piezo amplifier at",
}
# The star is gone, or out of reach: the loop goes back by itself to look for it or to fetch it.
LOST = ["camera star_fading", "camera delay"]
# Whether it shows depends on when it strikes: the loop is in a mode of its table, and comes back.
EITHER = [
    "camera background_jump",
    "camera saturation",
    "right.drive stuck_axis",
    "right.dac delay",
    "right.dac reorder",
    "right.mdt693 corrupt",
    "right.mdt693 duplicate",
    "right.mdt693 reorder",
    "right.mdt693 saturated_stack",
]


@pytest.fixture(scope="module")
def instrument(tmp_path_factory):
    rig = Rig(tmp_path_factory.mktemp("faults"))
    rig.common += NEAR
    try:
        rig.start_mocks("--free-ports")
        rig.start_supervisor()
        yield rig
    finally:
        rig.close()
        for path in sorted(rig.sockets.glob("*")):
            path.unlink()
        rig.sockets.rmdir()


def tell(rig, question):
    answer = ask_faults(rig.endpoints["mocks.bench_port"], question)
    assert not answer.error
    return answer


def mode(rig):
    return rig.follow(lambda _: True)[-1].loops[0].mode


def hold(rig):
    """From wherever the loop is to VERNIER."""
    tell(rig, ClearFaults())
    for _ in range(TRIES):
        now = mode(rig)
        if now == "SAFE":
            rig.client.send(Recover())
        elif now == "OFF":
            rig.client.send(Standby())
        elif now == "STANDBY":
            rig.client.send(Acquire())
        try:
            if now in {"SAFE", "OFF"}:
                rig.follow_to("STANDBY", 15.0)
                assert rig.client.send(Acquire()).accepted
            rig.follow_to("VERNIER", 25.0)
            return
        except AssertionError as error:
            last = error
    raise last


def strike(rig, fault):
    hold(rig)
    device, kind = fault.split()
    tell(rig, SetFault(device, kind))


def watch(rig):
    end_s = time.monotonic() + STAYS_S
    return rig.follow(lambda _: time.monotonic() > end_s)


@pytest.mark.parametrize("fault", HELD)
def test_the_star_is_held_all_the_same(instrument, fault):
    for _ in range(TRIES):  # the machine may stand still meanwhile
        strike(instrument, fault)
        seen = watch(instrument)
        if {telemetry.loops[0].mode for telemetry in seen} == {"VERNIER"}:
            return
    raise AssertionError([event.message for telemetry in seen for event in telemetry.events])


@pytest.mark.parametrize(("fault", "said"), SAFE.items(), ids=SAFE)
def test_it_makes_the_loop_safe_and_says_which_device_failed(instrument, fault, said):
    strike(instrument, fault)
    seen = instrument.follow_to("SAFE", SAFE_WITHIN_S)
    assert said in " ".join(
        [seen[-1].loops[0].last_change.reason, *(e.message for one in seen for e in one.events)]
    )
    hold(instrument)


@pytest.mark.parametrize("fault", LOST)
def test_the_loop_goes_back_for_its_star(instrument, fault):
    strike(instrument, fault)
    left = {"ACQUISITION", "COARSE", "SAFE"}
    instrument.follow(lambda telemetry: telemetry.loops[0].mode in left, SAFE_WITHIN_S)
    hold(instrument)


@pytest.mark.parametrize("fault", EITHER)
def test_whatever_it_does_the_loop_comes_back(instrument, fault):
    strike(instrument, fault)
    watch(instrument)
    hold(instrument)


def test_every_fault_of_the_default_rig_is_here():
    tables = {
        "camera": "camera",
        "drive": "right.drive",
        "dac": "right.dac",
        "mdt693": "right.mdt693",
    }
    every = {f"{name} {kind}" for key, name in tables.items() for kind in kinds()[key]}
    assert every == {*HELD, *SAFE, *LOST, *EITHER}
