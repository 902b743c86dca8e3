"""`fitctl run`: the supervisor."""

from __future__ import annotations

from fitctl.commands.shared.options import ControllerOption, OwnRigOption, ParentOption, SetOption
from fitctl.commands.shared.printing import say
from fitctl.commands.shared.rig import named_rig, rig_of, with_controller
from fitctl.config import default_rig_path
from fitctl.daemon.run import run_supervisor
from fitctl.processes import end_with_parent
from fitctl.stages.realtime import bound_memory


def run(
    rig: OwnRigOption = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    parent_pid: ParentOption = None,
) -> None:
    """Supervise a rig until Ctrl-C or the command `shutdown`.

    The rig starts in OFF. Attach to it with `fitctl console`, or send commands with `fitctl send`.
    """
    bound_memory()
    rig = named_rig(rig) or default_rig_path()
    overrides = with_controller(rig, overrides, controller)
    settings = rig_of(rig, overrides)
    end_with_parent(parent_pid)
    run_supervisor(
        settings,
        rig,
        overrides,
        lambda folder: say(f"supervising {settings.name}; sockets in {folder}"),
    )
