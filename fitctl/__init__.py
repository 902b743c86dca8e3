"""fitctl points starlight: a siderostat, a fast steering mirror and a camera, as one instrument."""

__version__ = "0.1.0"
