"""What passes between a supervisor and everybody else: commands, replies, telemetry, and how they get there."""
