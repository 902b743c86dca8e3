"""What is computed each tick: from a frame to a command."""
