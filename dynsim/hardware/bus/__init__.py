"""The servo bus: packets, control tables, and the bus behind a serial port."""
