"""Siderostat amplifiers as two analogue ones, BAL 20-40-A, behind Modbus/TCP I/O: the paper's own rig."""
