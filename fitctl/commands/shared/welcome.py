"""What `fitctl` says by itself: what to do next."""

from __future__ import annotations

from pathlib import Path

_LARGEST_BYTES = 1_000_000


def welcome(folder: Path) -> str:
    """The lines that `fitctl` prints without a command."""
    rigs = rig_files(folder)
    steps = [("fitctl demo", "see the whole instrument on mock devices acquire and hold a star")]
    if rigs:
        rig = rigs[0].name
        steps += [
            (f"fitctl doctor --rig {rig}", "identify its devices; nothing moves"),
            (f"fitctl run --rig {rig}", "supervise it; it begins in OFF"),
            (f"fitctl console --rig {rig}", "attach a console to it, in another terminal"),
        ]
    else:
        steps += [
            ("fitctl init", "describe the hardware that you have, as a rig file"),
            ("fitctl simulate", "the same controllers on a virtual clock, much faster"),
        ]
    steps.append(("fitctl --help", "every command"))
    return f"fitctl points starlight: it finds a star, pulls it in and holds it. Next:\n\n{listed(steps)}"


def listed(steps: list[tuple[str, str]]) -> str:
    """Commands, and beside them what they do; one a line."""
    width = max(len(command) for command, _ in steps)
    return "\n".join(f"  {command:<{width}}  {what}" for command, what in steps)


def rig_files(folder: Path) -> list[Path]:
    """Files of a folder that look like rig files."""
    return [path for path in sorted(folder.glob("*.toml")) if _looks_like_a_rig(path)]


def _looks_like_a_rig(path: Path) -> bool:
    """Whether it has a loop or a base, without parsing it: a rig with a mistake is one too."""
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            return False
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return False
    return any(line.startswith(("[loops.", "base =")) for line in lines)
