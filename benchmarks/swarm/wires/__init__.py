"""Drivers and their mocks on virtual time, with a bad wire between them."""
