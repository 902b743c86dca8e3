"""What the physics is: pure numerics, without I/O, threads or clocks."""
