"""Devices that fail as real ones do: those of :mod:`fitctl.simulation.devices` behind lines with faults.

A device keeps running when its line fails.
"""
