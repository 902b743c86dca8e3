"""Defects that fitctl once had, put back one at a time: what the swarm must find, and how soon it does.

Each is a patch of today's code that acts as the code did before its commit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

from fitctl.config import HALF_WINDOW_PX, Rig
from fitctl.controllers.attribution import is_within
from fitctl.controllers.centroid import Star
from fitctl.controllers.position_servo import PositionServo
from fitctl.drivers.interface import AzEl, Frame, ServoReading
from fitctl.logging.records import StarPlace
from fitctl.loop.loop import Loop
from fitctl.loop.metrology import MetrologyLoop
from fitctl.loop.observation import Observation
from fitctl.loop.search.attribution import Attribution
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import AnyCommand, Experiment, Reply
from fitctl.messages.modes import Mode, Trigger
from fitctl.model.drives import Drive
from fitctl.sequences.contact import Contact
from fitctl.sequences.view import View
from fitctl.service import service
from fitctl.stages.injector import Injector
from fitctl.stages.mirror import MirrorStage
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.siderostat import SiderostatStage
from fitctl.supervisor import supervisor
from fitctl.supervisor.camera_watch import CameraWatch
from fitctl.supervisor.device_jobs import DeviceJobs
from fitctl.supervisor.loop_commands import obey_loop_command
from fitctl.supervisor.piezo import PiezoWatch
from fitctl.supervisor.supervisor import Posted, Supervisor


class Defect(NamedTuple):
    """One defect.

    Attributes
    ----------
    commit : str
        That mended it.
    what : str
    patches : sequence of (object, str, Any)
        Class or module, attribute, and what it was.
    """

    commit: str
    what: str
    patches: Sequence[tuple[object, str, Any]]


def _post_waits(
    self: Supervisor,
    command: AnyCommand,
    reply: Callable[[Reply], None],
    sender: str = "",
    address: str = "",
) -> None:
    self._commands.append(Posted(command, reply, sender, address))


def _ask_while_dac_ready(self: PiezoWatch) -> None:
    if self._loop.mirror.ready:
        _ASK(self)


def _holds_any_beam(self: MetrologyLoop, sensed: Any, duration_s: float) -> None:
    self._turn_beam(self.hold.step(self._error_rad(sensed.beam), duration_s))


def _obey_for_the_present_loop(self: Contact, view: View) -> None:
    had_steps, self.loops = self.loops, {view.loop_name: None}
    try:
        _OBEY(self, view)
    finally:
        self.loops = had_steps


def _oldest_frame(self: CameraWatch, _meanwhile: Callable[[], float]) -> Frame | None:
    self.older.clear()
    if not self.ready:
        self._clock.sleep_until(self._clock.now_s() + self._period_s)
        return None
    try:
        frame = self._camera.next_frame(2 * self._period_s)
    except Exception as error:
        self.ready = False
        self._failed(error)  # pyrefly: ignore[bad-argument-type]
        return None
    if frame is not None:
        self._last_frame_s = self._clock.now_s()
    return frame


def _steer_by_any_reading(self: SiderostatServo, *arguments: Any) -> None:
    _SERVO_INIT(self, *arguments)
    self._blind_s = math.inf


def _find_position_as_a_jump(self: SiderostatServo) -> None:
    _FIND_POSITION(self)
    self.encoders_jumped = self.encoders_jumped or self.turned_on_rad > 0.0


def _find_position_by_answers(self: SiderostatServo) -> None:
    del self._unread[1:]
    _FIND_POSITION(self)


def _find_position_by_newest_command(self: SiderostatServo) -> None:
    del self._unread[:-1]
    _FIND_POSITION(self)


def _turns_round_at_once(self: PositionServo, *arguments: Any) -> None:
    _POSITION_SERVO_INIT(self, *arguments)
    self.brake_rad = math.inf


def _open_unread(self: SiderostatServo) -> Any:
    self._stopped = True
    self.fault = None
    self.opened = self.enabled = False
    identity = self._amplifiers.open()
    self._amplifiers.reset_fault()
    self._amplifiers.enable()
    self.opened = self.enabled = True
    self._timely.feed(self._clock.now_s())
    return identity


def _one_slot(self: Loop, source: str, reason: str) -> None:
    changed = self.fire(Trigger.FAULT, reason)
    if not changed and all(reason != known for _, known in self._failures):
        self._report_event("error", reason)
    self._failures.clear()
    self._failures.append((source, reason))


def _go_on_as_before(self: SiderostatServo, _position_rad: AzEl) -> None:
    self._blind = False


def _judges_late_readings(
    self: SiderostatServo, reading: ServoReading | None, asked_s: float
) -> None:
    is_late = reading is not None and self._clock.now_s() - reading.time_s > self._blind_s
    blind, self._blind = self._blind, self._blind and not is_late
    try:
        _SERVO_BY(self, reading, asked_s)
    finally:
        self._blind = self._blind or (blind and is_late)


def _designs_with_devices(self: Supervisor, *arguments: Any, **options: Any) -> None:
    options["design_executor"] = None
    _SUPERVISOR_INIT(self, *arguments, **options)


def _goes_on_in_a_fault(self: SiderostatServo, now_s: float) -> AzEl:
    return self._velocity_rad_s(now_s)


def _fail_and_go_on(self: SiderostatServo, error: Exception) -> None:
    stopped = self._stopped
    _FAIL(self, error)
    self._stopped = stopped


def _goes_on_in(mode: Mode) -> Callable[[Loop, Mode, Any], None]:
    """Entering a mode leaves the motors as they are."""

    def enter(self: Loop, source: Mode, motor_rad: Any) -> None:
        if self.mode is not mode:
            _ENTER(self, source, motor_rad)

    return enter


def _has_left_its_place(self: Attribution, star: Star, _others: object) -> bool:
    """Accept whatever star is where the own one is expected."""
    if self.candidate is None:
        return False
    return not is_within(*star[:2], *self.candidate[:2], HALF_WINDOW_PX)


def _without_collector(self: Supervisor, loop: Loop, *, was_safe: bool) -> None:
    if was_safe:
        _MAKE_SAFER(self, loop, was_safe=True)


def _experiment_though_it_waits(rig: Rig, loops: Sequence[Loop], command: AnyCommand) -> str:
    with ExitStack() as stack:
        for loop in loops if isinstance(command, Experiment) else ():
            stack.enter_context(patch.object(loop, "waits_for", "", create=True))
        return obey_loop_command(rig, loops, command)


def _experiments_on(self: StellarLoop, observation: Observation) -> None:
    if self.waits_for and self.mode is Mode.EXPERIMENT:
        self.waits_for = self._why_wait(observation.now_s, observation.motor_rad)
    else:
        _EVALUATE_WAITING(self, observation)


def _starts_at_the_bias(self: Injector, drives: list[Drive], start_s: float, stack_v: Any) -> None:
    _INJECT(self, drives, start_s, 0.0 * stack_v + self._bias_v)


def _find_nothing(self: MirrorStage) -> None:
    self._known_s = self._clock.now_s()


def _recalls_without_link(self: StellarLoop, place: StarPlace) -> None:
    _RECALL(self, place)
    self.star_motion.link_counts = False


def _counts_from_the_search(self: StellarLoop, motor_rad: Any) -> None:
    known = self.star_finder.estimator.origin_px is not None
    motion = self.star_motion
    if motion.link is not None and known and not motion.link_counts:
        motion.link.set_origin()
        motion.link_counts = True
    _START_SEARCH(self, motor_rad)


_ASK = PiezoWatch.ask
_INJECT = Injector.start
_RECALL = StellarLoop.recall
_START_SEARCH = StellarLoop._start_search
_EVALUATE_WAITING = StellarLoop._evaluate_waiting
_SERVO_INIT = SiderostatServo.__init__
_FIND_POSITION = SiderostatServo._find_position
_OBEY = Contact._obey
_SERVO_BY = SiderostatServo._servo_by
_POSITION_SERVO_INIT = PositionServo.__init__
_FAIL = SiderostatServo._fail
_ENTER = Loop._enter
_SUPERVISOR_INIT = Supervisor.__init__
_MAKE_SAFER = Supervisor._make_safer

DEFECTS = {
    "power-race": Defect(
        "ec1ab20",
        "amplifiers lose their power between being opened and STANDBY",
        [(DeviceJobs, "opens", lambda _self, _name: False)],
    ),
    "repeated-off": Defect(
        "a0d343e",
        "each `off` that is refused moves the mirror one step more",
        [(StellarLoop, "rest", lambda self: self.mirror.step_to_bias())],
    ),
    "piezo-by-dac": Defect(
        "a0d343e",
        "the piezo amplifier is not read once the D/A has failed",
        [(PiezoWatch, "ask", _ask_while_dac_ready)],
    ),
    "late-stop": Defect(
        "like 6448f81",
        "a stop waits for the next tick, behind whatever that waits for",
        [(Supervisor, "post", _post_waits)],
    ),
    "stop-while-opening": Defect(
        "4a793ee",
        "a stop while devices open is overtaken by STANDBY",
        [(DeviceJobs, "abandon", lambda _self, _names: None)],
    ),
    "one-slot": Defect(
        "a0d343e",
        "the last failure has one slot: two that alternate are reported at every tick",
        [(Loop, "fail", _one_slot)],
    ),
    "design-with-devices": Defect(
        "89687bc",
        "the device thread makes designs too, and the piezo amplifier is not read meanwhile",
        [(Supervisor, "__init__", _designs_with_devices)],
    ),
    "old-readings": Defect(
        "df0a423",
        "the servo steers by readings of any age",
        [(SiderostatServo, "__init__", _steer_by_any_reading)],
    ),
    "stall-is-stuck": Defect(
        "f6dc181",
        "motors that turned on while the computer stood still are a following error",
        [(SiderostatServo, "_go_on_from", _go_on_as_before)],
    ),
    "late-is-stuck": Defect(
        "86e6328",
        "motors that turned on while readings came late are a following error",
        [(SiderostatServo, "_servo_by", _judges_late_readings)],
    ),
    "star-forgotten": Defect(
        "f9f5b71",
        "motors that turned on while amplifiers did not answer are encoders with another zero",
        [(SiderostatServo, "_find_position", _find_position_as_a_jump)],
    ),
    "unanswered-turn": Defect(
        "069db82",
        "motors that turned on at a command whose answer never came are encoders with another zero",
        [(SiderostatServo, "_find_position", _find_position_by_answers)],
    ),
    "slow-turn": Defect(
        "183d275",
        "motors that turned on at commands which a slow line held back are encoders with another zero",
        [(SiderostatServo, "_find_position", _find_position_by_newest_command)],
    ),
    "turn-is-stuck": Defect(
        "069db82",
        "a siderostat that turns round at full speed is a stuck axis",
        [(PositionServo, "__init__", _turns_round_at_once)],
    ),
    "powered-unread": Defect(
        "bf6a8c0",
        "motors get power before their encoders are read",
        [(SiderostatServo, "_open", _open_unread)],
    ),
    "oldest-frame": Defect(
        "a0d343e",
        "after a stall the loop acts on the oldest frame, and stays behind",
        [(CameraWatch, "next_frame", _oldest_frame)],
    ),
    "watchdog-step": Defect(
        "0e8a60f",
        "a mirror that the D/A's own watchdog moved steps back to where it was",
        [(MirrorStage, "find_after_pause", _find_nothing)],
    ),
    "killed-in-a-search": Defect(
        "029a746",
        "a supervisor that follows a killed one does not know where the star was",
        [(Supervisor, "recall", lambda _self, _places: None)],
    ),
    "link-counts-late": Defect(
        "ebad60e7",
        "behind a supervisor that was killed, what a link turns before the first search counts for nothing",
        [
            (StellarLoop, "recall", _recalls_without_link),
            (StellarLoop, "_start_search", _counts_from_the_search),
        ],
    ),
    "travel-cuts-off": Defect(
        "5a4c1678",
        "what a link turns beyond the other siderostat's travel is lost when it turns back",
        [
            (SiderostatStage, "undo", SiderostatStage.move_by),
            (MetrologyLoop, "_hold_beam", _holds_any_beam),
        ],
    ),
    "moves-in-a-fault": Defect(
        "bf6a8c0",
        "motors are servoed on after a fault",
        [
            (SiderostatServo, "_wanted_rad_s", _goes_on_in_a_fault),
            (SiderostatServo, "_fail", _fail_and_go_on),
            (Loop, "_enter", _goes_on_in(Mode.SAFE)),
        ],
    ),
    "others-star": Defect(
        "883ec1c, bbf69a4",
        "a search accepts another loop's star that a jog or a link moves to where its own is expected",
        [(Attribution, "has_moved", _has_left_its_place)],
    ),
    "collector-in-safe": Defect(
        "fbf2d6c",
        "the collector goes on when a loop goes to SAFE",
        [(Supervisor, "_make_safer", _without_collector)],
    ),
    "experiment-waits": Defect(
        "746ffba",
        "an experiment begins with a loop that waits for its link, and does not end",
        [
            (supervisor, "obey_loop_command", _experiment_though_it_waits),
            (StellarLoop, "_evaluate_waiting", _experiments_on),
        ],
    ),
    "bias-at-once": Defect(
        "f765651b",
        "an experiment that begins with the mirror off its bias writes the bias at once",
        [(Injector, "start", _starts_at_the_bias)],
    ),
    "obeyed-late": Defect(
        "223a2238",
        "a command that waited for a supervisor that stood still is carried out long after it was sent",
        [(module, "why_too_late", lambda _command, _now_s: "") for module in (service, supervisor)],
    ),
    "sequence-in-safe": Defect(
        "9802f29",
        "a sequence goes on though a loop of one of its steps is SAFE, if another has the present step",
        [(Contact, "_obey", _obey_for_the_present_loop)],
    ),
    "slews-while-held": Defect(
        "fb3099c6",
        "a siderostat that a search or a return sent far away slews on while an interlock holds its loop",
        [
            (StellarLoop, "_rest_search", lambda *_, **__: None),
            (StellarLoop, "_rest_return", lambda *_, **__: None),
        ],
    ),
    "jog-in-off": Defect(
        "ac43419",
        "a jog goes on in OFF until the amplifiers have lost their power",
        [(Loop, "_enter", _goes_on_in(Mode.OFF))],
    ),
}
"""By name."""


@contextmanager
def put_back(name: str) -> Iterator[None]:
    """Have a defect meanwhile; without a name, none."""
    with ExitStack() as stack:
        for owner, attribute, was in DEFECTS[name].patches if name else ():
            stack.enter_context(patch.object(owner, attribute, was, create=True))
        yield
