"""``python -m fitctl``."""

from fitctl.cli import main

main()
