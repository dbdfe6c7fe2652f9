"""The servo bus: interface, packets, control tables, clocks, scan, and the bus on a serial port."""
