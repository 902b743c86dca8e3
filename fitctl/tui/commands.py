"""The commands that the console has on keys: for keys, footer, palette and help."""

from __future__ import annotations

from fitctl.supervisor.command_table import COMMANDS

OPERATOR_COMMANDS = tuple(row for row in COMMANDS if row.key)
BY_NAME = {row.name: row for row in OPERATOR_COMMANDS}
