"""Take the picture of a report: the top of the page of a log, as a browser shows it. Needs Chromium.

python docs/pictures/take_report.py LOG
"""

import sys
import tempfile
from pathlib import Path

from photograph import photograph

from fitctl.report.findings import find
from fitctl.report.make import make_report
from fitctl.report.run import find_run

SIZE = (1000, 1320)


def main() -> None:
    """Make the report and photograph it."""
    picture = Path(__file__).with_name("report.png")
    with tempfile.TemporaryDirectory() as folder:
        page = make_report(find(find_run([Path(sys.argv[1])])), Path(folder))
        photograph(page, picture, *SIZE)
    print(picture.name)


if __name__ == "__main__":
    main()
