"""One folder a device, named as in drivers: each serves its wire protocol from the one plant."""
