"""A mock Modbus/TCP D/A converter."""
