"""Three D/A channels of a Modbus remote I/O station, behind the fast steering mirror."""
