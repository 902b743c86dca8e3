"""Estimating a night from what a loop recorded while it held its star, and designing for it."""
