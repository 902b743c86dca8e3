"""Camera and photodiodes."""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.lines import Line, identity
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import Rig
from fitctl.drivers.interface import (
    CameraCounts,
    DeviceIdentity,
    DiodeReading,
    Frame,
)
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant import Plant
from fitctl.simulation.devices import (
    SimulatedCamera,
    SimulatedPhotodiodes,
)

Floats = NDArray[np.float64]
_SILENCE = frozenset({"deaf", "mute"})
_MOST_LATE_FRAMES = 20
_DROPPED = 0.5  # of the frames


class SwarmCamera(SimulatedCamera):
    """The camera on its network: frames arrive late, all at once, or not at all."""

    def __init__(self, rig: Rig, time: VirtualTime, plant: Plant, random: Random) -> None:
        super().__init__(rig, time, plant)  # pyrefly: ignore[bad-argument-type]
        device = rig.camera.device
        self.line = Line("camera", device.endpoint, time, random, 0.002, device.response_timeout_s)
        self._time = time
        self._random = random
        self._image: NDArray[Any] | None = None  # of the newest frame
        self._full_scale_dn = rig.camera.full_scale_dn
        self._streams = False
        self._lost = 0
        self._clear_dn = self._scene._flux_dn

    def dim(self, part: float) -> None:
        """Dim all spots to a part of their light."""
        self._scene._flux_dn = self._clear_dn * part

    def open(self) -> DeviceIdentity:
        """Take control."""
        self.line.open()
        for _ in range(30):
            self.line.ask(self._nothing)
        return identity("camera")

    def start(self) -> None:
        """Begin the stream."""
        self.line.ask(super().start)
        self._lost = 0
        self._streams = True

    def next_frame(self, timeout_s: float) -> Frame | None:
        """The next frame, unless a fault withholds it."""
        faults, now_s = self.line.of_this_call(), self._time.now_s()
        if not self.line.connected or "unplugged" in faults or "garbled" in faults:
            self._time.sleep(min(timeout_s, 0.01))
            raise self.line.broken()
        exposed_s = self._start_s + self._frames * self._period_s
        late_s = 0.002 * faults.get("slow", 0.0)
        arrives_s = exposed_s + self._camera.frame_delay_s + late_s
        if not self._streams or (faults and {"deaf", "mute", "refuses"} & faults.keys()):
            self._time.sleep_until(now_s + timeout_s)
            return None
        behind = int((now_s - arrives_s) / self._period_s)
        if behind > _MOST_LATE_FRAMES:  # no buffer keeps more
            self._frames += behind
            self._lost += behind
            return self.next_frame(timeout_s)
        if arrives_s > now_s + timeout_s + 1e-9:
            self._time.sleep_until(now_s + timeout_s)
            return None
        if "drops" in self.line.wrong and self._random.random() < _DROPPED:
            self._frames += 1
            self._lost += 1
            return self.next_frame(timeout_s)
        self._time.sleep_until(arrives_s)
        self._frames += 1
        self._exposures += 1
        if self._image is None or "frozen" not in self.line.wrong:
            spots = self._plant.exposure_px(exposed_s)[0]
            noise_dn = self._plant.pixel_noise_dn(exposed_s)
            self._image = self._scene.frame(spots, self._pixel_key, self._exposures, noise_dn)
        image = self._image
        if self.line.is_wrong("saturated"):
            image = np.full_like(image, self._full_scale_dn)
        return Frame(self._frames, exposed_s, self._time.now_s(), image)

    def set_frame_rate(self, rate_hz: float) -> None:
        """Take frames at another rate, if the camera answers."""
        change = super().set_frame_rate
        self.line.ask(lambda: change(rate_hz))

    @property
    def at_other_rate(self) -> bool:
        """It does not take frames as often as the rig file says."""
        return self._streams and self._period_s != self._camera.period_s

    def counts(self) -> CameraCounts:
        """Count the frames, and the lost ones."""
        return CameraCounts(self._frames, self._lost, 0)

    def stop(self) -> None:
        """End the stream."""
        self._streams = False

    def close(self) -> None:
        """Give up control."""
        self._streams = False
        self.line.close()

    def reset(self) -> None:
        """Restart, without a stream."""
        self._streams = False
        self.line.connected = False

    def _nothing(self) -> None:
        pass


class SwarmPhotodiodes(SimulatedPhotodiodes):
    """The photodiodes' converter, on a network."""

    def __init__(
        self, plant: MetrologyPart, time: VirtualTime, rig: Rig, loop_name: str, random: Random
    ) -> None:
        super().__init__(plant, time, rig, loop_name)  # pyrefly: ignore[bad-argument-type]
        device = rig.metrology_loops[loop_name].sensor.device
        self.line = Line(
            "photodiodes", device.endpoint, time, random, 0.001, device.response_timeout_s
        )
        self._usual_s = self._round_trip_s

    def open(self) -> DeviceIdentity:
        """Connect and configure."""
        self.line.open()
        for _ in range(6):
            self.line.ask(lambda: None)
        return super().open()

    def send_request(self) -> None:
        """Request a sample."""
        if not self.line.connected or "unplugged" in self.line.faults:
            raise self.line.broken()
        super().send_request()

    def receive(self) -> DiodeReading | None:
        """The newest sample, unless a fault withholds it."""
        faults = self.line.of_this_call()
        if not self.line.connected or "unplugged" in faults:
            raise self.line.broken()
        if "garbled" in faults:
            raise self.line.garbled()
        if "refuses" in faults and self._requested_s:
            self._requested_s.clear()
            raise self.line.refused()
        self._round_trip_s = self._usual_s * faults.get("slow", 1.0)
        silent = bool(faults.keys() & _SILENCE)
        reading = None if silent else super().receive()
        if reading is not None and self.line.is_wrong("saturated"):
            reading = reading._replace(volts=(self._range_v,) * 4)
        if reading is not None and (loose := self.line.wrong_by("loose")) is not None:
            one, two, three, four = (
                0.0 if number == loose else volt for number, volt in enumerate(reading.volts)
            )
            reading = reading._replace(volts=(one, two, three, four))
        now_s = self._clock.now_s()
        if reading is not None or not self._requested_s:
            return reading
        if now_s - self._requested_s[0] > self.line.timeout_s:
            self._requested_s.clear()
            raise self.line.timeout()
        return None

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """Restart."""
        self.line.connected = False
