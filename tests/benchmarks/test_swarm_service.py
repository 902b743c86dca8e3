"""Commands in the swarm go through the real service; what that does wrong is a violation."""

import msgspec
import pytest

from benchmarks.swarm import service as swarm_service
from benchmarks.swarm.happenings import FullDisk, Kill, Order, Plan
from benchmarks.swarm.run import run_plan
from fitctl.logging.records import Event
from fitctl.messages.commands import Shutdown, Standby, Stop, TakeOver
from fitctl.service import intake
from fitctl.service.admission import Admission
from fitctl.service.envelope import decode_envelope
from fitctl.service.service import Service

ORDERS = [
    Order(at_s=at_s, who=who, command=command)
    for at_s, who, command in (
        (0.1, "ada", None),
        (0.5, "ben", Standby()),
        (1.0, "dora", Standby()),
        (1.5, "ben", TakeOver()),
        (2.0, "ben", Stop()),
        (3.0, "cleo", Standby()),
        (8.0, "dora", Stop()),  # it is on its way when the supervisor is killed
    )
]
PLAN = Plan(
    seed=1,
    rig="fit-mock.toml",
    settings=(),
    duration_s=14.0,
    happenings=[*ORDERS, Kill(at_s=8.01, back_after_s=0.5)],
    console_loss=0.0,
)


WITHHELD = "refused without an answer"


def violated():
    return {one.invariant for one in run_plan(PLAN).violations}


@pytest.mark.long
def test_people_here_and_elsewhere_are_answered_and_nothing_is_violated():
    assert violated() == set()


@pytest.mark.long
def test_what_is_no_command_is_refused_and_reported(monkeypatch):
    monkeypatch.setattr(swarm_service, "_GARBAGE", 1.0)
    told = []

    result = run_plan(
        PLAN, lambda record: told.append(record.message) if isinstance(record, Event) else None
    )

    assert result.violations == []
    assert any("ada: " in text and "messages, no commands" in text for text in told)
    assert any("ben: " in text and "messages, no commands" in text for text in told)


def answered(times):
    answer = Service._answer

    def wrongly(self, waiting, reply):
        for _ in range(times):
            answer(self, waiting, reply)

    return wrongly


def everybody_a_commander(payload):
    return msgspec.structs.replace(decode_envelope(payload), role="commander")


@pytest.mark.long
@pytest.mark.parametrize(
    ("owner", "name", "mistake", "invariant"),
    [
        pytest.param(Service, "_answer", answered(0), "a command is answered once", id="silent"),
        pytest.param(Service, "_answer", answered(2), "a command is answered once", id="twice"),
        pytest.param(
            Admission,
            "refusal",
            lambda *_: "",
            "lease and rights are kept",
            id="everybody may do everything",
        ),
        pytest.param(
            "fitctl.service.service",
            "decode_envelope",
            everybody_a_commander,
            "a command is its sender's",
            id="another's role",
        ),
    ],
)
def test_a_mistake_of_the_service_is_found(monkeypatch, owner, name, mistake, invariant):
    if isinstance(owner, str):
        monkeypatch.setattr(f"{owner}.{name}", mistake)
    else:
        monkeypatch.setattr(owner, name, mistake)

    assert invariant in violated()


@pytest.mark.long
def test_garbage_that_is_taken_for_a_command_is_found(monkeypatch):
    monkeypatch.setattr(swarm_service, "_GARBAGE", 1.0)
    decoded = intake.decode_command

    def obliging(payload):
        command = decoded(payload)
        return command if hasattr(command, "loop") else Stop()

    monkeypatch.setattr(intake, "decode_command", obliging)

    assert "what is no command is refused" in violated()


FLOOD = msgspec.structs.replace(
    PLAN,
    duration_s=4.0,
    happenings=[
        Order(at_s=0.1, who="ada", command=Standby()),
        *[Order(at_s=1.0 + 0.01 * number, who="ben", command=Standby()) for number in range(40)],
    ],
)


@pytest.mark.long
def test_of_a_flood_of_refusals_some_are_counted_in_place_of_an_answer(monkeypatch):
    told = []

    def on_record(record):
        if isinstance(record, Event):
            told.append(record.message)

    assert run_plan(FLOOD, on_record).violations == []
    assert any("refused without an answer" in text for text in told)

    never = FLOOD.happenings[:5]  # no flood
    monkeypatch.setattr(
        intake.Intake, "answers_refusal", lambda self, name, _: bool(self.drop(name, WITHHELD))
    )
    few = run_plan(msgspec.structs.replace(FLOOD, duration_s=8.0, happenings=never))
    assert "a command is answered once" in {one.invariant for one in few.violations}


@pytest.mark.long
def test_a_command_that_is_not_answered_before_a_shutdown_is_found(monkeypatch):
    answer = Service._answer

    def silent(self, waiting, reply):
        if not isinstance(self._sent[waiting.tag][1], Standby):
            answer(self, waiting, reply)

    happenings = [
        Order(at_s=0.1, who="ada", command=Standby()),
        Order(at_s=2.0, who="ada", command=Shutdown()),
    ]
    short = msgspec.structs.replace(PLAN, duration_s=4.5, happenings=happenings)
    assert run_plan(short).violations == []
    monkeypatch.setattr(Service, "_answer", silent)

    assert "Standby of 0.100 s never was" in {one.detail for one in run_plan(short).violations}


@pytest.mark.long
def test_a_command_that_arrives_once_the_service_has_ended_is_owed_no_answer():
    """Whatever it takes until the log is finished."""
    happenings = [
        FullDisk(at_s=1.0, lasts_s=12.0),
        Order(at_s=2.0, who="ada", command=Shutdown()),
        # Some of these are answered, some are on their way back, some arrive too late.
        *(Order(at_s=1.9 + 0.02 * n, who="ben", command=Standby()) for n in range(15)),
    ]
    late = msgspec.structs.replace(PLAN, duration_s=12.0, happenings=happenings)

    assert run_plan(late).violations == []
