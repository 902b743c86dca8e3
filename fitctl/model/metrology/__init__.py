"""The metrology loop's hardware: photodiodes, link, the collector bench at its end, and the fringes."""
