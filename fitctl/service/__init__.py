"""How a supervisor is reached: commands in, telemetry out, keys, metrics."""
