"""Three D/A channels of a Modbus/TCP remote I/O station, behind the fast steering mirror."""
