"""The panels of the console's screens, a module each."""
