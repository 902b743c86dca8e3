"""What a shell offers at Tab: rig files, sequences, devices, faults. A press of Tab must not take long.

A shell that is offered nothing by these offers files by itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import typer

from fitctl.commands.shared.fault_kinds import kinds
from fitctl.commands.shared.welcome import rig_files
from fitctl.config import CONTROLLERS, ConfigError, Rig, default_rig_path, load_rig
from fitctl.sequences.files import shipped_sequences

_OF_LOOP = {"stellar": ("drive", "dac", "mdt693"), "metrology": ("drive", "labjack")}


def rigs(incomplete: str) -> list[str]:
    """Rig files where the text leads, and the folders there."""
    folder = Path(incomplete) if incomplete.endswith("/") else Path(incomplete).parent
    found = [str(path) for path in rig_files(folder)]
    found += [f"{path}/" for path in sorted(folder.glob("*/")) if not path.name.startswith(".")]
    return [text for text in found if text.startswith(incomplete)]


def sequences(incomplete: str) -> list[str]:
    """Shipped sequences by name; for a file of one's own, a part of its path is needed."""
    return _beginning(incomplete, (path.stem for path in shipped_sequences()))


def controllers(incomplete: str) -> list[str]:
    """Designs by name."""
    return _beginning(incomplete, CONTROLLERS)


def devices(context: typer.Context, incomplete: str) -> list[str]:
    """Devices that can fail, of the rig that the command line names."""
    rig = _rig(context.params.get("rig"))
    if rig is None:
        return []
    of_loops = [
        f"{name}.{device}" for name, loop in rig.loops.items() for device in _OF_LOOP[loop.kind]
    ]
    collector = [] if rig.collector is None else ["hexapod"]
    return _beginning(incomplete, ["camera", *of_loops, *collector])


def faults(context: typer.Context, incomplete: str) -> list[str]:
    """What can go wrong with the device that the command line names."""
    device = str(context.params.get("device") or "")
    return _beginning(incomplete, kinds().get(device.rpartition(".")[2], ()))


def loops(context: typer.Context, incomplete: str) -> list[str]:
    """Loops of the rig that the command line names."""
    rig = _rig(context.params.get("rig"))
    return [] if rig is None else _beginning(incomplete, rig.loops)


def _rig(path: Path | None) -> Rig | None:
    try:
        return load_rig(path or default_rig_path())
    except ConfigError:
        return None  # Tab has no place for errors


def _beginning(incomplete: str, known: Iterable[str]) -> list[str]:
    return [text for text in known if text.startswith(incomplete)]
