"""The console's past: what it kept of live telemetry, or a log, shown as it was at a time."""
