"""A two-axis Aerotech Ensemble controller on TCP and on a pty, moving the shared plant's motors."""
