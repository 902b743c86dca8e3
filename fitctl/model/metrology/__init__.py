"""The metrology loop's hardware: photodiodes, link, and the collector bench at its end."""
