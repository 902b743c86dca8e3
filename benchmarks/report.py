"""The report of a whole night: what it takes in time and in room.

A simulated log, frames and all, is repeated end to end, with the times in its headers moved, into one file an
hour. A process of its own then makes their report, as a user would. Time is the processor's, which others' work
on the machine disturbs least; room is the most that it held.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import msgspec
from mcap.reader import SeekingReader
from mcap.writer import CompressionType, Writer

from fitctl.config import default_rig_path, load_rig
from fitctl.daemon.run import run_info
from fitctl.logging.records import AnyRecord
from fitctl.logging.writer import LogWriter
from fitctl.simulation.simulation import Simulation

PART_S = 600.0
PARTS_A_FILE = 6
RIG = load_rig(default_rig_path())


def simulate(path: Path, duration_s: float) -> None:
    """A run on the virtual clock that acquires and holds its star, as a recorder would have it."""
    info = msgspec.structs.replace(
        run_info(RIG, "simulated", 0.0, designs={}), wall_minus_monotonic_s=1.8e9
    )
    with LogWriter(path, RIG.logging) as log:

        def take(record: AnyRecord) -> None:
            log.write(record, info.wall_minus_monotonic_s + simulation.clock.now_s())

        log.write(info, info.wall_minus_monotonic_s)
        simulation = Simulation(RIG, seed=0, record=take)
        simulation.acquire()
        simulation.run(duration_s)


def repeat(source: Path, target: Path, times: range, part_s: float) -> None:
    """Copy a log end to end, later by `part_s` each time."""
    with source.open("rb") as stream, target.open("wb") as file:
        reader = SeekingReader(stream)
        size = RIG.logging.chunk_bytes
        writer = Writer(file, chunk_size=size, compression=CompressionType.ZSTD)
        writer.start(library="fitctl")
        for entry in reader.iter_metadata():
            writer.add_metadata(entry.name, entry.metadata)
        channels: dict[int, int] = {}
        for turn in times:
            later_ns = round(turn * part_s * 1e9)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                if channel.id not in channels:
                    if schema is None:
                        raise SystemExit(f"{source}: {channel.topic} has no schema")
                    kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, kind
                    )
                writer.add_message(
                    channel_id=channels[channel.id],
                    log_time=message.log_time + later_ns,
                    publish_time=message.publish_time + later_ns,
                    sequence=message.sequence,
                    data=message.data,
                )
        writer.finish()


def make_night(folder: Path, hours: int) -> None:
    """Eight hours are 2.7 GB and take some minutes."""
    part = folder / "part"
    simulate(part, PART_S)
    for hour in range(hours):
        turns = range(hour * PARTS_A_FILE, (hour + 1) * PARTS_A_FILE)
        repeat(part, folder / f"night_{hour}.mcap", turns, PART_S)
    part.unlink()


def measure(folder: Path) -> dict[str, float]:
    """The report of a folder's logs, in a process of its own: s and MB."""
    command = [sys.executable, "-m", "fitctl", "report", str(folder)]
    command += ["--out", str(folder / "report")]
    begin_s = time.monotonic()
    process = subprocess.Popen(command)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"the report ended with {process.returncode}")
    return {
        "processor_s": used.ru_utime + used.ru_stime,
        "taken_s": time.monotonic() - begin_s,
        "most_mb": used.ru_maxrss * 1024 / 1e6,
        "logs_mb": sum(path.stat().st_size for path in folder.glob("*.mcap")) / 1e6,
    }


def main() -> None:
    """Print the figures as one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=int, default=8)
    parser.add_argument(
        "--folder", type=Path, help="logs are made here and kept, or taken from here"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        if not list(folder.glob("*.mcap")):
            # In a process of its own: Linux counts the most that this one ever held as its children's too.
            with ProcessPoolExecutor(1, get_context("spawn")) as maker:
                maker.submit(make_night, folder, arguments.hours).result()
        print(json.dumps(measure(folder), indent=1))


if __name__ == "__main__":
    main()
