"""States in which something is wrong, by name: what an operator's night is made of."""

from collections.abc import Callable

import msgspec

from fitctl.messages.telemetry import LoopFailure, Telemetry, TrippedInterlock
from tests.instruments.fake_supervisor import STAR_LOST, START_S, TESTBED, FakeSupervisor

FAULT = (
    "siderostat right at socket://127.0.0.1:29536: expected no fault, got axis 2: following error; "
    "remove its cause, then recover"
)


def tripped(name: str, action: str, reason: str, reset: str = "itself") -> TrippedInterlock:
    return TrippedInterlock(
        name=name, since_s=START_S - 3.0, action=action, reset=reset, reason=reason
    )


def drive_fault(loops: tuple[str, ...] = ("right",)) -> FakeSupervisor:
    """A drive of the right siderostat stops; what its loop did about it."""
    others = {loop: "VERNIER" for loop in loops if loop != "right"}
    supervisor = FakeSupervisor("SAFE", loops=loops, modes=others)
    supervisor.trigger, supervisor.reason = "FAULT", FAULT
    supervisor.faulty = {"right siderostat": FAULT}
    return supervisor


def fault_and_lost_records() -> FakeSupervisor:
    supervisor = drive_fault()
    supervisor.records_lost = 1234
    return supervisor


def star_lost() -> FakeSupervisor:
    supervisor = FakeSupervisor("ACQUISITION")
    supervisor.trigger, supervisor.reason = "STAR_LOST", "no star on 10 frames in a row"
    supervisor.search_again = STAR_LOST
    return supervisor


def interlock_warns() -> FakeSupervisor:
    supervisor = FakeSupervisor()
    reason = "interlock fsm_edge: 93 % of the mirror's range, at most 90 %; look at the drift"
    supervisor.interlocks = [tripped("fsm_edge", "warn", reason)]
    return supervisor


def interlock_holds() -> FakeSupervisor:
    supervisor = FakeSupervisor()
    reason = "interlock frame_missing: no frame for 0.5 s; check camera and cable"
    supervisor.interlocks = [tripped("frame_missing", "freeze", reason, "hand")]
    return supervisor


def device_fault() -> FakeSupervisor:
    supervisor = FakeSupervisor()
    supervisor.faulty = {"right piezo": "no answer in 1 s; check its cable"}
    return supervisor


def recovery_failed() -> FakeSupervisor:
    supervisor = drive_fault()
    supervisor.last_failure = LoopFailure(what="recover", time_s=START_S + 2.0, text=FAULT + ".")
    return supervisor


def records_lost() -> FakeSupervisor:
    supervisor = FakeSupervisor()
    supervisor.records_lost = 6
    return supervisor


class Changed(FakeSupervisor):
    """With a field of each message replaced."""

    def message(self) -> Telemetry:
        return msgspec.structs.replace(super().message(), recorder=None)


def not_recording() -> FakeSupervisor:
    return Changed()


def link_lost() -> FakeSupervisor:
    """The beam is searched; left waits for it, right goes on."""
    supervisor = FakeSupervisor(loops=TESTBED, modes={"metrology": "ACQUISITION"})
    supervisor.waits_for = {"left": "metrology"}
    return supervisor


def stopped_testbed() -> FakeSupervisor:
    return FakeSupervisor("SAFE", loops=TESTBED)


def faulty_testbed() -> FakeSupervisor:
    return drive_fault(TESTBED)


ALARMS: dict[str, Callable[[], FakeSupervisor]] = {
    function.__name__: function
    for function in (
        drive_fault,
        fault_and_lost_records,
        star_lost,
        interlock_warns,
        interlock_holds,
        device_fault,
        recovery_failed,
        records_lost,
        not_recording,
        faulty_testbed,
    )
}
