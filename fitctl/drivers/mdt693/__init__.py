"""Thorlabs MDT693A and MDT693B piezo amplifiers."""
