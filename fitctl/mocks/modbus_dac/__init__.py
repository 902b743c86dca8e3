"""A mock Modbus D/A converter."""
