"""What stops an identification."""

from __future__ import annotations


class IdentifyError(ValueError):
    """A record, or a rig, from which nothing can be learned: one line with what, expected, next step."""
