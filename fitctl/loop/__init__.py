"""One loop's tick, from a frame to a command."""
