"""What needs both cores: more than one instrument, or the whole testbed."""
