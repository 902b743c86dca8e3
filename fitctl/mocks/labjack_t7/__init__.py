"""A mock LabJack T7."""
