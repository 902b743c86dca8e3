"""Exit statuses that more than one command has; those of one command are beside it."""

from __future__ import annotations

FAILED = 1
UNUSABLE = 2
NO_SUPERVISOR = 3
STILL_UNDER_WAY = 4
INTERRUPTED = 130
