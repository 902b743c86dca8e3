"""Siderostat amplifiers as an Aerotech Ensemble controller, spoken to in its ASCII commands."""
