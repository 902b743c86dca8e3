"""`fitctl doctor`: which of a rig's devices answer, and whether they are as the rig file says."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fitctl.commands.operate.status import newest_telemetry
from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import JsonOption, OwnRigOption, SetOption
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import named_rig, rig_of
from fitctl.commissioning.asking import Finding, examine_all, parts_of, without_mocks
from fitctl.config import Rig, default_rig_path
from fitctl.config.simulated import mixture
from fitctl.drivers.interface import DeviceIdentity
from fitctl.messages.client import Client
from fitctl.messages.endpoints import COMMAND_SOCKET, service_folder
from fitctl.messages.running import running_rigs, supervisor_runs
from fitctl.messages.telemetry import Telemetry
from fitctl.text import plain

_WIDEST = 118
_FIRST_REPORT_S = 3.0


def doctor(
    rig: OwnRigOption = None, overrides: SetOption = None, as_json: JsonOption = False
) -> None:
    """Check that the devices of a rig answer. Sets nothing and moves nothing.

    Reads the identity of each device. While the supervisor of the rig runs, prints what the supervisor
    reports about its devices instead. Exit status 1 if a device is missing or differs from the rig file.
    Mocks that do not run are not counted.
    """
    path = named_rig(rig) or default_rig_path()
    raise typer.Exit(ask_devices(rig_of(path, overrides), path, overrides or [], as_json=as_json))


def ask_devices(rig: Rig, path: Path, overrides: Sequence[str] = (), *, as_json: bool) -> int:
    """Ask every device of a rig, print what they answer; returns the exit status."""
    logging.disable()  # libraries print on stderr what is in the table
    running = _running_supervisor(rig, path, overrides)
    findings = without_mocks(rig, examine_all(rig)) if running is None else reported(rig, running)
    asked = "devices" if running is None else "supervisor"
    if as_json:
        documents = [_plain(one) for one in findings]
        say(to_json({"rig": rig.name, "asked": asked, "devices": documents}))
    else:
        _print(rig, findings)
        for line in mixture(rig):
            say(line)
        if running is not None:
            say(
                f"The supervisor of {rig.name} runs (process {running.pid}). This is its report: doctor did"
                " not query the devices, because that would disturb it. To query them, shut it down first."
            )
    return FAILED if any(finding.disagreements for finding in findings) else 0


def reported(rig: Rig, running: Telemetry) -> list[Finding]:
    """What the running supervisor reports of its devices."""
    drivers = {device.removesuffix(" amplifier"): driver for device, driver, _ in parts_of(rig)}
    findings = []
    for health in running.devices:
        trouble = {
            "ok": [],
            "fault": [health.detail],
            "closed": ["the supervisor has not opened it: send standby, or end the supervisor"],
        }[health.state]
        identity = DeviceIdentity("", health.identity, "", "") if health.identity else None
        found = health.state == "ok"
        driver = drivers.get(health.device, "")
        findings.append(Finding(health.device, driver, found, identity, None, trouble))
    if not findings:
        nothing = "the supervisor has not reported any device yet: run doctor again"
        findings.append(Finding("devices", "", False, None, None, [nothing]))
    return findings


def _devices_settings(overrides: Sequence[str]) -> set[str]:
    """Without those that do not change where the devices are."""
    return {text for text in overrides if not text.startswith("service.")}


def _running_supervisor(rig: Rig, path: Path, overrides: Sequence[str]) -> Telemetry | None:
    """A message of the rig's supervisor on this machine, if one runs, in whatever folder.

    One that has just started reports its devices within a second or two. If one runs and does not answer,
    doctor ends, because querying the devices would disturb it.
    """
    here, wanted = service_folder(rig), (str(path.absolute()), _devices_settings(overrides))
    runs = [
        Path(one.folder)
        for one in running_rigs()
        if (one.file, _devices_settings(one.settings)) == wanted
    ]
    if supervisor_runs(here):
        runs.insert(0, here)
    elif not runs and not (here / COMMAND_SOCKET).exists():
        return None
    client = Client((runs or [here])[0])
    try:
        running = newest_telemetry(client)
        deadline_s = time.monotonic() + _FIRST_REPORT_S
        while not running.devices and time.monotonic() < deadline_s:
            running = client.receive(_FIRST_REPORT_S) or running
        return running
    except ConnectionError as error:
        if not runs:
            return None  # what ended left its socket
        say(
            f"doctor: a supervisor of {rig.name} runs with its sockets in {runs[0]}, but {error}. The devices "
            "were not queried, because that would disturb it",
            err=True,
        )
        raise typer.Exit(FAILED) from None
    finally:
        client.close()


def _plain(finding: Finding) -> dict[str, Any]:
    identity = None if finding.identity is None else asdict(finding.identity)
    return finding._asdict() | {"identity": identity}


def _cell(lines: Iterable[str]) -> str:
    return "\n".join(map(plain, lines))


def _print(rig: Rig, findings: list[Finding]) -> None:
    table = Table(title=f"Devices of {rig.name}", title_justify="left", show_lines=True)
    for heading in ("device", "found", "identity", "firmware", "round trip", "disagrees"):
        table.add_column(heading, justify="right" if heading == "round trip" else "left")
    for finding in findings:
        who = finding.identity
        cells = (
            f"{finding.device}\n({finding.driver})",
            "yes" if finding.found else "no",
            "" if who is None else _cell(filter(None, (who.maker, who.model, who.serial))),
            "" if who is None else plain(who.firmware),
            "" if finding.round_trip_ms is None else f"{finding.round_trip_ms:.2f} ms",
            _cell([*finding.disagreements, *filter(None, [finding.note])]),
        )
        table.add_row(*map(Text, cells))  # as Text, or what a device says of itself could be markup
    width = min(shutil.get_terminal_size((_WIDEST, 24)).columns, _WIDEST)
    Console(width=width, highlight=False).print(table)
