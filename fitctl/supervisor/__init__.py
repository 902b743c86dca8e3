"""Modes, the loop, and the service through which consoles and commands reach them."""
