"""The errors that logs raise."""

from __future__ import annotations


class LogError(Exception):
    """A log cannot be written, sent or read: which one, why, and the next step."""


class NoLogError(LogError):
    """A file that is no MCAP log at all, so that no run can be lost in it."""


class ForeignTopicError(LogError):
    """A topic in another format than protobuf, as another program writes it: that is no damage."""
