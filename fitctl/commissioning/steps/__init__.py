"""The steps of a commissioning, and what they have in common."""
