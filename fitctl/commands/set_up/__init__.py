"""Commands that set up a rig: its file, its devices, its keys."""
