import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest
from can.interfaces.slcan import slcanBus

from fitctl import config
from fitctl.mocks.cia402.drive import Cia402DriveMock

STILL = (0.0, 0.0)


class IntegratingMotors:
    """Two ideal motors: the angle is the time integral of the velocity command."""

    def __init__(self) -> None:
        self.velocity_rad_s = [0.0, 0.0]
        self.enabled = [False, False]
        self._angle_rad = [0.0, 0.0]
        self._at_s = time.monotonic()
        self._lock = threading.Lock()  # the test looks while the mock's thread turns them

    def where(self) -> tuple[float, list[float]]:
        """The time now, and both angles."""
        with self._lock:
            now_s = time.monotonic()
            for axis, velocity in enumerate(self.velocity_rad_s):
                self._angle_rad[axis] += velocity * (now_s - self._at_s)
            self._at_s = now_s
            return now_s, list(self._angle_rad)

    def position_rad(self) -> list[float]:
        return self.where()[1]

    def turn_to(self, angle_rad: float) -> None:
        self._angle_rad = [angle_rad, angle_rad]

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        self.position_rad()
        self.velocity_rad_s = [az, el]

    def set_enabled(self, axis: int, enabled: bool) -> None:
        self.enabled[axis] = enabled


class Bench:
    """The mock drive in an event loop of its own thread."""

    def __init__(self, siderostat: config.Siderostat, **options: int) -> None:
        self.motors = IntegratingMotors()
        self.mock = Cia402DriveMock(siderostat, self.motors, port=0, **options)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.port = self._run(self.mock.start())
        channel = f"socket://127.0.0.1:{self.port}"
        self.siderostat = siderostat.model_copy(
            update={"device": siderostat.device.model_copy(update={"channel": channel})}
        )

    def _run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(5)

    def call(self, action: Callable[..., None], *args, **kwargs) -> None:
        """Run a plain function of the mock in its own thread."""

        async def run() -> None:
            action(*args, **kwargs)

        self._run(run())

    def stand_still(self, seconds: float) -> None:
        """Have the drive's computer stand still from now on."""
        self._loop.call_soon_threadsafe(time.sleep, seconds)

    def fault(self, kind: str, **settings) -> None:
        """Begin a fault of the drive."""
        self.call(self.mock.faults.set, config.Fault(device="right.drive", kind=kind, **settings))

    def heal(self) -> None:
        """End all faults."""
        self.call(self.mock.faults.clear)

    def close(self) -> None:
        self._run(self.mock.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)
        self._loop.close()


def wait_until(condition: Callable[[], bool], timeout_s: float = 3.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "did not happen in time"
        time.sleep(0.005)


def exchange_until(amplifiers, condition, timeout_s=3.0):
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        reading = amplifiers.exchange(STILL)
        if reading is not None and condition(reading):
            return reading
        time.sleep(0.002)
    return pytest.fail("the reading did not come")


def reading_of(amplifiers, velocity_rad_s=STILL):
    """A reading, allowing for periods that a stall of the machine ate."""
    for _ in range(50):
        reading = amplifiers.exchange(velocity_rad_s)
        if reading is not None:
            return reading
    return pytest.fail("no reading in 50 periods")


@contextlib.contextmanager
def bridged(
    bench: Bench, carry: Callable[[can.Message], list[can.Message]] = lambda message: [message]
) -> Iterator[config.Siderostat]:
    """The mock behind python-can's virtual bus, by a thread and python-can's own SLCAN.

    `carry` says what goes on of each frame, of either direction; an RPDO or SYNC it must let pass.
    """
    stock = slcanBus(f"socket://127.0.0.1:{bench.port}", bitrate=1000000, sleep_after_open=0)
    done = threading.Event()
    with can.Bus(interface="virtual", channel="bridged", ignore_config=True) as virtual:

        def bridge() -> None:
            while not done.is_set():
                for source in (virtual, stock):
                    message = source.recv(0.001)
                    if message is not None:
                        for each in carry(message):
                            (stock if is_to_drive(each) else virtual).send(each)

        thread = threading.Thread(target=bridge)
        thread.start()
        device = bench.siderostat.device.model_copy(
            update={"interface": "virtual", "channel": "bridged"}
        )
        try:
            yield bench.siderostat.model_copy(update={"device": device})
        finally:
            done.set()
            thread.join(5)
            stock.shutdown()


def is_to_drive(message: can.Message) -> bool:
    return message.arbitration_id in {0x000, 0x080, 0x201, 0x601, 0x77F}
