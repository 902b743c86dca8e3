"""`fitctl record`: the recorder, a process that the supervisor starts."""

from __future__ import annotations

import threading
from pathlib import Path

from fitctl.config import ConfigError, Rig
from fitctl.logging.errors import LogError
from fitctl.logging.recorder import record
from fitctl.logging.records import RecorderStatus
from fitctl.messages.client import Client
from fitctl.messages.commands import RecorderReport
from fitctl.messages.endpoints import RECORDS_SOCKET, service_folder
from fitctl.processes import ended_by_signals

_REPORT_TIMEOUT_S = 0.5


def run_recorder(rig: Rig, *, parent_pid: int | None) -> None:
    """Record until the supervisor ends us, or is gone."""
    folder = service_folder(rig)
    client = Client(folder)

    def report(status: RecorderStatus) -> None:
        try:
            client.send(RecorderReport(status=status), _REPORT_TIMEOUT_S)
        except ConnectionError:
            return  # no supervisor to tell; the log has it all the same

    stop = threading.Event()
    with ended_by_signals(stop.set):
        try:
            record(
                f"ipc://{folder / RECORDS_SOCKET}",
                rig.logging,
                rig_name=rig.name,
                folder=Path(rig.logging.folder).expanduser(),
                stop=stop,
                on_status=report,
                parent_pid=parent_pid,
            )
        except LogError as error:
            raise ConfigError(str(error)) from None
        finally:
            client.close()
