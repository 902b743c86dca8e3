"""Each rig of the catalogue through `fitctl commission`: real processes, real wires, real time."""

import fcntl
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from fitctl.config import default_rig_path
from fitctl.mocks.bench import StagesNow, StagesQuestion, ask_bench
from miswired.catalogue import CATALOGUE

pytestmark = pytest.mark.miswired
LOOK_S = 0.02


class Watched(threading.Thread):
    """Asks the bench where the stages truly are, whatever commissioning believes."""

    def __init__(self, port, loop):
        super().__init__(daemon=True)
        self.ending = threading.Event()
        self.port = port
        self.question = StagesQuestion(loop=loop)
        self.first = ask_bench(port, self.question, StagesNow)
        self.most_rad = self.most_v = 0.0

    def run(self):
        while not self.ending.wait(LOOK_S):
            now = ask_bench(self.port, self.question, StagesNow)
            self.most_rad = max(self.most_rad, largest(now.motor_rad, self.first.motor_rad))
            self.most_v = max(self.most_v, largest(now.stack_v, self.first.stack_v))

    def end(self):
        self.ending.set()
        self.join()


def largest(now, first):
    return max((abs(a - b) for a, b in zip(now, first, strict=True)), default=0.0)


def settings(pairs):
    return [part for pair in pairs for part in ("--set", pair)]


@contextmanager
def mocks_of(rig, wrong, exchanged=(), seed=0):
    """Mocks wired as the entry says; their endpoints, and the bench's port."""
    arguments = ["mocks", "--rig", str(rig), "--free-ports", "--json", "--seed", str(seed)]
    process = subprocess.Popen(
        [sys.executable, "-m", "fitctl", *arguments, *settings(wrong)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        endpoints = json.loads(process.stdout.readline())
        if exchanged:
            one, other = exchanged
            endpoints[one], endpoints[other] = endpoints[other], endpoints[one]
        devices = [f"{key}={value}" for key, value in endpoints.items() if key[:6] != "mocks."]
        yield devices, int(endpoints["mocks.bench_port"])
    finally:
        process.terminate()
        process.communicate(timeout=30)


ALONG = {  # keys that change with another one
    "siderostat.travel_sky_arcsec": ("siderostat.spur_gear_ratio", "focal_length_m"),
    "siderostat.spur_gear_ratio": ("focal_length_m",),
    "other_spots": ("star_flux_dn",),
    "fsm.piezo.channels": ("fsm.dac.channels",),
}


def expected(key, found):
    """Whether a key may change where the catalogue's keys must."""
    within = [one.rpartition(".")[0] for one in found if "wiring" in one or "per_v" in one]
    along = next((by for end, by in ALONG.items() if key.endswith(end)), ())
    beside = any(by in one for by in along for one in found)
    return key in found or key.rpartition(".")[0] in within or beside


def values(table, under=""):
    for key, value in table.items():
        if isinstance(value, dict):
            yield from values(value, f"{under}{key}.")
        else:
            yield f"{under}{key}", value


def steps_of(entry):
    only = [part for name in entry.only for part in ("--only", name)]
    left_out = [part for name in entry.skipped for part in ("--skip", f"{name}=another entry's")]
    return left_out + (only or ["--until", entry.step])


def rewritten(folder, rig, entry):
    """The rig file as the entry has it: the shipped one, or a copy with a line that is wrong."""
    if not entry.rewritten:
        return rig
    right, wrong = entry.rewritten
    text = rig.read_text()
    assert text.count(right) == 1
    for other in rig.parent.glob("*.toml"):  # its base too
        shutil.copy(other, folder)
    copy = folder / rig.name
    copy.write_text(text.replace(right, wrong))
    return copy


def commissioned(folder, entry):
    """What commissioning makes of an entry, and how far the stages truly moved."""
    rig = default_rig_path().with_name(entry.rig)
    with mocks_of(rig, entry.wrong, entry.exchanged) as (devices, bench_port):
        watched = Watched(bench_port, entry.loop)
        watched.start()
        # The sockets in the test's folder: several entries run beside each other.
        own = [*devices, f"service.folder={folder}/sockets", f"logging.folder={folder}"]
        began_s = time.monotonic()
        run = subprocess.run(
            [
                *(
                    sys.executable,
                    "-m",
                    "fitctl",
                    "commission",
                    "--rig",
                    str(rewritten(folder, rig, entry)),
                    "--yes",
                    "--json",
                ),
                *("--folder", str(folder), *steps_of(entry), *settings(own)),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        took_s = time.monotonic() - began_s
        watched.end()
    assert run.stdout, run.stderr
    return json.loads(run.stdout), watched, took_s


@pytest.mark.parametrize(
    "entry",
    [
        pytest.param(entry, id=entry.name, marks=pytest.mark.timeout(entry.most_s))
        for entry in CATALOGUE
    ],
)
def test_commissioning_finds_it(entry, tmp_path):
    result, watched, took_s = commissioned(tmp_path, entry)
    failed = {name: task for name, task in result["tasks"].items() if task["state"] == "failed"}
    troubles = {name: task["trouble"] for name, task in failed.items()}
    found = dict(values(result["found"]))
    remember(entry, found, troubles, watched, took_s)
    if entry.named:
        assert entry.named in " ".join(troubles.values()), result
    else:
        assert not troubles
        assert not [key for key in found if not expected(key, entry.found)]
    for key, value in entry.found.items():
        if key.endswith("_deg"):
            assert abs((found[key] - value + 180) % 360 - 180) < 3.0
        else:
            assert np.array(found[key]) == pytest.approx(np.array(value), rel=0.1, abs=0.01)
    assert watched.most_rad <= entry.most_rad
    assert watched.most_v <= entry.most_v


def remember(entry, found, troubles, watched, took_s):
    """Add the result to the file that FITCTL_MISWIRED_RESULTS names."""
    path = os.environ.get("FITCTL_MISWIRED_RESULTS")
    if not path:
        return
    with Path(path).open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # several workers write
        file.seek(0)
        results = json.loads(file.read() or "{}")
        results[entry.name] = {
            "found": found,
            "troubles": troubles,
            "most_rad": watched.most_rad,
            "most_v": watched.most_v,
            "took_s": took_s,
        }
        file.truncate(0)
        file.write(json.dumps(results, indent=1))
