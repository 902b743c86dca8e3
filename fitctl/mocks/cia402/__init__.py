"""A two-axis CANopen CiA 402 drive behind an SLCAN adapter on TCP, moving the shared plant's motors."""
