"""The one error that logs raise."""

from __future__ import annotations


class LogError(Exception):
    """A log cannot be written, sent or read: which one, why, and the next step."""
