"""What the commands do, between their options (:mod:`fitctl.cli`) and the rooms that do the work."""
