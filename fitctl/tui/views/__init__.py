"""The console's screens, a module each."""
