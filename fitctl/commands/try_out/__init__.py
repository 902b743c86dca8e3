"""Commands to try fitctl without hardware: the demo, mock devices, their faults."""
