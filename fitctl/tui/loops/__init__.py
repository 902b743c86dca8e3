"""What the console shows of all loops at once: pure functions from its state to lines."""
