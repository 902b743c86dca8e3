"""Learning what a rig truly is: from experiments on it, or from its logs."""
