"""What the scripts that take pictures share: Chromium draws pages, and consoles lose their taker's name."""

import getpass
import os
import re
import socket
import subprocess
from pathlib import Path


def photograph(page: Path, picture: Path, width_px: int, height_px: int) -> None:
    """Draw a page with Chromium, which keeps its files beside the page, and save it as PNG."""
    # Chromium refuses to run as root, as in a container, with its sandbox. The pages are our own.
    without_sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    subprocess.run(
        [  # noqa: S607
            "chromium",
            "--headless",
            *without_sandbox,
            "--hide-scrollbars",
            f"--user-data-dir={page.parent}/profile",
            f"--window-size={width_px},{height_px}",
            f"--screenshot={picture}",
            page.as_uri(),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )


def for_everybody(svg: str) -> str:
    """An SVG of the console without fonts from elsewhere, and without the name of who took it."""
    svg = re.sub(r"@font-face \{.*?\}", "", svg, flags=re.DOTALL)
    me = f"{getpass.getuser()}@{socket.gethostname()}"
    return svg.replace("Fira Code", "DejaVu Sans Mono").replace(me, "you".ljust(len(me), "\u00a0"))
