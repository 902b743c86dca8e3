"""The rigs on which entries run: which file, what differs from it, and where it runs."""

import subprocess
from collections.abc import Callable, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import pytest
from instruments.served import free_port
from system.conftest import NEAR, end, running

from fitctl.config import default_rig_path

from .ledger import settle
from .watched import WatchedRig

# Seconds less for each entry: the star is nearby and pulled in fast, the mirror takes over early, and the
# piezo amplifier, which is asked some thirty things when it is opened, answers sooner than real ones.
SOON = (
    NEAR,
    "loops.right.coarse.gain_rad_per_m=9700.0",
    "loops.right.coarse.reach_fraction=0.3",
    "mocks.loops.right.mdt693.reply_s=0.005",
)
OWN_MOUNT = 'mount -t tmpfs -o size=64m tmpfs "$0" && echo ready && exec sleep infinity'


def plainly(_stack, _folder):
    """As it is."""
    return (), None


def on_a_disk_of_its_own(stack, folder):
    """The log folder is a small disk that the supervisor alone sees, in a mount namespace of its own."""
    holder = subprocess.Popen(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", OWN_MOUNT, str(folder)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    stack.callback(lambda: (end(holder), holder.stdout.close()))
    if holder.stdout.readline() != "ready\n":
        pytest.skip("needs a mount namespace of its own, which this machine does not give to users")
    enter = ("nsenter", "--target", str(holder.pid), "--user", "--mount", "--preserve-credentials")
    return enter, Path(f"/proc/{holder.pid}/root")


def patched(patch, variable, file):
    """Its Python imports the sitecustomize of a folder beside this module, which goes by a file."""

    def where(_stack, folder):
        path = f"{Path(__file__).parent / patch}:{Path.cwd()}"
        return ("env", f"PYTHONPATH={path}", f"{variable}={folder / file}"), None

    return where


HOLDS = MappingProxyType({"right": "VERNIER"})


class Setup(NamedTuple):
    """One rig; `home` is the mode to which each loop comes back, `where` says what it runs in.

    In settings, ``{folder}`` is a folder of its own, and ``{port}`` a free one, another in each.
    """

    file: str = "fit-mock"
    settings: tuple[str, ...] = ()
    home: Mapping[str, str] = HOLDS
    where: Callable = plainly


NEVER_IN_REACH = ("loops.right.coarse.reach_frames=1000000",)
BY_TCP = (
    "service.tcp_address=127.0.0.1",
    "service.command_port={port}",
    "service.telemetry_port={port}",
    "service.keys_folder={folder}/keys",
    "service.metrics_port={port}",
)
# Star and beam nearby, as the right star is by SOON; the collector moves at most 0.3 mm/s, and stays near.
TESTBED = (
    "plant.loops.left.star_offset_sky_arcsec_max=5.0",
    "plant.loops.metrology.beam_offset_sky_arcsec_max=20.0",
    "loops.left.coarse.gain_rad_per_m=9700.0",
    "loops.left.coarse.reach_fraction=0.3",
    "mocks.loops.left.mdt693.reply_s=0.005",
    "mocks.hexapod.reference_s=0.5",
    "collector.motion.kind=sine",
    "collector.motion.amplitude_mm=0.4",
    "collector.motion.frequency_hz=0.125",
)
CAN_BUS = tuple(
    f"loops.{name}.siderostat.device.{setting}"
    for node, name in enumerate(("right", "metrology", "left"), 1)
    for setting in ("channel=socket://127.0.0.1:29536", f"node_id={node}")
)
SETUPS = {
    "fit-mock": Setup(),
    "fit-testbed": Setup(
        file="fit-testbed",
        settings=TESTBED,
        home={"metrology": "LOCKED", "right": "VERNIER", "left": "VERNIER"},
    ),
    "one bus": Setup(
        file="fit-testbed",
        settings=(*TESTBED, *CAN_BUS),
        home={"metrology": "LOCKED", "right": "VERNIER", "left": "VERNIER"},
    ),
    "short pauses": Setup(settings=("loops.right.acquisition.search_again_pause_s=0.4",)),
    "never in reach": Setup(settings=NEVER_IN_REACH, home={"right": "COARSE"}),
    "ensemble": Setup(file="ensemble"),
    "fit-bal-analog": Setup(file="fit-bal-analog"),
    "fast telemetry": Setup(settings=("supervisor.telemetry_hz=100.0",)),
    # Alone, its drive goes on for half a second: at full speed, further than a search goes.
    "slow siderostat": Setup(settings=("loops.right.siderostat.velocity_limit_rad_s=6.0",)),
    # What is struck there is beside the tick, and no loop notices: the way back to the star is not asked for.
    "by TCP": Setup(settings=BY_TCP, home={"right": "STANDBY"}),
    "by TCP, never in reach": Setup(settings=(*BY_TCP, *NEVER_IN_REACH), home={"right": "STANDBY"}),
    "small disk": Setup(
        settings=("logging.queue_records=300", "logging.rotate_s=8.0"), where=on_a_disk_of_its_own
    ),
    "own clock": Setup(
        settings=("logging.rotate_s=4.0",), where=patched("clock", "FITCTL_TEST_CLOCK", "step")
    ),
    "silent disk": Setup(where=patched("disk", "FITCTL_TEST_SILENT_DISK", "silent")),
}


@contextmanager
def started(name, folder):
    """The rig of a name, running; once it has ended, `records` has what it lost."""
    setup = SETUPS[name]
    file = default_rig_path().parent / f"{setup.file}.toml"
    with ExitStack() as stack:
        before, root = setup.where(stack, folder)
        settings = [
            setting.format(folder=folder, port=free_port()) for setting in (*SOON, *setup.settings)
        ]
        with running(folder, *settings, file=file, kind=WatchedRig, before=before) as rig:
            rig.logs = root / folder.relative_to("/") if root else folder
            yield rig
        rig.records = settle(rig)
