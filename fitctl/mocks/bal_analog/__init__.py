"""Two analogue amplifiers with encoders behind a Modbus/TCP I/O station, moving the shared plant's motors."""
