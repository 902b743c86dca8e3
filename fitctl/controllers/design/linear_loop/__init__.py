"""The loop as designs are made for it and evaluated in it: one axis, linear, from frame to frame."""
