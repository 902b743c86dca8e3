"""What several commands share: options, choice of the rig, output."""
