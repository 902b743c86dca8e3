"""What the supervisor makes of each fault of each device: where it goes, what it says, and the way back."""

import time
from contextlib import ExitStack

import pytest

from fitctl.commands.fault import kinds
from fitctl.config import default_rig_path
from fitctl.mocks.bench import ClearFaults, SetFault, ask_faults
from fitctl.supervisor.messages import Acquire, Recover, Standby

from .conftest import NEAR, running

pytestmark = [pytest.mark.timeout(300), pytest.mark.fault]
STAYS_S = 3.0
SAFE_WITHIN_S = 15.0
TRIES = 3  # the machine itself may stand still while the loop comes back


def held(rig, fault):
    """The star is held all the same."""
    for _ in range(TRIES):  # the machine may stand still meanwhile
        strike(rig, fault)
        seen = watch(rig)
        if {telemetry.loops[0].mode for telemetry in seen} == {"VERNIER"}:
            return
    raise AssertionError([event.message for telemetry in seen for event in telemetry.events])


def safe(said):
    """The loop is SAFE, and says which device failed."""

    def check(rig, fault):
        strike(rig, fault)
        seen = rig.follow_to("SAFE", SAFE_WITHIN_S)
        messages = [event.message for telemetry in seen for event in telemetry.events]
        assert said in " ".join([seen[-1].loops[0].last_change.reason, *messages])

    return check


def lost(rig, fault):
    """The star is gone, or out of reach: the loop goes back by itself to look for it or to fetch it."""
    strike(rig, fault)
    left = {"ACQUISITION", "COARSE", "SAFE"}
    rig.follow(lambda telemetry: telemetry.loops[0].mode in left, SAFE_WITHIN_S)


def interlocked(name):
    """The loop stays where it is and shows that interlock, which says what is wrong."""

    def check(rig, fault):
        strike(rig, fault)
        rig.follow(
            lambda telemetry: name in {trip.name for trip in telemetry.loops[0].interlocks},
            SAFE_WITHIN_S,
        )

    return check


def either(rig, fault):
    """Whether it shows depends on when it strikes: the loop is in a mode of its table."""
    strike(rig, fault)
    watch(rig)


CAMERA, SIDEROSTAT, DAC, PIEZO = map(
    safe, ("camera at", "siderostat", "D/A at", "piezo amplifier at")
)
# Rig and device; what becomes of each of its faults. One rig after the other: each is started once.
ENDS = {
    "fit-mock camera": {
        "drop": CAMERA,
        "delay": interlocked("frame_age"),
        "corrupt": CAMERA,
        "duplicate": held,
        "reorder": held,
        "disconnect": CAMERA,
        "freeze": CAMERA,
        "reboot": CAMERA,
        "frame_drop": CAMERA,
        "packet_loss": CAMERA,
        "mtu": CAMERA,
        "star_fading": lost,
        "background_jump": either,
        "hot_pixel": held,
        "saturation": either,
    },
    "fit-mock right.drive": {
        "drop": SIDEROSTAT,
        "delay": SIDEROSTAT,
        "corrupt": SIDEROSTAT,
        "duplicate": held,
        "reorder": held,
        "disconnect": SIDEROSTAT,
        "freeze": SIDEROSTAT,
        "reboot": SIDEROSTAT,
        "link_loss": SIDEROSTAT,
        "amplifier_fault": SIDEROSTAT,
        "following_error": SIDEROSTAT,
        "encoder_jump": SIDEROSTAT,
        "stuck_axis": either,
    },
    "fit-mock right.dac": {
        "drop": DAC,
        "delay": either,
        "corrupt": DAC,
        "duplicate": held,
        "reorder": either,
        "disconnect": DAC,
        "freeze": DAC,
        "reboot": DAC,
        "watchdog_trip": DAC,
    },
    "fit-mock right.mdt693": {
        "drop": PIEZO,
        "delay": held,
        "corrupt": either,
        "duplicate": either,
        "reorder": either,
        "disconnect": PIEZO,
        "freeze": PIEZO,
        "reboot": either,  # all stacks go down together: the star hardly moves
        "silent": PIEZO,
        "limit_switch": PIEZO,
        "saturated_stack": PIEZO,
    },
    "ensemble right.drive": {
        "drop": SIDEROSTAT,
        "delay": SIDEROSTAT,
        "corrupt": SIDEROSTAT,
        "duplicate": SIDEROSTAT,
        "reorder": SIDEROSTAT,
        "disconnect": SIDEROSTAT,
        "freeze": SIDEROSTAT,
        "reboot": SIDEROSTAT,
        "amplifier_fault": SIDEROSTAT,
        "following_error": SIDEROSTAT,
        "encoder_jump": SIDEROSTAT,
        "stuck_axis": either,
    },
    "fit-bal-analog right.drive": {
        "drop": SIDEROSTAT,
        "delay": SIDEROSTAT,
        "corrupt": SIDEROSTAT,
        "duplicate": held,
        "reorder": held,
        "disconnect": SIDEROSTAT,
        "freeze": SIDEROSTAT,
        "reboot": SIDEROSTAT,
        "amplifier_fault": SIDEROSTAT,
        "encoder_jump": SIDEROSTAT,
        "stuck_axis": either,
        "command_offset": held,
    },
}
# Which of these each table of kinds is for.
STRUCK = {
    "camera": "fit-mock camera",
    "drive": "fit-mock right.drive",
    "drive (ensemble)": "ensemble right.drive",
    "drive (bal_analog)": "fit-bal-analog right.drive",
    "dac": "fit-mock right.dac",
    "mdt693": "fit-mock right.mdt693",
}
RUNS = {f"{where} {kind}": end for where, table in ENDS.items() for kind, end in table.items()}


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """The rig of a name, running; the one before it is ended."""
    with ExitStack() as stack:
        started = {}

        def start(name):
            if name not in started:
                stack.close()
                started.clear()
                folder = tmp_path_factory.mktemp("faults")
                file = default_rig_path().parent / f"{name}.toml"
                started[name] = stack.enter_context(running(folder, NEAR, file=file))
            return started[name]

        yield start


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
    _, device, kind = fault.split()
    tell(rig, SetFault(device, kind))


def watch(rig):
    end_s = time.monotonic() + STAYS_S
    return rig.follow(lambda _: time.monotonic() > end_s)


@pytest.mark.parametrize("fault", RUNS)
def test_a_fault_ends_as_its_table_says_and_the_loop_comes_back(rigs, fault):
    rig = rigs(fault.split()[0])
    RUNS[fault](rig, fault)
    hold(rig)


def test_every_fault_of_every_device_is_here():
    assert {STRUCK[device]: set(table) for device, table in kinds().items()} == {
        where: set(table) for where, table in ENDS.items()
    }
