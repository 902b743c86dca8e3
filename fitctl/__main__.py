"""``python -m fitctl``."""

from __future__ import annotations

import sys

from fitctl.commands.shared.exits import INTERRUPTED


def main() -> None:
    """Run the command line. Ctrl-C during its imports ends it without a traceback, as Ctrl-C does later."""
    try:
        from fitctl.cli import main as run
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    run()


if __name__ == "__main__":
    main()
