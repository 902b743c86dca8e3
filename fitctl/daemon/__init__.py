"""The supervisor's process: real clock, real devices, threads, and the processes beside it."""
