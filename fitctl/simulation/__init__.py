"""The instrument on the virtual clock, one run or many."""
