"""Sequences: steps of an observation or an experiment, from a file or from Python, on a rig or simulated."""
