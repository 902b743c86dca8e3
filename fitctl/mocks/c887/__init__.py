"""A PI C-887 hexapod controller."""
