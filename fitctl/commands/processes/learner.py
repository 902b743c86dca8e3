"""`fitctl learner`: what learns from a running loop, a process that the supervisor starts."""

from __future__ import annotations

import threading

from fitctl.commands.shared.options import ParentOption, SetOption, ShippedRigOption
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import client_of
from fitctl.learn.process import serve_learning
from fitctl.processes import end_with_parent, ended_by_signals


def learner(
    rig: ShippedRigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Learn from the running instrument; the supervisor starts this by itself."""
    settings = rig_of(rig, overrides)
    end_with_parent(parent_pid)
    stop = threading.Event()
    client = client_of(settings)
    try:
        with ended_by_signals(stop.set):
            serve_learning(client, settings, stop)
    finally:
        client.close()
