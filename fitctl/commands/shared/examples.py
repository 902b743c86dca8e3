"""Examples at the end of each command's help: one or two lines for each command that people run."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[str, ...]] = {
    "demo": ("fitctl demo", "fitctl demo --testbed --headless --duration 120"),
    "mocks": ("fitctl mocks", "fitctl mocks --rig my-rig.toml --faults night.toml"),
    "fault": ("fitctl fault kinds", "fitctl fault set right.mdt693 freeze --for 5"),
    "fault set": (
        "fitctl fault set right.mdt693 freeze --for 5",
        "fitctl fault set camera packet_loss --probability 0.01",
    ),
    "fault clear": ("fitctl fault clear", "fitctl fault clear camera"),
    "fault now": ("fitctl fault now",),
    "fault kinds": ("fitctl fault kinds",),
    "init": ("fitctl init my-rig.toml", "fitctl init my-rig.toml --mocks"),
    "check": (
        "fitctl check --rig my-rig.toml",
        "fitctl check --rig my-rig.toml --show",
    ),
    "discover": ("fitctl discover", "fitctl discover --broadcast 192.168.1.255"),
    "commission": (
        "fitctl commission --rig my-rig.toml",
        "fitctl commission --rig my-rig.toml --only amplifiers",
    ),
    "doctor": ("fitctl doctor --rig my-rig.toml",),
    "keys": ("fitctl keys new anna --viewer", "fitctl keys list"),
    "keys new": (
        "fitctl keys new anna --rig my-rig.toml",
        "fitctl keys new visitor --viewer --rig my-rig.toml",
    ),
    "keys list": ("fitctl keys list --rig my-rig.toml",),
    "keys revoke": ("fitctl keys revoke visitor --rig my-rig.toml",),
    "run": ("fitctl run --rig my-rig.toml",),
    "console": ("fitctl console", "fitctl console --remote anna.key.toml"),
    "status": ("fitctl status", "fitctl status --json"),
    "watch": ("fitctl watch", "fitctl watch --json --duration 60"),
    "send": ("fitctl send acquire --loop right", "fitctl send target 24 19.5 --loop right"),
    "rehearse": ("fitctl rehearse target 24 19.5 --loop right",),
    "sequence": ("fitctl sequence list", "fitctl sequence dry-run acquire"),
    "sequence list": ("fitctl sequence list", "fitctl sequence list --json"),
    "sequence check": ("fitctl sequence check my-night.toml --rig my-rig.toml",),
    "sequence dry-run": (
        "fitctl sequence dry-run acquire",
        "fitctl sequence dry-run my-night.toml --set steps.hold.duration_s=60",
    ),
    "sequence run": ("fitctl sequence run my-night.toml",),
    "sequence pause": ("fitctl sequence pause",),
    "sequence resume": ("fitctl sequence resume",),
    "sequence stop": ("fitctl sequence stop",),
    "report": ("fitctl report logs", "fitctl report --compare monday.mcap tuesday.mcap"),
    "plot": (
        "fitctl plot night.mcap error_az_px error_el_px",
        "fitctl plot night.mcap /fit/right/tick.error_az_px --from 60 --to 90",
    ),
    "log": ("fitctl log info night.mcap", "fitctl log export night.mcap --format csv"),
    "log info": ("fitctl log info night.mcap", "fitctl log info night.mcap --json"),
    "log summary": ("fitctl log summary logs/*.mcap",),
    "log verify": ("fitctl log verify night.mcap",),
    "log recover": ("fitctl log recover night.mcap",),
    "log cut": (
        "fitctl log cut night.mcap --from 60 --to 90 --out minute.mcap",
        "fitctl log cut night.mcap --topic '/fit/right/*'",
    ),
    "log merge": ("fitctl log merge first.mcap second.mcap --out night.mcap",),
    "log export": ("fitctl log export night.mcap --format parquet --topic '/fit/right/*'",),
    "log keep": ("fitctl log keep night.mcap", "fitctl log keep --undo night.mcap"),
    "replay": ("fitctl replay night.mcap", "fitctl replay night.mcap --controller fslq"),
    "simulate": ("fitctl simulate --seed 3", "fitctl simulate --runs 100 --duration 60"),
    "identify": (
        "fitctl identify hysteresis --mock",
        "fitctl identify airpath --log night.mcap",
    ),
    "design": (
        "fitctl design compare",
        "fitctl design learn night.mcap --out learnt.json",
    ),
    "figures": ("fitctl figures --out figures --quick",),
}
