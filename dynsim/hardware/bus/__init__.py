"""The servo bus: interface, packets, control tables, clocks, scan, and the bus behind a serial port."""
