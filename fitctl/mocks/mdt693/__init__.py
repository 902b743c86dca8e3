"""A mock Thorlabs MDT693A or MDT693B."""
