"""Records to log, and the recorder as a process of its own."""

import contextlib
import resource
import subprocess
import sys
import time
import zlib
from pathlib import Path

import msgspec
import numpy as np

from fitctl.config import Logging
from fitctl.logging.reading import read_records
from fitctl.logging.records import (
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    ModeChange,
    PiezoReading,
    RecorderStatus,
    RunInfo,
    Tick,
)
from fitctl.logging.writer import LogWriter

WALL_S = 1_795_000_100.5
SETTINGS = Logging(
    folder="logs",
    chunk_bytes=16384,
    flush_s=0.2,
    queue_records=256,
    compression="zstd",
    rotate_bytes=1_000_000_000,
    rotate_s=3600.0,
    retain_bytes=2_000_000_000,
    retain_days=365.0,
)
SMALL_CHUNKS = SETTINGS.model_copy(update={"chunk_bytes": 4096})
RUN_INFO = RunInfo(
    time_s=100.0,
    wall_minus_monotonic_s=1_795_000_000.25,
    rig_name="bench",
    rig_json='{"name": "bench"}',
    versions={"fitctl": "0.1.0"},
    scheduling="SCHED_FIFO 50",
    random_seed=7,
    designs={"right": '{"name": "eq20"}'},
    dark_npy=b"\x93NUMPY and so on",
)
_VALUES = {float: 0.125, int: 3, bool: True, str: "right", bytes: b"\x01\x02"}


def filled(kind, **values):
    """A record with something other than zero in every field."""
    fields = msgspec.structs.fields(kind)
    return kind(**{f.name: _VALUES[f.type] for f in fields if f.type in _VALUES} | values)


def tick(number, **values):
    return filled(Tick, **({"number": number, "time_s": 100.0 + 0.02 * number} | values))


def one_of_each():
    return [
        tick(1, mode="VERNIER", star_az_px=float("nan"), fsm_saturated=False),
        filled(FrameRecord, camera="focal plane", number=41, width_px=3, height_px=2, data=bytes(range(12))),
        filled(ModeChange, source="COARSE", target="VERNIER", target_number=4),
        Event(time_s=101.0, severity="warning", source="loop right", message="star lost"),
        filled(LoopTiming),
        filled(PiezoReading),
        filled(DeviceHealth, state="ok"),
        filled(RecorderStatus),
    ]  # fmt: skip


def frame(number, **values):
    noise = np.random.default_rng(number).integers(0, 65536, 1600, dtype="<u2")
    known = {"number": number, "camera": "cam", "width_px": 40, "height_px": 40}
    return filled(FrameRecord, **known | {"data": noise.tobytes()} | values)


def write_log(path, records, log_settings=SETTINGS, start_s=WALL_S):
    """A finished log whose log times are a second apart."""
    with LogWriter(path, log_settings) as writer:
        for number, record in enumerate(records):
            writer.write(record, start_s + number)
    return path


def contents(path):
    return [
        (entry.topic, entry.sequence, zlib.crc32(entry.message.SerializeToString()))
        for entry in read_records(path)
    ]


@contextlib.contextmanager
def files_end_at(size_bytes):
    """A disk that is full once a file is so large."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


RECORDER = """
import signal, sys, threading
from pathlib import Path
import msgspec
from fitctl.config import Logging
from fitctl.logging.recorder import record

stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
record(
    sys.argv[1],
    Logging(**msgspec.json.decode(sys.argv[3])),
    rig_name="bench",
    folder=Path(sys.argv[2]),
    stop=stop,
    on_status=lambda status: print(status.records, status.lost, flush=True),
)
"""


def recorder_command(endpoint, folder, settings=SETTINGS):
    return [sys.executable, "-c", RECORDER, endpoint, str(folder), settings.model_dump_json()]


def start_recorder(endpoint, folder, settings=SETTINGS, **options):
    command = recorder_command(endpoint, folder, settings)
    return subprocess.Popen(command, stdout=subprocess.PIPE, **options)


def wait_until(condition, timeout_s=10.0):
    deadline_s = time.monotonic() + timeout_s
    while not (result := condition()):
        assert time.monotonic() < deadline_s, "it did not happen in time"
        time.sleep(0.005)
    return result


def logs_in(folder: Path):
    return sorted(folder.glob("*.mcap"))
