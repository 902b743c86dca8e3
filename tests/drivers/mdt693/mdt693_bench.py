"""A mock MDT693 on a loop of another thread, and drivers for it."""

from contextlib import contextmanager

from fitctl.config import Fault, default_rig_path, load_rig
from fitctl.drivers.mdt693.driver import Mdt693

RIG = load_rig(default_rig_path())
PIEZO = RIG.loops["right"].fsm.piezo.model_copy(update={"response_timeout_s": 0.4})
SETTINGS = RIG.mocks.loops["right"].mdt693.model_copy(
    update={
        "reply_s": 0.005,
        "readback_offset_v": 0.0,
        "readback_noise_v": 0.0,
        "readback_settling_s": 0.0,
    }
)


@contextmanager
def opened(port, **changes):
    """A driver, open meanwhile."""
    driver = Mdt693(PIEZO.model_copy(update={"port": port, **changes}))
    try:
        driver.identity = driver.open()
        yield driver
    finally:
        driver.close()


class Bench:
    """A mock on a loop of another thread, and drivers for it."""

    def __init__(self, mock, ends, in_loop):
        self.mock, self.in_loop = mock, in_loop
        self.amplifier, self.controller = mock.amplifier, mock.controller
        self.pty = ends.pty_path
        self.tcp = f"socket://127.0.0.1:{ends.tcp_port}"

    def do(self, action, *arguments):
        """Call something of the mock in its own thread."""

        async def done():
            return action(*arguments)

        return self.in_loop(done())

    def set_fault(self, kind, **settings):
        self.do(self.mock.faults.set, Fault(device="right.mdt693", kind=kind, **settings))

    def clear_faults(self):
        self.do(self.mock.faults.clear)

    def opened(self, port="", **changes):
        """An open driver, on the pty if not said otherwise."""
        return opened(port or self.pty, **changes)
