"""`fitctl gateway`: the gateway for clients elsewhere, a process that the supervisor starts."""

from __future__ import annotations

import threading

from fitctl.clock import MonotonicClock
from fitctl.commands.shared.options import ParentOption, SetOption, ShippedRigOption
from fitctl.commands.shared.rig import rig_of
from fitctl.messages.endpoints import checked_folder
from fitctl.processes import end_with_parent, ended_by_signals
from fitctl.service.gateway import Gateway, be_modest, show_life


def gateway(
    rig: ShippedRigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Let keys in by TCP; the supervisor starts this by itself."""
    settings = rig_of(rig, overrides)
    be_modest()
    end_with_parent(parent_pid)
    stop = threading.Event()
    with ended_by_signals(stop.set):
        Gateway(settings, checked_folder(settings), MonotonicClock(), show_life).run(stop)
