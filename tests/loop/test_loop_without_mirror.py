"""A loop that has a siderostat and no mirror is supervised like any other."""

import math

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.drivers.interface import Devices, LoopDevices
from fitctl.logging.records import DeviceHealth, DevicesOpened, LoopTiming, Tick
from fitctl.loop.loop import Loop
from fitctl.loop.quantities import Quantities
from fitctl.messages.commands import Off, Standby, Stop
from fitctl.messages.modes import Mode
from fitctl.simulation.devices import InlineExecutor
from fitctl.simulation.simulation import Simulation
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.siderostat import SiderostatStage
from fitctl.supervisor.supervisor import Supervisor

DEFAULTS = {"int": 0, "float": math.nan, "str": "", "bool": False}
NOTHING = {name: DEFAULTS[kind] for name, kind in Tick.__annotations__.items()}


class Watcher(Loop):
    """Senses that a frame came, and leaves the siderostat where it is; it looks for nothing."""

    place = None

    def recall(self, place):
        raise NotImplementedError

    def sense(self, frame, frames_lost, frames_skipped):
        self.number, self.begun_s = -1 if frame is None else frame.number, self._clock.now_s()

    def decide(self):
        self._evaluate_interlocks(self.begun_s)

    def send(self):
        pass

    confirm = send

    def state(self, now_s):
        raise NotImplementedError

    def tick_record(self):
        known = {"loop": self.name, "number": self.number, "mode": self.mode.name}
        return Tick(time_s=self._clock.now_s(), **NOTHING | known)


def test_it_is_opened_ticked_stopped_and_turned_off():
    rig = load_rig(default_rig_path()).model_copy(update={"interlocks": {}})  # it measures nothing
    with_mirror = Simulation(rig, 0)
    amplifiers = with_mirror.devices.loops["right"].amplifiers
    devices = Devices(with_mirror.camera, {"right": LoopDevices(amplifiers)})

    def make_loop(name, rig, devices, journal, _design):
        servo = SiderostatServo(name, rig.loops[name], devices.amplifiers, journal.clock, 0.02)
        return Watcher(
            name, rig, SiderostatStage(rig, name, servo), journal, Quantities(rig, name), {}
        )

    records, replies = [], []
    supervisor = Supervisor(
        rig, devices, with_mirror.clock, InlineExecutor(), records.append, design_for, make_loop
    )
    with_mirror.camera.on_servo_period = [
        (work.period_s, work.period) for work in supervisor.periodic
    ]
    modes = []
    for command in (Standby(), Stop(), Off()):
        supervisor.post(command, replies.append)
        for _ in range(100):
            supervisor.step()
        modes.append(supervisor.loops["right"].mode)

    assert [reply.accepted for reply in replies] == [True] * 3, replies
    assert modes == [Mode.STANDBY, Mode.SAFE, Mode.OFF]
    assert {r.device for r in records if isinstance(r, DeviceHealth)} == {
        "camera",
        "right siderostat",
    }
    assert any(isinstance(record, LoopTiming) and record.ticks > 40 for record in records)
    (opened,) = (record for record in records if isinstance(record, DevicesOpened))
    assert not opened.error
    assert supervisor.at_rest()
