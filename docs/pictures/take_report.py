"""Take the picture of a report: the top of the page of a log, as a browser shows it. Needs Chromium.

python docs/pictures/take_report.py LOG
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from fitctl.report.findings import find
from fitctl.report.make import make_report
from fitctl.report.run import find_run

SIZE = "1000,1320"


def main() -> None:
    """Make the report and photograph it."""
    # Chromium refuses to run as root, as in a container, with its sandbox. The log is ours.
    without_sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    picture = Path(__file__).with_name("report.png")
    with tempfile.TemporaryDirectory() as folder:
        page = make_report(find(find_run([Path(sys.argv[1])])), Path(folder))
        subprocess.run(
            [  # noqa: S607
                "chromium",
                "--headless",
                *without_sandbox,
                "--hide-scrollbars",
                f"--user-data-dir={folder}/profile",
                f"--window-size={SIZE}",
                f"--screenshot={picture}",
                page.as_uri(),
            ],
            check=True,
            capture_output=True,
            timeout=120,
        )
    print(picture.name)


if __name__ == "__main__":
    main()
