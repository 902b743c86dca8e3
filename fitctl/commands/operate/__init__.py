"""Commands that operate a rig: the supervisor, and what attaches to it."""
