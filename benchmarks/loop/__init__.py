"""From a frame's last packet to the D/A: fitctl on its mocks, beside pyRTC and a floor in C, in one run."""
