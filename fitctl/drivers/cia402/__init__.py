"""Siderostat amplifiers as a two-axis CANopen CiA 402 drive, over any python-can interface."""
