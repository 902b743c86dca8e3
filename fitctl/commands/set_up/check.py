"""`fitctl check`: a rig file, validated."""

from __future__ import annotations

from fitctl.commands.shared.options import RigOption, SetOption
from fitctl.commands.shared.plant import check_plant
from fitctl.commands.shared.printing import say
from fitctl.commands.shared.rig import named_rig, rig_of
from fitctl.config import default_rig_path


def check(rig: RigOption = None, overrides: SetOption = None) -> None:
    """Read a rig file and say whether it is well."""
    rig = named_rig(rig)
    settings = rig_of(rig, overrides)
    check_plant(settings)
    loops = ", ".join(settings.loops)
    say(f"{rig or default_rig_path()}: well; rig {settings.name}, loops {loops}")
