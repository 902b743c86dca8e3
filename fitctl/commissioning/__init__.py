"""Bring a new instrument from its wiring to a held star: the steps of `fitctl commission`, and their record."""
