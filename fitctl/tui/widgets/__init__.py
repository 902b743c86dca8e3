"""The panels of the console's one screen, a module each."""
