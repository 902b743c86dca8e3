"""Three siderostats' servos at 500 Hz beside one: how late they are, and what they and the mocks cost.

The servos are the rig's own, on threads as the supervisor has them, without the frame loop; the mocks of the
whole testbed are a process of their own, whose camera and photodiodes nobody reads. Each case lasts so long:
one servo, three on a CAN bus each with a thread each, the same on one thread, and three on one bus.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import psutil

from fitctl.clock import MonotonicClock
from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.daemon.devices import AMPLIFIERS, rig_devices
from fitctl.drivers.interface import Devices
from fitctl.stages.periodic import Periodic, PeriodicThread
from fitctl.stages.realtime import bound_memory, lock_memory, quiet_interpreter
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.servo_group import servo_groups

TESTBED = default_rig_path().with_name("fit-testbed.toml")
SHARED = tuple(
    f"loops.{name}.siderostat.device.{setting}"
    for node, name in enumerate(("right", "metrology", "left"), 1)
    for setting in ("channel=socket://127.0.0.1:29536", f"node_id={node}")
)


class Case(NamedTuple):
    """What is servoed: how many loops, on which buses, and whether one thread has them all."""

    name: str
    loops: int
    settings: Sequence[str] = ()
    one_thread: bool = True


CASES = (
    Case("one servo", 1),
    Case("three buses, a thread each", 3, one_thread=False),
    Case("three buses, one thread", 3),
    Case("one bus, one thread", 3, SHARED),
)


@contextmanager
def mocks(settings: Sequence[str]) -> Iterator[tuple[psutil.Process, list[str]]]:
    """The testbed's mocks; their process, and where they listen."""
    sets = [part for setting in settings for part in ("--set", setting)]
    command = ["mocks", "--free-ports", "--json", "--rig", str(TESTBED), *sets]
    with subprocess.Popen(
        [sys.executable, "-m", "fitctl", *command], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            first_line = process.stdout.readline() if process.stdout else ""
            endpoints = json.loads(first_line)
            where = [f"{key}={value}" for key, value in endpoints.items() if key[:6] != "mocks."]
            yield psutil.Process(process.pid), where
        finally:
            process.terminate()


def without_buses(rig: Rig) -> Devices:
    """The rig's devices, each drive with a connection, and so a thread, of its own."""
    devices = rig_devices(rig)
    loops = {
        name: replace(
            loop,
            amplifiers=AMPLIFIERS["cia402"](rig.loops[name].siderostat),
            bus=None,
        )
        for name, loop in devices.loops.items()
    }
    return replace(devices, loops=loops)


def measure(case: Case, duration_s: float) -> dict[str, Any]:
    """Run one case; lateness over all periods of the first servo in us, and shares of one core."""
    with mocks(case.settings) as (served, where):
        rig = load_rig(TESTBED, [*case.settings, *where])
        clock = MonotonicClock()
        devices = rig_devices(rig) if case.one_thread else without_buses(rig)
        servos = {
            name: SiderostatServo(
                name, rig.loops[name], devices.loops[name].amplifiers, clock, rig.camera.period_s
            )
            for name in list(rig.loops)[: case.loops]
        }
        groups = servo_groups(devices, servos, clock)
        work: list[Periodic] = list(groups) or list(servos.values())
        threads = [PeriodicThread(each, clock) for each in work]
        for thread in threads:
            thread.start()
        try:
            for servo in servos.values():
                servo.open()
                servo.hold(servo.position_rad)
            time.sleep(1.0)
            for servo in servos.values():
                servo.drain_timing()
            return case_figures(case, servos, served, duration_s)
        finally:
            for servo in servos.values():
                servo.close()
            for thread in threads:
                thread.stop()


def case_figures(
    case: Case,
    servos: dict[str, SiderostatServo],
    served: psutil.Process,
    duration_s: float,
) -> dict[str, Any]:
    """What a case gives within the duration."""
    me = psutil.Process()
    before = cpu_s(me), cpu_s(served)
    began_s = time.monotonic()
    late_s: list[float] = []
    missed = skipped = 0
    round_trips_s = []
    while time.monotonic() < began_s + duration_s:
        time.sleep(1.0)
        for servo in servos.values():
            timing = servo.drain_timing()
            late_s += timing.late_s
            missed += timing.missed_readings
            skipped += timing.skipped
            round_trips_s.append(servo.round_trip_s)
    took_s = time.monotonic() - began_s
    faults = [str(servo.fault) for servo in servos.values() if servo.fault is not None]
    median, most, worst = np.percentile(late_s, [50, 99, 100]) * 1e6
    return {
        "case": case.name,
        "periods": len(late_s),
        "late_median_us": round(float(median)),
        "late_99_us": round(float(most)),
        "late_worst_us": round(float(worst)),
        "round_trip_median_us": round(float(np.median(round_trips_s)) * 1e6),
        "missed": missed,
        "skipped": skipped,
        "servos_of_a_core": round((cpu_s(me) - before[0]) / took_s, 3),
        "mocks_of_a_core": round((cpu_s(served) - before[1]) / took_s, 3),
        "faults": faults,
    }


def cpu_s(process: psutil.Process) -> float:
    """Processor time so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def main() -> None:
    """Print one JSON object a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=30.0, help="seconds a case")
    duration_s = parser.parse_args().duration
    bound_memory()
    lock_memory()
    quiet_interpreter()
    for case in CASES:
        print(json.dumps(measure(case, duration_s)), flush=True)


if __name__ == "__main__":
    main()
