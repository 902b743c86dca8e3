"""One folder a device: its protocol's constants, and the driver that the supervisor uses."""
