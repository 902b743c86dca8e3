"""A LabJack T7 over Modbus/TCP: the four photodiodes of the metrology sensor."""
