"""A Modbus server for mock devices, over TCP and over a serial line, around two callables."""
