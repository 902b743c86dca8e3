"""`fitctl record`: the recorder, a process that the supervisor starts."""

from __future__ import annotations

import threading

from fitctl.commands.shared.options import ParentOption, SetOption, ShippedRigOption
from fitctl.commands.shared.rig import rig_of
from fitctl.logging.recorder import record as record_messages
from fitctl.logging.records import RecorderStatus
from fitctl.messages.client import Client
from fitctl.messages.commands import RecorderReport
from fitctl.messages.endpoints import RECORDS_SOCKET, SocketFolder, checked_folder
from fitctl.processes import ended_by_signals

_REPORT_TIMEOUT_S = 0.5


def record(
    rig: ShippedRigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Record what a supervisor sends; the supervisor starts this by itself."""
    settings = rig_of(rig, overrides)
    folder = checked_folder(settings)
    client = Client(folder)
    # Examined once: a recorder connects once, because the queue serves only one that has just announced itself.
    sockets = SocketFolder(folder)

    def report(status: RecorderStatus) -> None:
        try:
            client.send(RecorderReport(status=status), _REPORT_TIMEOUT_S)
        except ConnectionError:
            return  # the supervisor is gone; the log has the status too

    stop = threading.Event()
    with ended_by_signals(stop.set):
        try:
            record_messages(
                sockets.endpoint(RECORDS_SOCKET),
                settings.logging,
                rig_name=settings.name,
                folder=settings.logging.folder_path,
                stop=stop,
                on_status=report,
                parent_pid=parent_pid,
            )
        finally:
            client.close()
            sockets.close()
