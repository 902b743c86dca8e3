"""A logged run, made again by today's code."""
